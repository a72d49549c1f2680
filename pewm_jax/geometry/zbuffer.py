"""Z-buffers of points that have a size: the nearest point at each pixel, and the visible points.

All shapes are static and all results deterministic: among equally near points the first wins.

``visible_first`` chooses the points that condition a clip. Each camera renders the points, with
their sizes, into a small z-buffer; every pixel votes for the point it shows. Points with the most
pixels come first, because they cover the largest part of the frames to imagine. Ties are broken by
``pixel_order``, which cycles through all bins of the image so that no part of it is starved. Then
come points on a visible surface, then occluded points in view, then all others.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.geometry.cameras import invert_rigid
from pewm_jax.types import Array, Camera

NEAREST_M = 0.05
"""Points nearer to the camera plane than this are not visible, metres."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ProjectedPoints:
    """Points projected into one camera, one array per coordinate (fastest on all processors).

    Positions and half sizes are in pixels, depths in metres; ``valid_V`` is False for empty slots
    and points behind the camera.
    """

    u_V: Array
    v_V: Array
    z_V: Array
    half_width_V: Array
    half_height_V: Array
    valid_V: Array


def project_points(
    points_V3: Array, wide_V: Array, tall_V: Array, valid_V: Array, camera: Camera
) -> ProjectedPoints:
    """Project points (V, 3) that have a size into one camera; see ``cameras.project``.

    Their widths and heights parallel to the image, (V,) or (), are in metres; points that are not
    valid are empty slots.
    """
    world, (fx, fy, cx, cy) = invert_rigid(camera.world_from_camera), camera.intrinsics_4
    x, y, z = (sum((row[i] * points_V3[:, i] for i in range(3)), start=row[3]) for row in world[:3])
    there = valid_V & (z > NEAREST_M)
    near = 1 / jnp.where(there, z, 1)
    return ProjectedPoints(
        x * near * fx + cx,
        y * near * fy + cy,
        z,
        wide_V / 2 * fx * near,
        tall_V / 2 * fy * near,
        there,
    )


def pixel_window(place: Array, half: Array, most: int) -> tuple[Array, Array]:
    """Return the pixels that points cover along one axis, as ``(begin, count)``, int32.

    These are the pixels whose centres lie in [place − half, place + half), both in pixels: at least
    the pixel at the position, and at most ``most`` pixels around it.
    """
    half = jnp.minimum(half, most / 2)
    here = jnp.floor(place)
    begin = jnp.minimum(jnp.ceil(place - half - 0.5), here)
    wide = jnp.maximum(jnp.ceil(place + half - 0.5), here + 1) - begin
    return begin.astype(jnp.int32), jnp.clip(wide, 1, most).astype(jnp.int32)


def nearest_per_pixel(
    projected: ProjectedPoints, height: int, width: int, most: int
) -> tuple[Array, Array]:
    """Return (H·W,) depth and index of the nearest point covering each pixel; inf and ≥ V if none.

    Points cover at most ``most`` pixels along each axis. Their windows are not drawn pixel by
    pixel. Windows of one size that begin at the same pixel cover the same pixels, so only the
    nearest of them counts: there is one z-buffer per size. A window is also the union of the two
    windows, one pixel smaller, that begin at the same and at the next pixel: the z-buffer of each
    size is spread into that of the next smaller size, down to single pixels.
    """
    left, wide = pixel_window(projected.u_V, projected.half_width_V, most)
    above, tall = pixel_window(projected.v_V, projected.half_height_V, most)
    # A window may begin up to most − 1 pixels before the image.
    left, above, shape = left + most - 1, above + most - 1, (height + most - 1, width + most - 1)
    inside = (left >= 0) & (left < shape[1]) & (above >= 0) & (above < shape[0])
    level = (tall - 1) * most + wide - 1
    bin_ = (level * shape[0] + above) * shape[1] + left
    found = nearest_per_bin(
        bin_, projected.z_V, projected.valid_V & inside, most * most * shape[0] * shape[1]
    )
    depth, index = (x.reshape(most, most, *shape) for x in found)  # down, across, row, column
    depth, index = _spread(jnp.moveaxis(depth, 1, 0), jnp.moveaxis(index, 1, 0), axis=2)
    depth, index = _spread(depth, index, axis=0)
    return tuple(x[most - 1 :, most - 1 :].reshape(-1) for x in (depth, index))


