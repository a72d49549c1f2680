"""Progress: what is printed off a terminal, with a rate and a time that can be read."""

import pytest

from pewm_jax.io import progress
from pewm_jax.io.progress import Meter


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "0 ms"),
        (0.0852, "85 ms"),
        (12.34, "12.3 s"),
        (245, "4 min 05 s"),
        (3599.7, "1 h 00 min"),
        (7800, "2 h 10 min"),
    ],
)
def test_durations(seconds, text):
    assert progress.duration(seconds) == text


@pytest.mark.parametrize(
    ("rate", "text"),
    [(129.4, "129/s"), (2.41, "2.4/s"), (0.05, "20.0 s each"), (0.001, "16 min 40 s each")],
)
def test_slow_rates_are_seconds_for_each(rate, text):
    assert progress.pace(rate) == text


def at(monkeypatch, *seconds):
    clock = iter(seconds)
    monkeypatch.setattr("pewm_jax.io.progress.time.monotonic", lambda: next(clock))


def test_progress_off_the_terminal_is_a_line_now_and_then(capsys, monkeypatch):
    at(monkeypatch, 0.0, 4.0, 11.0, 12.0, 20.0)
    with Meter("work", 100, "frames") as meter:
        meter.advance(10)
        meter.advance(12)
        meter.advance(1)
    assert capsys.readouterr().out == "work: 22/100 frames, 2.0/s, 39.0 s left\n"
    assert meter.summary() == "work: 23 frames in 20.0 s (1.1/s)"


def test_what_was_done_before_does_not_count_for_the_rate(capsys, monkeypatch):
    at(monkeypatch, 0.0, 10.0, 20.0, 20.0)
    with Meter("work", 100, "tasks") as meter:
        meter.advance(90, before=True)
        meter.advance(1)
    out = "work: 90/100 tasks\nwork: 91/100 tasks, 20.0 s each, 3 min 00 s left\n"
    assert capsys.readouterr().out == out
    assert meter.summary() == "work: 91 tasks in 20.0 s, 90 of them before (20.0 s each)"


def test_a_summary_of_nothing_new_has_no_rate(monkeypatch):
    at(monkeypatch, 0.0, 1.0, 2.0)
    with Meter("work", 5, "tasks") as meter:
        meter.advance(5, before=True)
    assert meter.summary() == "work: 5 tasks in 2.0 s, 5 of them before"
