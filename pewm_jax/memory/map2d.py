"""A feature map seen from above: the voxel map with a single layer of cells.

The rival "2D map" of the paper's Table 1. Everything above one square of the floor falls into one
cell, which keeps the maximum of the features. Tokens are at the height of the grid's centre.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from pewm_jax.config import Memory, ModelConfig
from pewm_jax.memory import voxel_map
from pewm_jax.types import Array, Camera, Frames, MapTokens, VoxelMap


def flattened(config: Memory) -> Memory:
    """Return the settings of the voxel map with one layer that implements the 2D map."""
    (x, y, z), (nx, ny, nz) = config.cell_m, config.cells
    return dataclasses.replace(config, cell_m=(x, y, z * nz), cells=(nx, ny, 1))


def empty(model: ModelConfig, centre_3: Array) -> VoxelMap:
    """Return an empty 2D map.

    The single layer is centred exactly on the given height. If it were snapped to multiples of the
    cell's height, like the horizontal position, it could miss the room.
    """
    flat = flattened(model.memory)
    voxels = voxel_map.empty(flat, centre_3, model.memory.encoder.channels)
    bottom = jnp.asarray(centre_3, jnp.float32)[2] - flat.cell_m[2] / 2
    return dataclasses.replace(voxels, origin_3=voxels.origin_3.at[2].set(bottom))


def remember(
    model: ModelConfig,
    voxels: VoxelMap,
    frames: Frames,
    features_ThwF: Array,
    valid_T: Array | None = None,
) -> VoxelMap:
    """Insert the pixels of frames; see ``voxel_map.insert_frames``."""
    flat = flattened(model.memory)
    return voxel_map.insert_frames(flat, voxels, frames, features_ThwF, valid_T)


def tokens(model: ModelConfig, voxels: VoxelMap, camera: Camera) -> MapTokens:
    """Choose the cells that condition one clip; see ``voxel_map.tokens``."""
    size = (model.clip.height, model.clip.width)
    return voxel_map.tokens(flattened(model.memory), voxels, camera, size)


def to_points(model: ModelConfig, voxels: VoxelMap) -> tuple[Array, Array, Array]:
    """Return centre, features and validity of all slots."""
    return voxel_map.to_points(flattened(model.memory), voxels)
