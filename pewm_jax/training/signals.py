"""Ctrl-C and SIGTERM: finish the step, save, leave within a grace; and go on from there next time.

A signal is noticed at once even while Python is inside a long call of compiled code: the
interpreter writes its number to a pipe, which a thread reads. That thread keeps the clock, and ends
the process where the main thread cannot be reached in time.
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
"""How long the main thread may take to leave by itself where there is nothing to save."""
MARGIN = 0.05
"""Share of the grace that is kept for leaving itself."""
ONE_S = 0.1
"""Signals that follow one another as fast as this are one: a launcher tells a whole group."""


class Interrupted(KeyboardInterrupt):
    """Training was told to stop; what there was to save is saved.

    Attributes:
        exit_code: what a shell expects after the signal: 130 for Ctrl-C, 143 for SIGTERM.
    """

    def __init__(self, sentence: str, number: int):
        super().__init__(sentence)
        self.exit_code = 128 + number


class _LetGo(BaseException):
    """Raised by a signal in what may be broken off; see ``Stop.unless_told``."""


class Stop:
    """Takes stop signals while it is entered: the first asks, the second leaves at once.

    Args:
        grace_s: seconds after the first signal within which the process has left.
        agreed: called after every step with the signal that came to this process, if any; returns
            the one at which all processes of the job stop after this step, if any.
        alone: whether this is the only process; others would wait for what it breaks off.

    Attributes:
        number: the signal that came, None until one does.
        at_once: set while there is nothing new to save: then the first signal leaves at once.
        kept: says what is safely on disk, for the last sentence.
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
        self._told = False
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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: types.TracebackType | None,
    ) -> None:
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
        """Tell whether training stops after this step; asked once a step by all processes."""
        agreed = self._agreed(self.number)
        if agreed is not None:
            self.number, self._told = agreed, True
        return self._told

    @property
    def told(self) -> bool:
        """Whether training stops, as far as is known without asking other processes."""
        return self._told or (self._alone and self.number is not None)

    def unless_told(self, work: Callable[[], T]) -> T | None:
        """Do what a signal may break off; returns None where one came, before or meanwhile."""
        if not self._alone:
            return work()
        try:
            try:
                self._breakable = True
                return work() if self.number is None else None
            finally:
                self._breakable = False
        except _LetGo:
            return None

    def interrupted(self, stage: int, step: int) -> Interrupted:
        """Return the error with which training leaves after a step, once all is saved."""
        return Interrupted(
            f"Stopped after step {step} of stage {stage}; everything is saved: the same command "
            "goes on from there.",
            self.number or 0,
        )

    def _note(self, number: int, _frame: types.FrameType | None) -> None:
        """Handle a signal in the main thread, as soon as that runs Python again."""
        if self.number is None:
            self.number = number
        if self.at_once:
            raise Interrupted(self._nothing_new(), self.number)
        if self._breakable:
            self._breakable = False
            raise _LetGo

    def _watch(self) -> None:
        """Keep the clock; runs in a thread of its own."""
        while True:
            left = None if self._deadline is None else max(self._deadline - time.monotonic(), 0.0)
            ready, _, _ = select.select([self._read], [], [], left)
            if not ready:
                self._late()
                continue
            for number in os.read(self._read, 64):
                if number == 0:
                    return
                if number not in self.SIGNALS:
                    continue
                if self._asked is None:
                    self._ask(number)
                elif time.monotonic() - self._asked > ONE_S:
                    self._leave(
                        f"Left at once ({self.kept()}); the same command goes on from there."
                    )

    def _ask(self, number: int) -> None:
        """Start the clock."""
        self.number, self._asked = number, time.monotonic()
        if self.at_once:
            self._deadline = self._asked + LINGER_S
        else:
            self._grant()

    def _grant(self) -> None:
        """Give the time that saving may take, counted from the signal, and say so."""
        assert self._asked is not None
        self._deadline = self._asked + self._grace_s * (1 - MARGIN)
        _tell(
            f"Stopping: saves after this step and leaves within {self._grace_s:g} s; once more to "
            "leave without saving."
        )

    def _late(self) -> None:
        """End the process, because the main thread has not done so in time."""
        assert self._asked is not None
        if self.at_once:
            self._leave(self._nothing_new())
        if time.monotonic() < self._asked + self._grace_s * (1 - MARGIN):
            self._grant()  # the first step was done just when the signal came
            return
        self._leave(
            f"Left before saving was done, for the {self._grace_s:g} s of train.grace_s are over "
            f"({self.kept()}); the same command goes on from there."
        )

    def _nothing_new(self) -> str:
        return f"Stopped with nothing new to save ({self.kept()}); the same command goes on."

    def _leave(self, sentence: str) -> NoReturn:
        _tell(sentence)
        os._exit(128 + (self.number or 0))


def _tell(sentence: str) -> None:
    """Write a line to stderr past Python's buffers, whose locks the main thread may hold."""
    show_cursor = "\x1b[?25h" if sys.stderr is not None and sys.stderr.isatty() else ""
    os.write(2, f"{show_cursor}\n{sentence}\n".encode())
