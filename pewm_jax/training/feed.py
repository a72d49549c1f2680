"""Batches ready on the devices before they are wanted."""

from __future__ import annotations

import queue
import threading
import types
from collections.abc import Iterator
from typing import Self

import jax
from jax.sharding import Sharding

from pewm_jax.config import UserError
from pewm_jax.types import Clip

AHEAD = 2
_POLL_S = 0.2


class Feed:
    """Reads batches in a thread and places them on the devices, a few ahead.

    A context manager and an iterator; an error of the source is raised where the batch would have
    been taken.

    Args:
        batches: the source; it is closed at the end when it has a ``close`` method.
        where: the placement of every array of a batch.
        ahead: batches kept ready.
    """

    def __init__(self, batches: Iterator[Clip], where: Sharding, ahead: int = AHEAD):
        self._batches = batches
        self._where = where
        self._ready: queue.Queue[Clip | BaseException] = queue.Queue(ahead)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._fill, name="feed", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: types.TracebackType | None,
    ) -> None:
        self._over.set()
        self._thread.join()

    def __iter__(self) -> Feed:
        return self

    def __next__(self) -> Clip:
        """Take the next batch, waiting for it where the source is slower than training."""
        item = self._ready.get()
        if isinstance(item, BaseException):
            raise item
        return item

    def _fill(self) -> None:
        try:
            for batch in self._batches:
                if not self._put(jax.device_put(batch, self._where)):
                    break
            else:
                self._put(UserError("The training data ended before the training did."))
        except BaseException as error:  # noqa: BLE001 - handed to the thread that trains
            self._put(error)
        finally:
            close = getattr(self._batches, "close", None)
            if close is not None:
                close()

    def _put(self, item: Clip | BaseException) -> bool:
        """Wait for room; False when the training is over."""
        while not self._over.is_set():
            try:
                self._ready.put(item, timeout=_POLL_S)
            except queue.Full:
                continue
            return True
        return False
