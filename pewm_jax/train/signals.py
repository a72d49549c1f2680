"""Ctrl-C and SIGTERM: finish the step, save, and exit within ``train.grace_s`` seconds.

Signals are noticed even during a long call of compiled code: the interpreter writes their numbers
to a pipe (``signal.set_wakeup_fd``), which a thread reads. That thread ends the process if the main
thread has not exited in time.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
import time
import types
from collections.abc import Callable
from typing import NoReturn, Self, TypeVar

T = TypeVar("T")

LINGER_S = 2.0
"""Seconds that the main thread may take to exit if there is nothing to save."""
MARGIN = 0.05
"""Share of the grace period reserved for exiting."""
ONE_S = 0.1
"""Seconds within which signals count as one: a launcher may signal both a process and its group."""


class Interrupted(KeyboardInterrupt):
    """Training was stopped by a signal, and everything is saved.

    Attributes:
        exit_code: what a shell expects after the signal: 130 for Ctrl-C, 143 for SIGTERM.
    """

    def __init__(self, sentence: str, number: int):
        super().__init__(sentence)
        self.exit_code = 128 + number


class _InterruptedWork(BaseException):
    """Raised by a signal during interruptible work; see ``Stop.unless_requested``."""


class Stop:
    """Handles stop signals while entered: the first requests a stop, the second exits immediately.

    Args:
        grace_s: seconds from the first signal to the end of the process.
        agreed: called after every step with the signal received by this process, or None; returns
            the signal for which all processes stop after this step, or None.
        alone: whether this is the only process; otherwise work is not interrupted, because other
            processes would wait for it.

    Attributes:
        number: the signal received, or None.
        at_once: set while there is nothing new to save: then the first signal exits immediately.
        kept: returns a phrase that names the newest checkpoint on disk.
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(
        self,
        grace_s: float = 30.0,
        *,
        agreed: Callable[[int | None], int | None] = lambda number: number,
        alone: bool = True,
    ) -> None:
        self.number: int | None = None
        self.at_once = True
        self.kept: Callable[[], str] = lambda: "nothing was saved yet"
        self._grace_s, self._agreed, self._alone = grace_s, agreed, alone
        self._breakable = False
        self._requested = False
        self._before: dict[int, object] = {}
        self._asked: float | None = None
        self._deadline: float | None = None

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._read, self._write = os.pipe()
            os.set_blocking(self._write, False)
            for number in self.SIGNALS:
                self._before[number] = signal.signal(number, self._note)
            self._wakeup = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
            self._thread = threading.Thread(target=self._watch, name="signals", daemon=True)
            self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        if not self._before:
            return
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        self._before = {}
        signal.set_wakeup_fd(self._wakeup)
        os.write(self._write, b"\0")
        self._thread.join()
        os.close(self._read)
        os.close(self._write)

    def due(self) -> bool:
        """Return whether training stops after this step; called once per step by all processes."""
        agreed = self._agreed(self.number)
        if agreed is not None:
            self.number, self._requested = agreed, True
        return self._requested

    @property
    def requested(self) -> bool:
        """Return whether this process knows that training will stop, without communication."""
        return self._requested or (self._alone and self.number is not None)

    def unless_requested(self, work: Callable[[], T]) -> T | None:
        """Call interruptible work; return None if a signal came before or during it."""
        if not self._alone:
            return work()
        try:
            try:
                self._breakable = True
                return work() if self.number is None else None
            finally:
                self._breakable = False
        except _InterruptedWork:
            return None

    def interrupted(self, stage: str, step: int) -> Interrupted:
        """Return the error that ends training after a step; raise it once everything is saved."""
        return Interrupted(
            f"Stopped after step {step} of {stage}; everything is saved: run the same command "
            "again to resume.",
            self.number or 0,
        )

    def _note(self, number: int, _frame: types.FrameType | None) -> None:
        """Handle a signal in the main thread, once that executes Python code again."""
        if self.number is None:
            self.number = number
        if self.at_once:
            raise Interrupted(self._nothing_new(), self.number)
        if self._breakable:
            self._breakable = False
            raise _InterruptedWork

    def _watch(self) -> None:
        """Wait for signals and for the deadline; runs in its own thread."""
        while True:
            left = None if self._deadline is None else max(self._deadline - time.monotonic(), 0.0)
            ready, _, _ = select.select([self._read], [], [], left)
            if not ready:
                self._end_process()
                continue
            for number in os.read(self._read, 64):
                if number == 0:
                    return
                if number not in self.SIGNALS:
                    continue
                if self._asked is None:
                    self._request_stop(number)
                elif time.monotonic() - self._asked > ONE_S:
                    self._leave(
                        f"Exited immediately ({self.kept()}); run the same command again to resume."
                    )

    def _request_stop(self, number: int) -> None:
        """Record the first signal and set the deadline."""
        self.number, self._asked = number, time.monotonic()
        if self.at_once:
            self._deadline = self._asked + LINGER_S
        else:
            self._start_grace_period()

    def _start_grace_period(self) -> None:
        """Set the deadline for saving, counted from the signal, and print it."""
        assert self._asked is not None
        self._deadline = self._asked + self._grace_s * (1 - MARGIN)
        _write_line(
            f"Stopping: saves after this step and exits within {self._grace_s:g} s; send the "
            "signal again to exit without saving."
        )

    def _end_process(self) -> None:
        """End the process, because the main thread has not done so in time."""
        assert self._asked is not None
        if self.at_once:
            self._leave(self._nothing_new())
        if time.monotonic() < self._asked + self._grace_s * (1 - MARGIN):
            self._start_grace_period()  # the first step ended just when the signal came
            return
        self._leave(
            f"Exited before saving was done, because the {self._grace_s:g} s of train.grace_s are "
            f"over ({self.kept()}); run the same command again to resume."
        )

    def _nothing_new(self) -> str:
        return (
            f"Stopped with nothing to save ({self.kept()}); run the same command again to resume."
        )

    def _leave(self, sentence: str) -> NoReturn:
        _write_line(sentence)
        os._exit(128 + (self.number or 0))


def _write_line(sentence: str) -> None:
    """Write a line to stderr past Python's buffers, whose locks the main thread may hold."""
    show_cursor = "\x1b[?25h" if sys.stderr is not None and sys.stderr.isatty() else ""
    os.write(2, f"{show_cursor}\n{sentence}\n".encode())
