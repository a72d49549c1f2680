"""Files of a voxel map: exact saving as safetensors, export to PLY (z up) and GLB (y up)."""

from __future__ import annotations

import functools
import itertools
import json
import struct
from pathlib import Path
from typing import Literal

import jax.numpy as jnp
import numpy as np

from pewm_jax.config import Memory, UserError
from pewm_jax.config.parts import Encoder
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
_CORNERS = np.asarray(list(itertools.product((-0.5, 0.5), repeat=3)), np.float32)
_SIDES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
_TRIANGLES = np.asarray([t for a, b, c, d in _SIDES for t in ((a, b, c), (a, c, d))], np.int32)
"""Twelve triangles of a cube's corners, counter-clockwise from outside."""


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
    path = Path(path)
    encode = {".ply": _ply, ".glb": _glb}.get(path.suffix.lower())
    if encode is None:
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
    triangles = None
    if style == "cubes":
        corners = _CORNERS * np.asarray(config.cell_m, np.float32) * FILLED
        triangles = (np.arange(len(points))[:, None, None] * 8 + _TRIANGLES).reshape(-1, 3)
        points = (points[:, None] + corners).reshape(-1, 3)
        colours = np.repeat(colours, 8, axis=0)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic.replacing(path) as partial:
        partial.write_bytes(encode(points.astype(np.float32), colours, triangles))


def _ply(points_N3: np.ndarray, colours_N3: np.ndarray, triangles: np.ndarray | None) -> bytes:
    """Return a binary little-endian PLY file."""
    position = [(axis, "<f4") for axis in "xyz"]
    shade = [(name, "u1") for name in ("red", "green", "blue")]
    vertices = np.empty(len(points_N3), position + shade)
    for (name, _), column in zip(position + shade, [*points_N3.T, *colours_N3.T], strict=True):
        vertices[name] = column
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name, _ in position]
    header += [f"property uchar {name}" for name, _ in shade]
    body = vertices.tobytes()
    if triangles is not None:
        faces = np.empty(len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
        faces["count"], faces["corners"] = 3, triangles
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        body += faces.tobytes()
    return "\n".join([*header, "end_header", ""]).encode() + body


def _glb(points_N3: np.ndarray, colours_N3: np.ndarray, triangles: np.ndarray | None) -> bytes:
    """Return a binary glTF 2.0 file; the world's z axis becomes y."""
    points = np.stack([points_N3[:, 0], points_N3[:, 2], -points_N3[:, 1]], -1).astype("<f4")
    opaque = np.concatenate([colours_N3, np.full((len(points), 1), 255, np.uint8)], -1)
    parts = [points.tobytes(), opaque.tobytes()]
    accessors: list[dict] = [
        {"componentType": 5126, "count": len(points), "type": "VEC3"},
        {"componentType": 5121, "count": len(points), "type": "VEC4", "normalized": True},
    ]
    accessors[0] |= {"min": points.min(0).tolist(), "max": points.max(0).tolist()}
    primitive: dict = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "mode": 0}
    if triangles is not None:
        parts.append(triangles.astype("<u4").tobytes())
        accessors.append({"componentType": 5125, "count": triangles.size, "type": "SCALAR"})
        primitive |= {"indices": 2, "mode": 4}
    ends = np.cumsum([len(part) for part in parts]).tolist()
    scene = {
        "asset": {"version": "2.0", "generator": "pewm_jax"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "map"}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": [accessor | {"bufferView": i} for i, accessor in enumerate(accessors)],
        "bufferViews": [
            {"buffer": 0, "byteOffset": end - len(part), "byteLength": len(part)}
            for end, part in zip(ends, parts, strict=True)
        ],
        "buffers": [{"byteLength": ends[-1]}],
    }
    text = json.dumps(scene, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + ends[-1]
    head = struct.pack("<4sII", b"glTF", 2, size) + struct.pack("<I4s", len(text), b"JSON") + text
    return head + struct.pack("<I4s", ends[-1], b"BIN\0") + b"".join(parts)
