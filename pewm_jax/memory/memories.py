"""Every memory behind one interface, chosen by ``memory.kind``: what a world remembers.

    memory = empty(config, centre)                          # around where the agent is
    memory = remember(config, memory, frames, features)     # posed RGB-D frames
    seen = tokens(config, memory, camera)                   # what conditions one clip

======== ============================================ =====================================
kind     what it keeps                                paper
======== ============================================ =====================================
voxel    maximum of features per 3D cell              ours
none     nothing                                      NWM (own backbone, empty memory)
images   features of a few covering snapshots         Image Memory (3D-Mem)
map2d    maximum of features per place on the floor   Ours (w/ 2D-Map)
points   a coloured point per 3D cell, no features    point cloud (ablation of the map)
======== ============================================ =====================================

All are pytrees of static size, and their tokens have the same shapes, so that the networks that
read them have the same parameters. The functions are pure, for one world: jit and vmap them.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from pewm_jax.config import Config
from pewm_jax.memory import features as image_features
from pewm_jax.memory import images, map2d, nothing, points, voxel_map
from pewm_jax.memory.images import Snapshots
from pewm_jax.memory.nothing import Nothing
from pewm_jax.memory.points import PointCloud
from pewm_jax.models import world_model
from pewm_jax.types import Array, Camera, Frames, MapTokens, VoxelMap

Memory: TypeAlias = VoxelMap | Snapshots | PointCloud | Nothing
"""Whatever a world remembers; which of these, ``memory.kind`` says."""


def empty(config: Config, centre_3: Array) -> Memory:
    """Return a memory of nothing.

    Args:
        config: the experiment.
        centre_3: (3,) world position that the grid is centred on, metres.
    """
    channels = world_model.feature_channels(config)
    match config.memory.kind:
        case "voxel":
            return voxel_map.empty(config.memory, centre_3, channels)
        case "map2d":
            return map2d.empty(config.memory, centre_3, channels)
        case "images":
            return images.empty(config, centre_3, channels)
        case "points":
            return points.empty(config.memory, centre_3)
        case "none":
            return Nothing()


def remember(
    config: Config,
    memory: Memory,
    frames: Frames,
    features_ThwF: Array,
    valid_T: Array | None = None,
) -> Memory:
    """Return the memory after T more frames.

    Args:
        config: the experiment.
        memory: from ``empty`` or from an earlier call.
        frames: T frames, colours float in [−1, 1]; pixels without depth leave no trace.
        features_ThwF: (T, h, w, F) their patch features (``features.encode``).
        valid_T: (T,) bool; False frames are ignored.
    """
    match memory:
        case VoxelMap():
            settings = config.memory
            if config.memory.kind == "map2d":
                settings = map2d.flattened(settings)
            return voxel_map.insert_frames(settings, memory, frames, features_ThwF, valid_T)
        case Snapshots():
            return images.remember(config, memory, frames, features_ThwF, valid_T)
        case PointCloud():
            return points.remember(config.memory, memory, frames, valid_T)
        case Nothing():
            return memory


def tokens(config: Config, memory: Memory, camera: Camera) -> MapTokens:
    """Return the M = ``memory.tokens`` tokens that condition one clip.

    Args:
        config: the experiment.
        memory: what is remembered.
        camera: (T,) cameras of the clip.
    """
    channels = world_model.feature_channels(config)
    size = (config.clip.height, config.clip.width)
    match memory:
        case VoxelMap():
            settings = config.memory
            if config.memory.kind == "map2d":
                settings = map2d.flattened(settings)
            return voxel_map.tokens(settings, memory, camera, size)
        case Snapshots():
            return images.tokens(config.memory, memory)
        case PointCloud():
            return points.tokens(config.memory, memory, camera, size, channels)
        case Nothing():
            return nothing.tokens(config.memory.tokens, channels)


def to_points(config: Config, memory: Memory) -> tuple[Array, Array, Array]:
    """Return all that is remembered as ``(points_world_V3, features_VF, valid_V)``.

    V is static; the memory ``none`` has one place, never taken.
    """
    channels = world_model.feature_channels(config)
    match memory:
        case VoxelMap():
            settings = config.memory
            if config.memory.kind == "map2d":
                settings = map2d.flattened(settings)
            return voxel_map.to_points(settings, memory)
        case Snapshots():
            return images.to_points(memory)
        case PointCloud():
            return points.to_points(memory, channels)
        case Nothing():
            blank = nothing.tokens(1, channels)
            return blank.points_world_M3, blank.features_MF, blank.valid_M


def colours(config: Config, features_VF: Array) -> np.ndarray:
    """Return (V, 3) colours in [−1, 1] to draw remembered places with."""
    values = np.asarray(features_VF)
    if config.memory.kind == "points" or not len(values):
        return values[..., :3]
    return image_features.colours(values)