def nearest_per_bin(bin_V: Array, z_V: Array, valid_V: Array, bins: int) -> tuple[Array, Array]:
    """Return the smallest depth in each bin and the lowest index that has it; inf and V if none.

    Bins (int32) and depths of points that are not valid are ignored.
    """
    count = len(z_V)
    bin_ = jnp.where(valid_V, bin_V, bins)
    depth = jnp.full((bins,), jnp.inf).at[bin_].min(z_V, mode="drop")
    first = valid_V & (z_V <= depth[jnp.clip(bin_V, 0, bins - 1)])
    index = jnp.full((bins,), count, jnp.int32)
    bin_ = jnp.where(first, bin_V, bins)
    return depth, index.at[bin_].min(jnp.arange(count, dtype=jnp.int32), mode="drop")


def _spread(depth: Array, index: Array, axis: int) -> tuple[Array, Array]:
    """Spread z-buffers (level, …) of windows of 1, 2, … pixels along an axis down to single pixels.

    The nearest window wins; of equally near ones the lowest index.
    """

    def nearer(a: tuple[Array, Array], b: tuple[Array, Array]) -> tuple[Array, Array]:
        second = (b[0] < a[0]) | ((b[0] == a[0]) & (b[1] < a[1]))
        return jnp.where(second, b[0], a[0]), jnp.where(second, b[1], a[1])

    def moved(x: Array, nothing: float) -> Array:
        kept = jax.lax.slice_in_dim(x, 0, x.shape[axis] - 1, axis=axis)
        ahead = [(int(i == axis), 0) for i in range(x.ndim)]
        return jnp.pad(kept, ahead, constant_values=nothing)

    def step(best: tuple[Array, Array], level: tuple[Array, Array]) -> Any:
        next_one = moved(best[0], jnp.inf), moved(best[1], np.iinfo(np.int32).max)
        return nearer(nearer(best, next_one), level), None

    # Use a scan: unrolled levels would be fused and recomputed by each of their consumers.
    smaller = depth[:-1], index[:-1]
    return jax.lax.scan(step, (depth[-1], index[-1]), smaller, reverse=True)[0]


RASTER, BIN, MOST = 32, 4, 4
"""Longest side of the small z-buffer, side of a bin, and largest side of a point, pixels."""
RELATIVE = 0.1
"""Depth tolerance of points on one surface, relative to its depth (at least their width)."""
CLASS = 2.0**15
"""Distance between the ranks of two classes of points (named by a pixel, on a seen surface, hidden
in view, others); metres are added within a class."""


