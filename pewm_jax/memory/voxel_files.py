"""Saving and loading a voxel map exactly, as a safetensors file of its occupied cells."""

from __future__ import annotations

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from pewm_jax.config import Memory, UserError
from pewm_jax.io import weights
from pewm_jax.memory import voxel_cells
from pewm_jax.types import VoxelMap

NAMES = {"cells_NI": "int32", "counts_3": "int32", "features_NF": "", "origin_3": "float32"}
"""The tensors in a file and their dtypes; features may be float32, bfloat16 or float16."""


def save(config: Memory, voxels: VoxelMap, path: Path) -> None:
    """Write a map atomically; free slots take no space.

    Args:
        config: the map's settings; cell size and extent are stored in the file.
        voxels: one map, not a batch.
        path: the file, usually ``map.safetensors``; its folder is created.

    Raises:
        UserError: the map is a batch of maps.
    """
    cell_V = np.asarray(voxels.cell_of_slot_V)
    if cell_V.ndim != 1:
        raise UserError(f"save() got a batch of maps of shape {cell_V.shape}; give one map.")
    held = cell_V < voxel_cells.nowhere(config)
    metadata = {"format": "voxel map 1", "cell_m": json.dumps(config.cell_m)}
    metadata["cells"] = json.dumps(config.cells)
    tensors = {
        "cells_NI": np.stack(np.unravel_index(cell_V[held], config.cells), -1).astype(np.int32),
        "counts_3": np.asarray([voxels.occupied, voxels.dropped, voxels.outside], np.int32),
        "features_NF": np.asarray(voxels.features_VF)[held],
        "origin_3": np.asarray(voxels.origin_3),
    }
    weights.save(Path(path), tensors, metadata)


def load(config: Memory, path: Path) -> VoxelMap:
    """Read a map written by ``save``.

    Args:
        config: cell size and extent must equal the file's; the capacity may differ as long as all
            cells fit.
        path: the file.

    Raises:
        UserError: the file is absent, damaged, not a map, of another grid, or has more cells than
            the capacity.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path} does not exist; give a file that save() has written.")
    metadata, tensors = weights.metadata(path), weights.load(path)
    _check(config, path, metadata, tensors)
    grid, features = tensors["cells_NI"], tensors["features_NF"]
    count, no_cell = len(grid), voxel_cells.nowhere(config)
    cell_V = np.full((config.capacity,), no_cell, np.int32)
    cell_V[:count] = np.ravel_multi_index(tuple(grid.T), config.cells)
    if (np.diff(cell_V[:count]) <= 0).any() or tensors["counts_3"][0] != count:
        raise UserError(f"{path} is damaged: its cells are not in order; write it again.")
    features_VF = np.full((config.capacity, features.shape[1]), -np.inf, features.dtype)
    features_VF[:count] = features
    occupied, dropped, outside = (jnp.asarray(n) for n in tensors["counts_3"])
    return VoxelMap(
        cell_of_slot_V=jnp.asarray(cell_V),
        features_VF=jnp.asarray(features_VF),
        origin_3=jnp.asarray(tensors["origin_3"]),
        occupied=occupied,
        dropped=dropped,
        outside=outside,
    )


def _check(config: Memory, path: Path, metadata: dict, tensors: dict) -> None:
    """Refuse a file that is not an intact map of this grid, or does not fit the capacity."""
    if metadata.get("format") != "voxel map 1" or tensors.keys() != NAMES.keys():
        raise UserError(f"{path} is not a voxel map; give a file that save() has written.")
    for name, wanted in (("cell_m", config.cell_m), ("cells", config.cells)):
        stored = json.loads(metadata.get(name, "null"))
        if stored != list(wanted):
            raise UserError(
                f"{path} has memory.{name} {stored}, the settings say {list(wanted)}: load it with "
                "the settings it was made with."
            )
    grid, features = tensors["cells_NI"], tensors["features_NF"]
    shapes = [tensors[name].shape for name in NAMES]
    expected = [(len(grid), 3), (3,), (len(grid), *features.shape[1:]), (3,)]
    dtypes = [dtype in ("", str(tensors[name].dtype)) for name, dtype in NAMES.items()]
    floats = jnp.issubdtype(features.dtype, jnp.floating) and features.ndim == 2
    if shapes != expected or not all(dtypes) or not floats or (grid < 0).any():
        raise UserError(f"{path} is damaged: its tensors do not fit together; write it again.")
    if (grid >= np.asarray(config.cells)).any():
        raise UserError(f"{path} is damaged: it has cells beyond its extent; write it again.")
    if len(grid) > config.capacity:
        raise UserError(
            f"{path} holds {len(grid)} cells and memory.capacity is {config.capacity}: raise the "
            "capacity."
        )
