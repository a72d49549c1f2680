"""Network weights as one safetensors file: flat ``a/b/c`` keys, nothing to execute on loading.

Trees of arrays in files of ``tensor_files``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import jax
import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.io import pickles as pickled_tensors
from pewm_jax.io import tensor_files, tree
from pewm_jax.types import Array, Params


def save(
    path: Path,
    params: Params,
    metadata: Mapping[str, str] | None = None,
    progress: Callable[[int], None] = lambda _: None,
) -> None:
    """Write parameters to ``path``, whole or not at all.

    Args:
        path: the file to write, by custom ``weights.safetensors``; its folder is made.
        params: nested dictionaries of arrays, on any device.
        metadata: a few facts about them, kept in the file's header.
        progress: called after every leaf with the bytes just written.
    """
    leaves = tree.flatten(params)
    like = {name: jax.ShapeDtypeStruct(np.shape(x), _dtype(x)) for name, x in leaves.items()}
    tensor_files.write(path, like, leaves.items(), tensor_files.header(metadata or {}), progress)


def load(path: Path, part: str = "") -> Params:
    """Read parameters written by ``save``.

    Args:
        path: a safetensors file.
        part: read only this branch of the tree, such as ``backbone``; by default all of it.

    Returns:
        Nested dictionaries of NumPy arrays.

    Raises:
        UserError: the file is absent or damaged, or holds no such branch.
    """
    prefix = f"{part}/" if part else ""
    found = {
        name.removeprefix(prefix): array
        for name, array in tensor_files.read(path, lambda name: name.startswith(prefix))
    }
    if part and not found:
        raise UserError(f"{path} holds no {part}; give weights that have it.")
    return tree.unflatten(found)


def lazy(path: Path) -> Params:
    """Map a file of weights into memory: of each array only the part that is indexed is read.

    Like ``load`` otherwise, but checksums are not compared; ``verify`` does that.
    """
    return tree.unflatten(tensor_files.mapped(path))


def read_others(path: Path, of: str) -> dict[str, np.ndarray]:
    """Read the tensors of a file that others wrote, by their names.

    Args:
        path: a safetensors file, or a pickle of tensors (``pickled_tensors.read``).
        of: whose weights they are, for the refusal.

    Raises:
        UserError: the file is absent or damaged.
    """
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise UserError(f"{path} {what}; name a file with the weights of {of}.")
    if path.suffix == ".safetensors":
        return dict(tensor_files.read(path))
    return dict(tree.flatten(pickled_tensors.read(path)))


def verify(path: Path) -> None:
    """Read a whole file, tensor by tensor, and compare it with the checksums in its header.

    Raises:
        UserError: the file is absent or damaged.
    """
    for _ in tensor_files.read(path):
        pass


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
    """Read only the metadata that ``save`` put in the header.

    Raises:
        UserError: the file is absent or damaged.
    """
    return json.loads(tensor_files.metadata(path).get(tensor_files.OURS, "{}"))


def _dtype(leaf: Array) -> np.dtype:
    return np.dtype(leaf.dtype) if hasattr(leaf, "dtype") else np.asarray(leaf).dtype
