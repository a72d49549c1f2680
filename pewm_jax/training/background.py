"""What threads that write in the background print of their failures: nothing.

``Checkpoints`` raises the same failure where it matters, as one sentence; without this, several
threads would print their stack traces before it, and after it.
"""

from __future__ import annotations

import logging
import sys
from typing import Any

_LOGGERS = ("absl", "asyncio")


class Quiet:
    """Keeps failures of Orbax's threads from being printed, until ``end``."""

    def __init__(self) -> None:
        self._before = sys.unraisablehook
        sys.unraisablehook = self._unraisable
        for name in _LOGGERS:
            logging.getLogger(name).addFilter(self._is_no_trace)

    def end(self) -> None:
        """Let such failures be printed again."""
        for name in _LOGGERS:
            logging.getLogger(name).removeFilter(self._is_no_trace)
        if sys.unraisablehook == self._unraisable:
            sys.unraisablehook = self._before

    def _unraisable(self, what: Any) -> None:
        """Drop what a write says whose loop another failed write has closed."""
        if "Event loop is closed" not in str(what.exc_value):
            self._before(what)

    def _is_no_trace(self, record: logging.LogRecord) -> bool:
        return record.exc_info is None
