"""Network weights as one safetensors file: flat ``a/b/c`` keys, nothing to execute on loading."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np
import safetensors
import safetensors.numpy

from pewm_jax import tree
from pewm_jax.config import UserError
from pewm_jax.types import Params

_WORDS = "pewm_jax"
"""The one key in the file's header, so that equal weights are equal files: their hash is a name."""


def save(path: Path, params: Params, words: Mapping[str, str] | None = None) -> None:
    """Write parameters to ``path``, aside and then renamed.

    Args:
        path: the file to write, by custom ``weights.safetensors``; its folder is made.
        params: nested dictionaries of arrays, on any device.
        words: a few facts about them, kept in the file's header.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    leaves = tree.flatten(jax.device_get(params))
    tensors = {
        name: np.ascontiguousarray(leaf).reshape(np.shape(leaf)) for name, leaf in leaves.items()
    }
    header = {_WORDS: json.dumps(dict(words or {}), sort_keys=True)}
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        file.write(safetensors.numpy.save(tensors, header))
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


def load(path: Path) -> Params:
    """Read parameters written by ``save``.

    Args:
        path: a safetensors file.

    Returns:
        Nested dictionaries of NumPy arrays.

    Raises:
        UserError: the file is absent or damaged.
    """
    _require_file(path)
    try:
        leaves = safetensors.numpy.load_file(path)
    except (safetensors.SafetensorError, OSError) as error:
        raise _damaged(path, error) from None
    return tree.unflatten(leaves)


def check(params: Params, like: Params, where: str) -> None:
    """Insist that parameters have the paths and shapes that a configuration gives them.

    Args:
        params: what was read.
        like: arrays, or abstract arrays (``jax.eval_shape``), of the expected paths and shapes.
        where: the file, for the message.

    Raises:
        TreeError: with the list of differences.
    """
    tree.require_like(params, like, where)


def metadata(path: Path) -> dict[str, str]:
    """Read only the words that ``save`` put in the header.

    Raises:
        UserError: the file is absent or damaged.
    """
    _require_file(path)
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            return json.loads((file.metadata() or {}).get(_WORDS, "{}"))
    except (safetensors.SafetensorError, OSError) as error:
        raise _damaged(path, error) from None


def _require_file(path: Path) -> None:
    if not path.is_file():
        raise UserError(f"{path} does not exist; train.py writes it when a stage is finished.")


def _damaged(path: Path, error: Exception) -> UserError:
    return UserError(f"{path} is damaged ({error}); delete it and start train.py again.")
