"""Files of a voxel map: exact saving as safetensors, export to PLY (z up) and GLB (y up)."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from pewm_jax.config import Memory, UserError
from pewm_jax.config.parts import Encoder
from pewm_jax.geometry.cameras import Y_UP_FROM_Z_UP
from pewm_jax.io import atomic, weights
from pewm_jax.memory import cells
from pewm_jax.types import Array, VoxelMap

NAMES = {"cells_NI": "int32", "counts_3": "int32", "features_NF": "", "origin_3": "float32"}
"""The tensors in a file and their dtypes; features may be float32, bfloat16 or float16."""


def save(config: Memory, voxels: VoxelMap, path: Path) -> None:
    """Write one map atomically, with its cell size and extent; free slots take no space.

    Raises:
        UserError: the map is a batch of maps.
    """
    cell_V = np.asarray(voxels.cell_of_slot_V)
    if cell_V.ndim != 1:
        raise UserError(f"save() got a batch of maps of shape {cell_V.shape}; give one map.")
    held = cell_V < cells.nowhere(config)
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
    """Read a map written by ``save``; the capacity may differ if all cells fit.

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
    count, no_cell = len(grid), cells.nowhere(config)
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


FILLED = 0.9
"""Side of a cube over the side of its cell; the gap makes neighbours distinguishable."""


def write(
    config: Memory,
    points_V3: Array,
    values_VF: Array,
    valid_V: Array,
    path: Path,
    style: Literal["cubes", "points"],
    colours_V3: Array | None,
) -> None:
    """Write the cells of a map to PLY or GLB; ``voxel_map.export`` documents the arguments."""
    import trimesh  # noqa: PLC0415 - only exports need it

    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (".ply", ".glb"):
        raise UserError(f"{path} ends neither in .ply nor in .glb; name the file by its format.")
    points, values, valid = (np.asarray(x) for x in (points_V3, values_VF, valid_V))
    if not valid.any():
        raise UserError(f"the map is empty, so {path} is not written; insert something first.")
    points = points[valid]
    if colours_V3 is None:
        fits = values.shape[-1] == config.encoder.channels
        draw = (
            config.encoder.colours if fits else functools.partial(Encoder.colours, config.encoder)
        )
        chosen = draw(values[valid])
    else:
        chosen = np.asarray(colours_V3, np.float32)[valid]
    chosen = np.pad(chosen, ((0, 0), (0, 3 - chosen.shape[1])))
    colours = ((np.clip(chosen, -1, 1) + 1) * 127.5).round().astype(np.uint8)
    if style == "cubes":
        cube = trimesh.creation.box(np.asarray(config.cell_m) * FILLED)
        faces = (np.arange(len(points))[:, None, None] * 8 + cube.faces).reshape(-1, 3)
        corners = (points[:, None] + cube.vertices).reshape(-1, 3)
        shades = np.repeat(colours, 8, axis=0)
        shape = trimesh.Trimesh(corners, faces, vertex_colors=shades, process=False)
    else:
        shape = trimesh.PointCloud(points, colours)
    if kind == ".glb":
        shape = trimesh.Scene({"map": shape.apply_transform(Y_UP_FROM_Z_UP)})
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic.replacing(path) as partial:
        data: Any = shape.export(file_type=kind[1:])
        partial.write_bytes(data)
