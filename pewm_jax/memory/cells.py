"""Grid cells as integers, sampled pixels, and the order in which tokens are chosen.

All memories share this grid and this order of tokens.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import Memory
from pewm_jax.geometry.cameras import project, unproject
from pewm_jax.geometry.zbuffer import visible_first
from pewm_jax.types import Array, Camera, Frames

FAR_M = 1e4
"""Added to the distance of points that no camera sees, so that they come after all others."""


def origin(config: Memory, centre_3: Array) -> Array:
    """Return (3,) the lower corner of a grid around a world position, snapped to whole cells."""
    cell = np.asarray(config.cell_m, np.float32)
    half = np.asarray(config.cells, np.float32) * cell / 2
    return (jnp.round((jnp.asarray(centre_3) - half) / cell) * cell).astype(jnp.float32)


def keys(config: Memory, origin_3: Array, points_3: Array) -> Array:
    """Return (...,) int32: the cell number of each point (..., 3).

    Points outside the grid, and points with NaN, get the number of cells, which is no cell.
    """
    place = jnp.floor((points_3 - origin_3) / np.asarray(config.cell_m, np.float32))
    inside = jnp.all((place >= 0) & (place < np.asarray(config.cells, np.float32)), -1)
    x, y, z = (jnp.where(inside, place[..., i], 0).astype(jnp.int32) for i in range(3))
    _, ny, nz = config.cells
    return jnp.where(inside, (x * ny + y) * nz + z, math.prod(config.cells))


def corners(config: Memory, origin_3: Array, cell_P: Array) -> Array:
    """Return (P, 3) the lower corners of cells by their numbers, metres."""
    _, ny, nz = config.cells
    place = jnp.stack([cell_P // (ny * nz), cell_P // nz % ny, cell_P % nz], -1)
    return origin_3 + place.astype(jnp.float32) * np.asarray(config.cell_m, np.float32)


def grid_of(height: int, width: int, most: int) -> tuple[int, int]:
    """Return rows and columns of an even grid over an image with at most ``most`` fields."""
    rows = min(max(int(math.sqrt(most * height / width)), 1), height, most)
    return rows, max(min(most // rows, round(rows * width / height), width), 1)


def sample(
    frames: Frames, rows: int, columns: int, valid_T: Array | None = None
) -> tuple[Array, Array, Array]:
    """Sample the pixels at the centres of an even grid over each frame.

    Args:
        frames: T frames.
        rows: rows of the grid.
        columns: columns of the grid.
        valid_T: (T,) bool, False frames have no valid pixel.

    Returns:
        ``(points_TP3, rgb_TPC, valid_TP)``, P = rows × columns; pixels without depth are invalid.
    """
    count, height, width = frames.depth_THW.shape
    row = ((np.arange(rows) + 0.5) * height / rows).astype(int)
    column = ((np.arange(columns) + 0.5) * width / columns).astype(int)

    def take(image: Array) -> Array:
        picked = image[:, row][:, :, column]
        return picked.reshape(count, rows * columns, *image.shape[3:])

    depth = take(frames.depth_THW)
    valid = (depth > 0) & jnp.isfinite(depth)
    if valid_T is not None:
        valid = valid & valid_T[:, None]
    return take(unproject(frames.depth_THW, frames.camera)), take(frames.rgb_THWC), valid


def choose(
    config: Memory,
    points_V3: Array,
    valid_V: Array,
    camera: Camera,
    size: tuple[int, int],
    wide_V: Array | None = None,
) -> Array:
    """Return (≤ ``memory.tokens``,) indices of the points that condition one clip.

    By ``memory.choose``: those that the clip's cameras can see first (``geometry.zbuffer``), or
    those in view by their distance (``in_view_first``).

    Args:
        config: gives order, number and the size of a cell.
        points_V3: (V, 3) world points, metres.
        valid_V: (V,) bool.
        camera: (T,) cameras of the clip.
        size: image height and width in pixels.
        wide_V: (V,) widths of the points, metres, if they are not those of a cell.
    """
    if config.choose == "nearest":
        return in_view_first(points_V3, valid_V, camera, size, config.tokens)
    wide = jnp.float32(max(config.cell_m[:2])) if wide_V is None else wide_V
    tall = jnp.float32(config.cell_m[2]) if wide_V is None else wide_V
    return visible_first(points_V3, wide, tall, valid_V, camera, size, config.tokens)


def in_view_first(
    points_P3: Array, valid_P: Array, camera: Camera, size: tuple[int, int], count: int
) -> Array:
    """Return (≤ count,) indices of the points that condition one clip.

    Points in view of any of the clip's cameras come first, nearest first (by the smallest depth at
    which a camera sees them). The others follow, by distance to the nearest camera; invalid points
    are last. Ties go to the lower index.

    Args:
        points_P3: world points, metres.
        valid_P: (P,) bool.
        camera: (T,) cameras of the clip.
        size: image height and width in pixels.
        count: the most indices to return; fewer if there are fewer points.
    """
    uv, z = project(points_P3[None], camera)
    seen = jnp.all((uv >= 0) & (uv <= np.array([size[1], size[0]], np.float32)), -1) & (z > 0)
    depth = jnp.where(seen, z, jnp.inf).min(0)
    centres = camera.world_from_camera[:, None, :3, 3]
    distance = jnp.linalg.norm(points_P3[None] - centres, axis=-1).min(0)
    score = jnp.where(jnp.isfinite(depth), depth, FAR_M + distance)
    score = jnp.where(valid_P, score, jnp.inf)
    return jax.lax.top_k(-score, min(count, points_P3.shape[0]))[1]
