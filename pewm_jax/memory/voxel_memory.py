"""The voxel map as a memory: the functions that ``memories`` requires."""

from __future__ import annotations

from pewm_jax.config import ModelConfig
from pewm_jax.memory import voxel_map
from pewm_jax.types import Array, Camera, Frames, MapTokens, VoxelMap


def empty(model: ModelConfig, centre_3: Array) -> VoxelMap:
    """Return an empty map with a grid centred on a world position."""
    return voxel_map.empty(model.memory, centre_3, model.memory.encoder.channels)


def remember(
    model: ModelConfig,
    voxels: VoxelMap,
    frames: Frames,
    features_ThwF: Array,
    valid_T: Array | None = None,
) -> VoxelMap:
    """Insert the pixels of frames; see ``voxel_map.insert_frames``."""
    return voxel_map.insert_frames(model.memory, voxels, frames, features_ThwF, valid_T)


def tokens(model: ModelConfig, voxels: VoxelMap, camera: Camera) -> MapTokens:
    """Choose the cells that condition one clip; see ``voxel_map.tokens``."""
    return voxel_map.tokens(model.memory, voxels, camera, (model.clip.height, model.clip.width))


def to_points(model: ModelConfig, voxels: VoxelMap) -> tuple[Array, Array, Array]:
    """Return centre, features and validity of all slots."""
    return voxel_map.to_points(model.memory, voxels)


def erase(model: ModelConfig, voxels: VoxelMap, box_23: Array) -> VoxelMap:
    """Forget a box; see ``voxel_map.erase``."""
    return voxel_map.erase(model.memory, voxels, box_23)


def move(
    model: ModelConfig, voxels: VoxelMap, box_23: Array, transform: Array, *, leave: bool = False
) -> VoxelMap:
    """Move or copy what is in a box; see ``voxel_map.move``."""
    return voxel_map.move(model.memory, voxels, box_23, transform, leave=leave)
