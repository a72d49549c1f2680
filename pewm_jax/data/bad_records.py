"""Records that fail to decode: they are skipped up to a limit, and each is reported once."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from pewm_jax.config import UserError


class BadRecords:
    """The records that failed to decode; may be shared by threads and by several loaders.

    Args:
        budget: most distinct records that may be skipped, ``data.bad_records``; None = no limit.
        say: called once per skipped record with a line that names it.
    """

    def __init__(self, budget: int | None = None, say: Callable[[str], Any] | None = None):
        self.say = say
        self._budget = budget
        self._reasons: dict[str, str] = {}
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._reasons)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the records, in the order in which they were found."""
        return tuple(self._reasons)

    def add(self, record: str, reason: str) -> None:
        """Count a record that does not decode.

        Args:
            record: its name.
            reason: the sentence with which it was refused.

        Raises:
            UserError: the limit is exceeded; the message names all of them.
        """
        with self._lock:
            known = record in self._reasons
            self._reasons.setdefault(record, reason)
            if self._budget is not None and len(self) > self._budget:
                raise UserError(self._too_many(reason))
            if not known and self.say is not None:
                allowed = "" if self._budget is None else f" of {self._budget} allowed"
                self.say(f"bad record {len(self)}{allowed}, skipped: {record}: {reason}")

    def _too_many(self, reason: str) -> str:
        count = len(self)
        if count == 1:
            return f"{reason.rstrip('.')}, or train without it by --data.bad_records 1."
        return (
            f"{count} records do not decode and data.bad_records allows {self._budget}: "
            f"{'; '.join(self._reasons)}. `python -m pewm_jax.data validate` finds all there are; "
            "make their shards again, or allow more by --data.bad_records."
        )
