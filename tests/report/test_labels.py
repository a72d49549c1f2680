"""Sentences of a report."""

from pewm_jax.report import labels
from pewm_jax.report.table import Table, heading, row


def growth(capacity):
    held = {"mean": [10.0, 20.0]}
    return {"long": {"growth": {"occupied": held, "frames": [0, 8], "capacity": capacity}}}


def test_the_room_of_a_map_is_said_where_it_is_known():
    (known,) = labels.format_map_growth(growth(256))
    (unknown,) = labels.format_map_growth(growth(None))
    assert known.endswith("in 8 imagined frames, with a capacity of 256.")
    assert unknown.endswith("from 10 to 20 points in 8 imagined frames.")


def test_steering_is_compared_at_the_frames_of_the_paper():
    def entry(mean):
        return {"mean": mean, "low": None, "high": None}

    copy, true = [0.5] * 8, [0.4] * 8
    true[3], true[7] = 0.25, None
    lpips = {
        "per_frame": {"true": entry(true), "copy": entry(copy)},
        "all": {"true": entry(0.4), "copy": entry(0.5)},
    }
    scs = {"all": {"true": entry(45.0), "shuffled": entry(30.0)}}
    found = {"scores": {"lpips": lpips, "scs": scs, "arms": {"all": {"true": entry(None)}}}}
    assert labels.compare_steering(found) == [
        "LPIPS, true actions against copying: 0.250 against 0.500 (-50.0 %) at frame 4.",
        "SCS, true actions / another clip's: 1.50.",
    ]
    assert labels.compare_steering({}) == []


def test_headings_of_a_table_are_lines_of_their_own_in_text():
    table = Table(["", "all"], [heading("a long heading"), row("one", "1.25"), row("two", "20.5")])
    assert table.text() == ["      all", "a long heading", "one  1.25", "two  20.5"]
