"""The 3D voxel feature map: a jitted scatter-max with occupancy.

A pytree of static capacity: features are kept for *occupied* cells only; the grid itself is one
integer per cell. Cells start at −inf and not at 0, so that negative features survive and an
unobserved cell is not a cell with feature 0. A cell's feature is the maximum over all points that
ever fell into it, so neither order nor repetition of points matters. Cells that do not fit are
counted in ``dropped``, points beyond the extent in ``outside``; which cells stay is deterministic
(earlier insertions first, within one insertion by cell index).
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import MemoryConfig
from pewm_jax.geometry.cameras import project, unproject
from pewm_jax.types import Array, Camera, Frames, MapTokens, VoxelMap


def empty(config: MemoryConfig, centre_3: Array, channels: int) -> VoxelMap:
    """Return a map that has seen nothing.

    Args:
        config: cell size, extent, capacity.
        centre_3: (3,) world position the grid is centred on, metres; the grid's corner is
            snapped to whole cells so that maps of one world share their cells.
        channels: features F per cell.
    """
    cell = np.asarray(config.cell_m, np.float32)
    half = np.asarray(config.cells, np.float32) * cell / 2
    origin = jnp.round((jnp.asarray(centre_3) - half) / cell) * cell
    cells = math.prod(config.cells)
    zero = jnp.zeros((), jnp.int32)
    return VoxelMap(
        slot_of_cell=jnp.full((cells,), -1, jnp.int32),
        cell_of_slot_V=jnp.full((config.capacity,), -1, jnp.int32),
        features_VF=jnp.full((config.capacity, channels), -jnp.inf, jnp.float32),
        origin_3=origin.astype(jnp.float32),
        occupied=zero,
        dropped=zero,
        outside=zero,
    )


def cell_index(config: MemoryConfig, origin_3: Array, points_P3: Array) -> Array:
    """Return (P,) the linear cell index of each point, or the number of cells if outside."""
    cells = math.prod(config.cells)
    place = jnp.floor((points_P3 - origin_3) / np.asarray(config.cell_m, np.float32))
    limit = np.asarray(config.cells, np.float32)
    inside = jnp.all((place >= 0) & (place < limit), -1)
    x, y, z = (jnp.where(inside, place[..., i], 0).astype(jnp.int32) for i in range(3))
    _, ny, nz = config.cells
    return jnp.where(inside, (x * ny + y) * nz + z, cells)


def cell_centres(config: MemoryConfig, origin_3: Array, cell_V: Array) -> Array:
    """Return (V, 3) world centres of linear cell indices."""
    _, ny, nz = config.cells
    grid = jnp.stack([cell_V // (ny * nz), cell_V // nz % ny, cell_V % nz], -1)
    return origin_3 + (grid + 0.5) * np.asarray(config.cell_m, np.float32)


def insert(
    config: MemoryConfig, voxels: VoxelMap, points_P3: Array, features_PF: Array, valid_P: Array
) -> VoxelMap:
    """Insert points by scatter-max.

    Args:
        config: cell size, extent, capacity.
        voxels: the map.
        points_P3: (P, 3) world points, metres.
        features_PF: (P, F) their features.
        valid_P: (P,) bool; False points are ignored.

    Returns:
        The map after the insertion.
    """
    cells, capacity = voxels.slot_of_cell.shape[0], voxels.cell_of_slot_V.shape[0]
    finite = jnp.isfinite(points_P3).all(-1)
    cell = cell_index(config, voxels.origin_3, jnp.where(finite[:, None], points_P3, jnp.inf))
    outside = (valid_P & (cell == cells)).sum(dtype=jnp.int32)
    cell = jnp.where(valid_P, cell, cells)

    touched = jnp.zeros((cells,), bool).at[cell].set(True, mode="drop")
    new = touched & (voxels.slot_of_cell < 0)
    slot = voxels.occupied + jnp.cumsum(new, dtype=jnp.int32) - 1
    kept = new & (slot < capacity)
    slot_of_cell = jnp.where(kept, slot, voxels.slot_of_cell)
    cell_of_slot = voxels.cell_of_slot_V.at[jnp.where(kept, slot, capacity)].set(
        jnp.arange(cells, dtype=jnp.int32), mode="drop"
    )
    target = slot_of_cell.at[cell].get(mode="fill", fill_value=-1)
    target = jnp.where(target < 0, capacity, target)
    return VoxelMap(
        slot_of_cell=slot_of_cell,
        cell_of_slot_V=cell_of_slot,
        features_VF=voxels.features_VF.at[target].max(features_PF, mode="drop"),
        origin_3=voxels.origin_3,
        occupied=voxels.occupied + kept.sum(dtype=jnp.int32),
        dropped=voxels.dropped + (new & ~kept).sum(dtype=jnp.int32),
        outside=voxels.outside + outside,
    )


def insert_frames(
    config: MemoryConfig,
    voxels: VoxelMap,
    frames: Frames,
    features_ThwF: Array,
    valid_T: Array | None = None,
) -> VoxelMap:
    """Insert posed depth frames: upsample their features, unproject every pixel, scatter-max.

    Args:
        config: cell size, extent, capacity.
        voxels: the map.
        frames: T frames, of which depth and cameras are used; pixels without depth are ignored.
        features_ThwF: (T, h, w, F) features of a grid of patches that covers each frame; they
            are upsampled bilinearly, patch centres at half-integers.
        valid_T: (T,) bool, False frames are ignored.
    """
    shape = (*frames.depth_THW.shape, features_ThwF.shape[-1])
    features = jax.image.resize(features_ThwF, shape, "bilinear")
    points = unproject(frames.depth_THW, frames.camera)
    valid = frames.depth_THW > 0
    if valid_T is not None:
        valid = valid & valid_T[:, None, None]
    return insert(
        config,
        voxels,
        points.reshape(-1, 3),
        features.reshape(-1, features.shape[-1]),
        valid.reshape(-1),
    )


def to_points(config: MemoryConfig, voxels: VoxelMap) -> tuple[Array, Array, Array]:
    """Return all slots as ``(points_world_V3, features_VF, valid_V)``; free slots are 0."""
    valid = voxels.cell_of_slot_V >= 0
    points = cell_centres(config, voxels.origin_3, jnp.maximum(voxels.cell_of_slot_V, 0))
    features = jnp.where(valid[:, None], voxels.features_VF, 0.0)
    return points, features, valid


def tokens(
    config: MemoryConfig, voxels: VoxelMap, camera: Camera, size: tuple[int, int]
) -> MapTokens:
    """Choose the M cells that condition one clip.

    Cells inside the view of any of the clip's cameras come first, nearest first (by the smallest
    depth at which a camera sees them); then the others by distance to the nearest camera. Ties
    go to the lower slot. Fewer than M occupied cells leave masked tokens.

    Args:
        config: gives M.
        voxels: the map.
        camera: (T,) cameras of the clip.
        size: image height and width in pixels.
    """
    points, features, valid = to_points(config, voxels)
    uv, z = project(points[None], camera)
    limit = np.array([size[1], size[0]], np.float32)
    seen = jnp.all((uv >= 0) & (uv <= limit), -1) & (z > 0)
    depth = jnp.where(seen, z, jnp.inf).min(0)
    centres = camera.world_from_camera[:, None, :3, 3]
    distance = jnp.linalg.norm(points[None] - centres, axis=-1).min(0)
    far = 1e4
    score = jnp.where(jnp.isfinite(depth), depth, far + distance)
    score = jnp.where(valid, score, jnp.inf)
    _, order = jax.lax.top_k(-score, config.tokens)
    return MapTokens(features[order], points[order], valid[order])
