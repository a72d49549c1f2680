"""Network weights as one safetensors file with flat ``a/b/c`` keys; loading executes no code.

Trees of arrays, stored by ``tensor_files``. A kernel may be stored in 8 bits, with its scales under
its name and ``SCALE``; it is read as float32.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from importlib.machinery import ModuleSpec
from pathlib import Path

import jax
import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.io import pickles, tensor_files, tree
from pewm_jax.types import Array, Params

SCALE = "#scale"
"""End of the names of the scales of kernels that are stored in 8 bits."""


def save(
    path: Path,
    params: Params,
    metadata: Mapping[str, str] | None = None,
    progress: Callable[[int], None] = lambda _: None,
) -> None:
    """Write nested dictionaries of arrays, on any device, to a file, atomically.

    Args:
        path: usually ``weights.safetensors``; its folder is created.
        params: the parameters.
        metadata: stored in the file's header.
        progress: called after every leaf with the bytes just written.
    """
    leaves = tree.flatten(params)
    like = {name: jax.ShapeDtypeStruct(np.shape(x), _dtype(x)) for name, x in leaves.items()}
    tensor_files.write(path, like, leaves.items(), tensor_files.header(metadata or {}), progress)


def load(path: Path, part: str = "") -> Params:
    """Read parameters written by ``save`` as nested dictionaries of NumPy arrays.

    Args:
        path: a safetensors file.
        part: read only this branch of the tree, such as ``backbone``; by default the whole tree.

    Raises:
        UserError: the file is missing or damaged, or has no such branch.
    """
    prefix = f"{part}/" if part else ""
    found = {
        name.removeprefix(prefix): array
        for name, array in tensor_files.read(path, lambda name: name.startswith(prefix))
    }
    if part and not found:
        raise UserError(f"{path} contains no {part}; use weights that have it.")
    return tree.unflatten(_wide(found, path))


def lazy(path: Path) -> Params:
    """Memory-map a weights file: only the indexed part of each array is read.

    Kernels in 8 bits are read and expanded to float32. Otherwise like ``load``, but checksums are
    not verified; ``verify`` does that.
    """
    return tree.unflatten(_wide(tensor_files.mapped(path), path))


def _wide(found: Mapping[str, np.ndarray], path: Path) -> dict[str, np.ndarray]:
    """Multiply kernels in 8 bits by their scales."""
    arrays = {name: array for name, array in found.items() if not name.endswith(SCALE)}
    for name, scale in found.items():
        if name not in arrays:
            kernel = name.removesuffix(SCALE)
            if kernel not in arrays:
                raise UserError(f"{path} has scales and no kernel {kernel}; write it again.")
            arrays[kernel] = arrays[kernel].astype(np.float32) * scale
    return arrays


def read_others(path: Path, of: str) -> dict[str, np.ndarray]:
    """Read the tensors of another library's file, safetensors or a pickle, by their names.

    Raises:
        UserError: the file is missing or damaged; ``of`` is the owner of the weights in the
            message.
    """
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise UserError(f"{path} {what}; give the path of a file with the weights of {of}.")
    if path.suffix == ".safetensors":
        return dict(tensor_files.read(path))
    return dict(tree.flatten(pickles.read(path)))


def packaged(spec: ModuleSpec | None, name: str) -> Path | None:
    """Return a file of weights in a package that was found, or None; it is not imported."""
    for folder in (spec.submodule_search_locations if spec else None) or ():
        path = Path(folder) / "weights" / name
        if path.is_file():
            return path
    return None


def require_shapes(
    flat: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]], where: str
) -> Params:
    """Return the tree of arrays, in float32, if they have these paths and shapes; see ``check``."""
    arrays = {name: np.ascontiguousarray(x, np.float32) for name, x in flat.items()}
    like = {name: jax.ShapeDtypeStruct(shape, np.float32) for name, shape in shapes.items()}
    params = tree.unflatten(arrays)
    check(params, tree.unflatten(like), where)
    return params


def verify(path: Path) -> None:
    """Read a whole file, tensor by tensor, and verify its checksums; raises as ``load``."""
    for _ in tensor_files.read(path):
        pass


check = tree.require_like
"""Raise TreeError if parameters do not have the paths and shapes of a tree."""


def metadata(path: Path) -> dict[str, str]:
    """Read only the metadata in the header; raises as ``load``."""
    return json.loads(tensor_files.metadata(path).get(tensor_files.OURS, "{}"))


def _dtype(leaf: Array) -> np.dtype:
    return np.dtype(leaf.dtype) if hasattr(leaf, "dtype") else np.asarray(leaf).dtype
