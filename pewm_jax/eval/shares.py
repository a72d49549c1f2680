"""The work of one evaluation shared between processes: by piece, each of which is a file.

Which process does a piece depends on its place in the list alone, so that all agree without a word,
also when the job is resumed. All must see the same folder.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import jax
import numpy as np

from pewm_jax.config import UserError
from pewm_jax.eval.partial import Partials
from pewm_jax.train import processes

PATIENCE_S = 60.0
"""Seconds that a file which another process has written may take to appear."""
Piece = dict[str, np.ndarray]
T = TypeVar("T")


def share(keys: Sequence[T], light: Callable[[T], bool] = lambda _: False) -> list[T]:
    """Return the pieces that are this process's: every P-th heavy one and every P-th light one.

    Args:
        keys: all pieces, in the same order in all processes.
        light: whether a piece costs little beside the others.
    """
    count, own = jax.process_count(), jax.process_index()
    kinds = [[key for key in keys if light(key) == kind] for kind in (False, True)]
    chosen = [kind[own::count] for kind in kinds]
    return [key for key in keys if any(key in kind for kind in chosen)]


def gathered(
    partials: Partials, names: Mapping[T, str], known: Mapping[T, Piece], what: str
) -> dict[T, Piece]:
    """Wait for all processes, and return the pieces of all.

    Args:
        partials: where they are kept.
        names: the name of every piece.
        known: those that need not be read again.
        what: name of the work, another one for each call.

    Raises:
        UserError: a piece of another process is not there: the processes share no folder.
    """
    processes.meet(f"evaluate: {what}")
    return {key: known[key] if key in known else _read(partials, names[key]) for key in names}


def _read(partials: Partials, name: str) -> Piece:
    until = time.monotonic() + PATIENCE_S
    while (found := partials.get(name)) is None:
        if time.monotonic() > until:
            raise UserError(
                f"{partials.folder}/{name}.npz, which another process of this job has written, is "
                "not there: all processes must see the same folders; put the run on a disk that "
                "they share."
            )
        time.sleep(0.5)
    return found


def first_alone(work: Callable[[], T], what: str) -> T:
    """Return what a function returns: the first process calls it before all others do.

    Args:
        work: keeps what it found in a file, and reads it there when it is called again.
        what: name of the work, another one for each call.
    """
    result = work() if processes.is_primary() else None
    processes.meet(f"evaluate: {what}")
    return work() if result is None else result
