"""The 3D voxel feature map: scatter-max with occupancy, exact, sparse and of static capacity.

A cell's feature is the maximum over all points that ever fell into it, so neither order nor
batching nor repetition of points matters: while the capacity holds, maps of the same points are
equal bit for bit. Cells start at −inf and not at 0, so that negative features survive and an
unobserved cell is not a cell with feature 0. Memory is kept for *occupied* cells only; the grid's
extent costs nothing (``voxel_cells``).

Nothing is lost silently: cells that do not fit are counted in ``dropped``, once per insertion that
saw them, points beyond the extent in ``outside``. Which cells stay is deterministic: those of
earlier insertions, and within one insertion those of the lowest numbers.

All that make a map of a map are pure and work under jit (``config`` is static), vmap, donation of
the map, and with the batch of a vmapped map sharded over devices.

    voxels = empty(config, centre, channels)
    voxels = insert_frames(config, voxels, frames, patch_features)
    chair = copy(config, voxels, box)                    # (2, 3) corners, metres
    voxels = move(config, voxels, box, transform)
    export(config, voxels, "map.glb")

This module is the whole of it; the parts are in ``voxel_core``, ``voxel_cells`` (which cells are
kept), ``voxel_frames`` (the fused pass), ``voxel_edit``, ``voxel_files`` and ``voxel_export``.
"""

from __future__ import annotations

from pewm_jax.memory.voxel_core import (
    cell_centres,
    count,
    empty,
    insert,
    insert_frames,
    merge,
    to_points,
    tokens,
)
from pewm_jax.memory.voxel_edit import copy, erase, move, paste
from pewm_jax.memory.voxel_export import export
from pewm_jax.memory.voxel_files import load, save
from pewm_jax.types import VoxelMap

__all__ = [
    "VoxelMap",
    "cell_centres",
    "copy",
    "count",
    "empty",
    "erase",
    "export",
    "insert",
    "insert_frames",
    "load",
    "merge",
    "move",
    "paste",
    "save",
    "to_points",
    "tokens",
]
