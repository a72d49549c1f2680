"""The voxel map's operations except editing and files (see ``voxel_map``)."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import DTypeLike

from pewm_jax.config import Memory, UserError
from pewm_jax.memory import cells, voxel_cells, voxel_frames
from pewm_jax.types import Array, Camera, Frames, MapTokens, VoxelMap


def empty(
    config: Memory, centre_3: Array, channels: int, dtype: DTypeLike = jnp.float32
) -> VoxelMap:
    """Return an empty map.

    Args:
        config: cell size, extent, capacity.
        centre_3: (3,) world position the grid is centred on, metres; the grid's corner is
            snapped to whole cells so that maps of one world share their cells.
        channels: features F per cell.
        dtype: dtype of the features, float32 or bfloat16.
    """
    zero = jnp.zeros((), jnp.int32)
    return VoxelMap(
        cell_of_slot_V=jnp.full((config.capacity,), voxel_cells.nowhere(config), jnp.int32),
        features_VF=jnp.full((config.capacity, channels), -jnp.inf, dtype),
        origin_3=cells.origin(config, centre_3),
        occupied=zero,
        dropped=zero,
        outside=zero,
    )


def cell_centres(config: Memory, origin_3: Array, cell_V: Array) -> Array:
    """Return (V, 3) world centres of cell numbers (see ``cells.keys``)."""
    _, ny, nz = config.cells
    grid = jnp.stack([cell_V // (ny * nz), cell_V // nz % ny, cell_V % nz], -1)
    return origin_3 + (grid + 0.5) * np.asarray(config.cell_m, np.float32)


def insert(
    config: Memory, voxels: VoxelMap, points_P3: Array, features_PF: Array, valid_P: Array
) -> VoxelMap:
    """Insert points by scatter-max.

    Args:
        config: cell size, extent, capacity.
        voxels: the map.
        points_P3: (P, 3) world points, metres; NaN counts as outside the grid.
        features_PF: (P, F) their features, rounded to the map's dtype.
        valid_P: (P,) bool; False points are ignored.

    Returns:
        The map after the insertion.

    Raises:
        UserError: points, features, validity and the map's channels do not fit together.
    """
    points_P3, features_PF, valid_P = map(jnp.asarray, (points_P3, features_PF, valid_P))
    no_cell, size = voxel_cells.nowhere(config), len(points_P3)
    shapes = points_P3.shape, features_PF.shape, valid_P.shape
    wanted = (size, 3), (size, voxels.features_VF.shape[-1]), (size,)
    if shapes != wanted:
        raise UserError(
            "insert() got points, features and validity of shapes "
            f"{', '.join(map(str, shapes))}; this map takes {', '.join(map(str, wanted))}."
        )
    if size == 0:
        return voxels
    seen = cells.keys(config, voxels.origin_3, points_P3)
    beyond = (valid_P & (seen == no_cell)).sum(dtype=jnp.int32)
    seen = jnp.where(valid_P, seen, no_cell)
    cell_V, dropped = voxel_cells.admit(voxels.cell_of_slot_V, seen, no_cell)

    def read(start: Array, block: int) -> tuple[Array, Array]:
        cell, rows = (jax.lax.dynamic_slice_in_dim(x, start, block) for x in (seen, features_PF))
        slot, found = voxel_cells.find(cell_V, cell)
        return jnp.where(found & (cell < no_cell), slot, cell_V.shape[0]), rows

    rows = voxel_cells.relocate(voxels.cell_of_slot_V, voxels.features_VF, cell_V, no_cell)
    rows = voxel_cells.maximum_over_blocks(rows, jnp.asarray(size, jnp.int32), size, read)
    return renewed(config, voxels, cell_V, rows, dropped, beyond)


def insert_frames(
    config: Memory,
    voxels: VoxelMap,
    frames: Frames,
    features_ThwF: Array,
    valid_T: Array | None = None,
) -> VoxelMap:
    """Insert posed depth frames: upsampling, unprojection and maximum in one pass.

    The result equals upsampling the features to all pixels and inserting every pixel's point, up to
    rounding of the interpolation. The upsampled features are never stored (see ``voxel_frames``).

    Args:
        config: cell size, extent, capacity.
        voxels: the map.
        frames: T frames; depth and cameras are used, and pixels without depth are ignored.
        features_ThwF: (T, h, w, F) features of a grid of patches that covers each frame, float32
            or bfloat16; they are upsampled bilinearly in float32, patch centres at half-integers.
        valid_T: (T,) bool, False frames are ignored.

    Raises:
        UserError: frames, features and the map's channels do not fit together.
    """
    no_cell, depth_THW = voxel_cells.nowhere(config), jnp.asarray(frames.depth_THW)
    count, channels = len(depth_THW), voxels.features_VF.shape[-1]
    shape = jnp.shape(features_ThwF)
    if len(shape) != 4 or (shape[0], shape[-1]) != (count, channels):
        raise UserError(
            f"insert_frames() got features of shape {shape} for {count} frames and a map of "
            f"{channels} channels; give ({count}, rows, columns, {channels})."
        )
    camera = jax.tree.map(jnp.asarray, frames.camera)
    seen = voxel_frames.pixel_cells(config, voxels.origin_3, depth_THW, camera)
    valid = depth_THW > 0
    if valid_T is not None:
        valid = valid & jnp.asarray(valid_T)[:, None, None]
    beyond = (valid & (seen == no_cell)).sum(dtype=jnp.int32)
    seen = jnp.where(valid, seen, no_cell)
    cell_V, rows, dropped = voxel_frames.insert(
        config, voxels.cell_of_slot_V, voxels.features_VF, seen, jnp.asarray(features_ThwF)
    )
    return renewed(config, voxels, cell_V, rows, dropped, beyond)


def merge(config: Memory, a: VoxelMap, b: VoxelMap) -> VoxelMap:
    """Return the union of two maps of one world: the maximum where both have a cell.

    As long as everything fits, merging equals inserting the points of both into one map. Counts of
    dropped cells and of points outside are added.

    Args:
        config: cell size, extent, capacity of both.
        a: a map; its grid is kept, and its cells have precedence where the capacity is full.
        b: a map whose grid is equal to a's or shifted by whole cells; its cells outside a's grid
            are counted as outside, once per cell.

    Raises:
        UserError: the grids are not shifted by whole cells (not checked under jit).
    """
    shift_3 = (b.origin_3 - a.origin_3) / np.asarray(config.cell_m, np.float32)
    if not isinstance(shift_3, Tracer) and not np.allclose(shift_3, np.round(shift_3), atol=1e-2):
        raise UserError(
            f"merge() got grids shifted by {np.asarray(shift_3)} cells; only whole cells can be "
            "merged."
        )
    points, features, valid = to_points(config, b)
    both = insert(config, a, points, features, valid)
    return dataclasses.replace(
        both, dropped=both.dropped + b.dropped, outside=both.outside + b.outside
    )


def count(voxels: VoxelMap) -> Array:
    """Return () int32, the number of occupied cells."""
    return voxels.occupied


def to_points(config: Memory, voxels: VoxelMap) -> tuple[Array, Array, Array]:
    """Return all slots as ``(points_world_V3, features_VF, valid_V)``; free slots are 0."""
    valid = voxels.cell_of_slot_V < voxel_cells.nowhere(config)
    points = cell_centres(config, voxels.origin_3, jnp.where(valid, voxels.cell_of_slot_V, 0))
    features = jnp.where(valid[:, None], voxels.features_VF, 0)
    return jnp.where(valid[:, None], points, 0), features, valid


def tokens(config: Memory, voxels: VoxelMap, camera: Camera, size: tuple[int, int]) -> MapTokens:
    """Choose the M = ``memory.tokens`` cells that condition one clip.

    Cells that the clip's cameras can see come first (``cells.choose``). Ties go to the lower cell
    number. With fewer than M occupied cells, the remaining tokens are masked. Positions
    are in the world; ``models.memory_geometry`` encodes them for attention.

    Args:
        config: gives M.
        voxels: the map.
        camera: (T,) cameras of the clip.
        size: image height and width in pixels.
    """
    points, features, valid = to_points(config, voxels)
    order = cells.choose(config, points, valid, camera, size)
    return MapTokens(features[order], points[order], valid[order])


def renewed(
    config: Memory,
    voxels: VoxelMap,
    cell_V: Array,
    features_VF: Array,
    dropped: Array | int = 0,
    outside: Array | int = 0,
) -> VoxelMap:
    """Return a map with new cells and features, and increased counts of dropped and outside."""
    return dataclasses.replace(
        voxels,
        cell_of_slot_V=cell_V,
        features_VF=features_VF,
        occupied=(cell_V < voxel_cells.nowhere(config)).sum(dtype=jnp.int32),
        dropped=voxels.dropped + dropped,
        outside=voxels.outside + outside,
    )
