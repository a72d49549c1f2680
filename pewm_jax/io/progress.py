"""Progress with rate and remaining time: a bar on a terminal, else a line every few seconds."""

from __future__ import annotations

import sys
import time
from typing import Self, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

EVERY_S = 10.0
"""Seconds between lines if standard output is not a terminal."""


def duration(seconds: float) -> str:
    """Format a duration, such as ``85 ms``, ``12.3 s``, ``4 min 05 s``, ``2 h 10 min``."""
    if seconds < 1:
        return f"{seconds * 1000:.0f} ms"
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def pace(rate: float) -> str:
    """Format units per second, such as ``129/s``, ``2.4/s`` or, below 1, ``12.3 s each``."""
    if rate >= 1:
        return f"{rate:.0f}/s" if rate >= 10 else f"{rate:.1f}/s"
    return f"{duration(1 / rate)} each" if rate > 0 else "0/s"


class Meter:
    """Progress meter; a context manager. Units that were done before do not count for the rate.

    Example:
        >>> with Meter("train", total=100, unit="frames") as meter:
        ...     meter.advance(10)
    """

    def __init__(self, label: str, total: int, unit: str, stream: TextIO | None = None):
        self.label, self.total, self.unit = label, total, unit
        self.done = self._before = 0
        self._stream = sys.stdout if stream is None else stream
        self._start = self._last_line = time.monotonic()
        self._bar: Progress | None = None

    def __enter__(self) -> Self:
        if self._stream.isatty():
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.completed:.0f}/{task.total:.0f} {task.fields[unit]}"),
                TimeRemainingColumn(),
                console=Console(file=self._stream),
            )
            self._bar.start()
            self._task = self._bar.add_task(self.label, total=self.total, unit=self.unit)
        return self

    def advance(self, count: int, *, before: bool = False) -> None:
        """Add to the count of finished units; ``before`` if an earlier process finished them."""
        self.done += count
        self._before += count if before else 0
        now = time.monotonic()
        rate = self._rate(now)
        if self._bar is not None:
            self._bar.update(self._task, advance=count, unit=f"{self.unit}, {pace(rate)}")
        elif now - self._last_line >= EVERY_S:
            self._last_line = now
            remaining = (self.total - self.done) / max(rate, 1e-6)
            left = f", {pace(rate)}, {duration(remaining)} left" if rate else ""
            print(
                f"{self.label}: {self.done}/{self.total} {self.unit}{left}",
                file=self._stream,
                flush=True,
            )

    def summary(self) -> str:
        """Return one line with count, time and, unless all was done before, the rate."""
        now = time.monotonic()
        rate = self._rate(now)
        found = f", {self._before} of them before" if self._before else ""
        speed = f" ({pace(rate)})" if rate else ""
        return (
            f"{self.label}: {self.done} {self.unit} in {duration(now - self._start)}{found}{speed}"
        )

    def _rate(self, now: float) -> float:
        return (self.done - self._before) / max(now - self._start, 1e-6)

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
