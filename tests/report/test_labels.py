"""Sentences of a report."""

from pewm_jax.report import labels


def growth(capacity):
    held = {"mean": [10.0, 20.0]}
    return {"long": {"growth": {"occupied": held, "frames": [0, 8], "capacity": capacity}}}


def test_the_room_of_a_map_is_said_where_it_is_known():
    (known,) = labels.format_map_growth(growth(256))
    (unknown,) = labels.format_map_growth(growth(None))
    assert known.endswith("in 8 imagined frames, with a capacity of 256.")
    assert unknown.endswith("from 10 to 20 points in 8 imagined frames.")
