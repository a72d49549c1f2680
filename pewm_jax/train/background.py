"""Keep Orbax's background threads from printing stack traces.

``Checkpoints`` raises the same failure as one sentence; without this, several threads would print
their stack traces before and after it.
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
            logging.getLogger(name).addFilter(self._has_no_trace)

    def end(self) -> None:
        """Let such failures be printed again."""
        for name in _LOGGERS:
            logging.getLogger(name).removeFilter(self._has_no_trace)
        if sys.unraisablehook == self._unraisable:
            sys.unraisablehook = self._before

    def _unraisable(self, what: Any) -> None:
        """Drop the error of a write whose event loop was closed by another failed write."""
        if "Event loop is closed" not in str(what.exc_value):
            self._before(what)

    def _has_no_trace(self, record: logging.LogRecord) -> bool:
        return record.exc_info is None
