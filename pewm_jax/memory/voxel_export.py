"""Export of a voxel map to PLY (z up, as in this library) and GLB (y up, as glTF requires).

Cells are written as points, or as boxes slightly smaller than the cells. Both formats are a header
and three arrays, so no library is needed to write them.
"""

from __future__ import annotations

import functools
import itertools
import json
import struct
from pathlib import Path
from typing import Literal

import numpy as np

from pewm_jax.config import Memory, UserError
from pewm_jax.config.parts import Encoder
from pewm_jax.io import atomic
from pewm_jax.memory import voxel_core
from pewm_jax.types import Array, VoxelMap

FILLED = 0.9
"""Side of a cube over the side of its cell; the gap makes neighbours distinguishable."""
_CORNERS = np.asarray(list(itertools.product((-0.5, 0.5), repeat=3)), np.float32)
_SIDES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
_TRIANGLES = np.asarray([t for a, b, c, d in _SIDES for t in ((a, b, c), (a, c, d))], np.int32)
"""Twelve triangles of a cube's corners, counter-clockwise from outside."""


def export(
    config: Memory,
    voxels: VoxelMap,
    path: Path,
    *,
    style: Literal["cubes", "points"] = "cubes",
    colours_V3: Array | None = None,
) -> None:
    """Write the occupied cells with their colours to a file, atomically.

    Args:
        config: the map's settings.
        voxels: one map.
        path: the file, whose suffix ``.ply`` or ``.glb`` is the format; its folder is created.
        style: `cubes` or `points`.
        colours_V3: (V, 3) colours in [−1, 1] of all slots. By default ``Encoder.colours``: the
            true colours if features are colours, else three principal components.

    Raises:
        UserError: the suffix is unknown, or the map is empty.
    """
    path = Path(path)
    write = {".ply": _ply, ".glb": _glb}.get(path.suffix.lower())
    if write is None:
        raise UserError(f"{path} ends neither in .ply nor in .glb; name the file by its format.")
    points, values, valid = (np.asarray(x) for x in voxel_core.to_points(config, voxels))
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
        partial.write_bytes(write(points.astype(np.float32), colours, triangles))


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
