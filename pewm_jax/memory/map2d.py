"""A feature map seen from above: the voxel map with one layer of cells as high as its extent.

The rival "2D map" of the paper's Table 1. All that stands above one place of the floor is one
cell, the maximum of its features; a token stands at the height the grid is centred on.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from pewm_jax.config import MemoryConfig
from pewm_jax.memory import voxel_map
from pewm_jax.types import Array, VoxelMap


def flattened(config: MemoryConfig) -> MemoryConfig:
    """Return the settings of the voxel map that a 2D map is."""
    (x, y, z), (nx, ny, nz) = config.cell_m, config.cells
    return dataclasses.replace(config, cell_m=(x, y, z * nz), cells=(nx, ny, 1))


def empty(config: MemoryConfig, centre_3: Array, channels: int) -> VoxelMap:
    """Return a 2D map that has seen nothing; arguments as for ``voxel_map.empty``.

    The single layer is centred on the given height exactly: snapped to its whole height, as the
    sides are to theirs, it could miss the room.
    """
    flat = flattened(config)
    voxels = voxel_map.empty(flat, centre_3, channels)
    bottom = jnp.asarray(centre_3, jnp.float32)[2] - flat.cell_m[2] / 2
    return dataclasses.replace(voxels, origin_3=voxels.origin_3.at[2].set(bottom))