@functools.lru_cache(maxsize=64)
def pixel_order(rows: int, columns: int) -> np.ndarray:
    """Return (rows · columns,) int32: the position of each pixel in an order that goes round bins.

    Within a bin, pixels that are far apart come first (their coordinates, bits reversed).
    """
    row, column = np.divmod(np.arange(rows * columns), columns)
    v, u = row % BIN, column % BIN
    # The bits of u and v, lowest first: successive pixels are half a bin apart, then a quarter.
    within = np.zeros_like(row)
    for k in range(BIN.bit_length() - 1):
        within += (((u ^ v) >> k & 1) * 2 + (v >> k & 1)) << 2 * (BIN.bit_length() - 2 - k)
    bins = (row // BIN) * (-(-columns // BIN)) + column // BIN
    scattered = np.random.default_rng(0).permutation(bins.max() + 1)[bins]
    pixels = np.lexsort((scattered, np.asarray(within)))
    position = np.empty(len(pixels), np.int32)
    position[pixels] = np.arange(len(pixels), dtype=np.int32)
    return position


def raster(size: tuple[int, int]) -> tuple[int, int]:
    """Return rows and columns of the z-buffer of an image of this height and width."""
    most = min(RASTER, max(size))
    return tuple(max(round(side * most / max(size)), 1) for side in size)  # type: ignore[return-value]


def visibility_rank(
    points_V3: Array,
    wide_V: Array,
    tall_V: Array,
    valid_V: Array,
    camera: Camera,
    size: tuple[int, int],
) -> Array:
    """Return the (T, V) rank of points for each camera, low first; inf for points out of view.

    Ranks below ``CLASS`` are those of points named by pixels, those of most pixels first. Ranks
    from ``CLASS`` on are those of points on a seen surface, and from 2 ``CLASS`` on those of hidden
    points, both by depth. Arguments as for ``visible_first``.
    """
    count, (rows, columns) = len(points_V3), raster(size)
    scale = np.array([columns / size[1], rows / size[0]] * 2, np.float32)
    order = jnp.asarray(pixel_order(rows, columns))

    def one(camera: Camera) -> Array:
        small = Camera(camera.intrinsics_4 * scale, camera.world_from_camera)
        projected = project_points(points_V3, wide_V, tall_V, valid_V, small)
        front, shown = nearest_per_pixel(projected, rows, columns, MOST)
        area = jnp.zeros((count,)).at[shown].add(1.0, mode="drop")
        first = jnp.full((count,), jnp.inf).at[shown].min(order / len(order), mode="drop")
        named = len(order) - area + first
        u, v = projected.u_V, projected.v_V
        inside = projected.valid_V & (u >= 0) & (u <= columns) & (v >= 0) & (v <= rows)
        column = jnp.clip(u, 0, columns - 1).astype(jnp.int32)
        row = jnp.clip(v, 0, rows - 1).astype(jnp.int32)
        before = front[row * columns + column]
        hidden = projected.z_V > before + jnp.maximum(wide_V, RELATIVE * before)
        behind = jnp.minimum(projected.z_V, CLASS / 2) + jnp.where(hidden, 2, 1) * CLASS
        return jnp.minimum(named, jnp.where(inside, behind, jnp.inf))

    return jax.lax.map(one, jax.tree.map(jnp.asarray, camera))


def visible_first(
    points_V3: Array,
    wide_V: Array,
    tall_V: Array,
    valid_V: Array,
    camera: Camera,
    size: tuple[int, int],
    count: int,
) -> Array:
    """Return (≤ count,) indices of the points that condition one clip, the most useful first.

    Points that pixels of some camera show come first, those of most pixels first. Then come points
    on a seen surface and then hidden points in view, by the smallest depth in any camera. Then come
    the others by distance to the nearest camera, and invalid points last. Ties go to the lower
    index.

    Args:
        points_V3: (V, 3) in the world, metres.
        wide_V: (V,) or () their widths, metres.
        tall_V: (V,) or () their heights, metres.
        valid_V: (V,) bool.
        camera: (T,) cameras of the clip.
        size: image height and width in pixels.
        count: the largest number of indices to return.
    """
    rank_TV = visibility_rank(points_V3, wide_V, tall_V, valid_V, camera, size)
    centres = jnp.asarray(camera.world_from_camera)[:, :3, 3]
    squares = sum((points_V3[None, :, i] - centres[:, None, i]) ** 2 for i in range(3))
    far = 3 * CLASS + jnp.sqrt(jnp.min(jnp.asarray(squares), 0))
    pixels = float(np.prod(raster(size)))
    area = jnp.where(rank_TV < CLASS, pixels + 1 - rank_TV, 0).sum(0)
    best = rank_TV.min(0)
    best = jnp.where(best < CLASS, CLASS - area, best)
    score = jnp.where(valid_V, jnp.minimum(best, far), jnp.inf)
    return jax.lax.top_k(-score, min(count, len(points_V3)))[1]
