"""Batches placed on the devices ahead of time; each process reads its own rows."""

from __future__ import annotations

import queue
import threading
import types
from collections.abc import Iterator
from typing import Self

import jax
import numpy as np
from jax.sharding import Sharding

from pewm_jax.config import UserError
from pewm_jax.types import Clip

AHEAD = 2
_POLL_S = 0.2


def rows_of(where: Sharding, batch: int) -> slice:
    """Return the rows of a batch that this process reads: all from its first to its last.

    Processes whose devices hold the same rows (they share a clip's tokens or heads) get the same
    slice. Where the mesh interleaves processes, the slice includes rows of others.

    Args:
        where: the sharding of the batch.
        batch: its size in all processes together.
    """
    held = _held(where, batch)
    return slice(int(held[0]), int(held[-1]) + 1)


def place(clip: Clip, where: Sharding, batch: int) -> Clip:
    """Make a batch that is spread over all processes from the rows that each of them has.

    Args:
        clip: the rows of this process, as ``rows_of`` says.
        where: the sharding of every array.
        batch: the size of the batch in all processes together.
    """
    held = _held(where, batch)
    own = held - held[0]
    if len(own) <= own[-1]:  # JAX takes a process's own rows only, without those in between
        clip = jax.tree.map(lambda rows: rows[own], clip)
    shapes = jax.tree.map(lambda rows: (batch, *rows.shape[1:]), clip)
    return jax.make_array_from_process_local_data(where, clip, shapes)


def _held(where: Sharding, batch: int) -> np.ndarray:
    """Return the numbers of the rows on this process's devices, ascending."""
    parts = where.addressable_devices_indices_map((batch,)).values()
    return np.unique([row for index in parts if index for row in range(batch)[index[0]]])


class Feed:
    """Reads batches in a thread and places them on the devices, a few ahead.

    A context manager and an iterator; an error of the source is raised where the batch would have
    been taken.

    Args:
        batches: the source; it is closed at the end when it has a ``close`` method.
        where: the placement of every array of a batch.
        batch: clips per batch, of which the source has this process's rows; None where there is
            but one process.
        ahead: batches kept ready.
    """

    def __init__(
        self,
        batches: Iterator[Clip],
        where: Sharding,
        batch: int | None = None,
        ahead: int = AHEAD,
    ):
        self._batches = batches
        self._where, self._batch = where, batch
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
                if not self._put(self._placed(batch)):
                    break
            else:
                self._put(UserError("The training data ended before the training did."))
        except BaseException as error:  # noqa: BLE001 - handed to the thread that trains
            self._put(error)
        finally:
            close = getattr(self._batches, "close", None)
            if close is not None:
                close()

    def _placed(self, clip: Clip) -> Clip:
        if self._batch is None:
            return jax.device_put(clip, self._where)
        return place(clip, self._where, self._batch)

    def _put(self, item: Clip | BaseException) -> bool:
        """Wait for room; False when the training is over."""
        while not self._over.is_set():
            try:
                self._ready.put(item, timeout=_POLL_S)
            except queue.Full:
                continue
            return True
        return False
