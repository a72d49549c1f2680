"""Ctrl-C and SIGTERM: finish the step, save, leave; and go on from there the next time."""

from __future__ import annotations

import signal
import sys
import threading
import types
from typing import Self


class Interrupted(KeyboardInterrupt):
    """Training was told to stop and has saved its state.

    Attributes:
        exit_code: what a shell expects after the signal: 130 for Ctrl-C, 143 for SIGTERM.
    """

    def __init__(self, sentence: str, number: int):
        super().__init__(sentence)
        self.exit_code = 128 + number


class Stop:
    """Remembers the first stop signal; the second acts at once. A context manager.

    Attributes:
        number: the signal that came, None until one does.
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self) -> None:
        self.number: int | None = None
        self._before: dict[int, object] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in self.SIGNALS:
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: types.TracebackType | None,
    ) -> None:
        self._restore()

    def interrupted(self, stage: int, step: int) -> Interrupted:
        """Return the error with which training leaves after a step, once all is saved."""
        return Interrupted(
            f"Stopped after step {step} of stage {stage}; everything is saved: the same command "
            "goes on from there.",
            self.number or 0,
        )

    def _note(self, number: int, _frame: types.FrameType | None) -> None:
        self.number = number
        self._restore()
        sys.stderr.write("\nStopping after this step; once more to leave without saving.\n")

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        self._before = {}
