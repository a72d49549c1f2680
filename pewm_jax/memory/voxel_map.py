"""The 3D voxel feature map: sparse, of static capacity, filled by scatter-max.

A cell's feature is the maximum over all points that ever fell into it. The order, batching and
repetition of points do not matter: as long as everything fits, maps of the same points are equal
bit for bit. Cells start at −inf, not at 0, so negative features survive, and an unobserved cell
differs from a cell with feature 0. Only *occupied* cells take memory; the grid's extent does not
matter (``voxel_cells``).

Nothing is lost silently. Cells that do not fit are counted in ``dropped``, once per insertion that
saw them, and points outside the grid in ``outside``. The choice of cells is deterministic: cells of
earlier insertions stay, and within one insertion lower cell numbers have precedence.

All functions from maps to maps are pure. They work under jit (``config`` is static) and vmap, with
donated maps, and with a batch of maps sharded over devices.

    voxels = empty(config, centre, channels)
    voxels = insert_frames(config, voxels, frames, patch_features)
    chair = copy(config, voxels, box)                    # (2, 3) corners, metres
    voxels = move(config, voxels, box, transform)
    export(config, voxels, "map.glb")

This module exports all functions of the map. They are defined in ``voxel_core``, ``voxel_cells``
(the list of cells), ``voxel_frames`` (the fused pass), ``voxel_edit``, ``voxel_files`` and
``voxel_export``.
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
