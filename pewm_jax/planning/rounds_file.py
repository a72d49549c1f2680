"""The rounds of a search in a file, so that an interrupted search goes on where it was."""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pewm_jax.config import UserError
from pewm_jax.io import atomic
from pewm_jax.planning.planners import Search
from pewm_jax.planning.settings import PlanConfig, Planner
from pewm_jax.types import Array

_DAMAGED = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)
"""What NumPy raises on a file that is not whole."""


def identity(planner: Planner, config: PlanConfig, key: Array, begun: Search, about: str) -> str:
    """Return a hash of what makes a search the one that it is."""
    digest = hashlib.sha256(repr((planner, config, about)).encode())
    for leaf in [jax.random.key_data(key), *jax.tree.leaves(begun)]:
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


def write(path: Path, who: str, search: Search, rounds: list[Any]) -> None:
    """Write what is known after a round, whole or not at all."""
    leaves = jax.tree.leaves(search)
    arrays = {f"search_{i}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
    columns = zip(*(jax.tree.leaves(x) for x in rounds), strict=True)
    arrays["who"] = np.array(who)
    arrays |= {f"rounds_{i}": np.stack(column) for i, column in enumerate(columns)}
    with atomic.replacing(path) as partial, partial.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def read(path: Path, who: str, like: Search, kind: type) -> tuple[Search, list[Any]]:
    """Read what was known after the last round that was written.

    Args:
        path: the file.
        who: the ``identity`` of the search.
        like: a search of the same settings.
        kind: the dataclass of a round's statistics.

    Raises:
        UserError: the file is damaged, or of another search.
    """
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        found = str(arrays["who"])
        leaves, tree = jax.tree.flatten(like)
        saved = [arrays[f"search_{i}"] for i in range(len(leaves))]
        columns = [arrays[name] for name in sorted(arrays) if name.startswith("rounds_")]
        rounds = [kind(*row) for row in zip(*columns, strict=True)]
    except _DAMAGED as error:
        raise UserError(
            f"{path} is no checkpoint of a plan, or damaged ({type(error).__name__}): remove it, "
            "and the search begins anew."
        ) from None
    if found != who:
        raise UserError(
            f"{path} belongs to a search of other settings, key, start, goal or cost: name another "
            "file, or remove it."
        )
    return jax.tree.unflatten(tree, saved), rounds
