"""Progress with rate and remaining time: a bar on a terminal, else a line every few seconds."""

from __future__ import annotations

import sys
import time
from typing import Self, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

EVERY_S = 10.0
"""Seconds between lines if standard output is not a terminal."""


class Meter:
    """Progress meter; a context manager.

    Example:
        >>> with Meter("train", total=100, unit="frames") as meter:
        ...     meter.advance(10)
    """

    def __init__(self, label: str, total: int, unit: str, stream: TextIO | None = None):
        self.label, self.total, self.unit = label, total, unit
        self.done = 0
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

    def advance(self, count: int) -> None:
        """Add to the count of finished units."""
        self.done += count
        now = time.monotonic()
        rate = self.done / max(now - self._start, 1e-6)
        if self._bar is not None:
            self._bar.update(self._task, advance=count, unit=f"{self.unit}, {rate:.0f}/s")
        elif now - self._last_line >= EVERY_S:
            self._last_line = now
            remaining = (self.total - self.done) / max(rate, 1e-6)
            print(
                f"{self.label}: {self.done}/{self.total} {self.unit}, {rate:.0f}/s, "
                f"{remaining:.0f} s left",
                file=self._stream,
                flush=True,
            )

    def summary(self) -> str:
        """Return one line with count, time and rate."""
        seconds = max(time.monotonic() - self._start, 1e-6)
        return (
            f"{self.label}: {self.done} {self.unit} in {seconds:.1f} s "
            f"({self.done / seconds:.0f}/s)"
        )

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
