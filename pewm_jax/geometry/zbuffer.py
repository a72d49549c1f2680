"""Z-buffers of points that have a size: which point is the nearest at each pixel of an image.

Everything is of static shape and deterministic; of equally near points the first is seen.
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
"""Points nearer to the camera plane than this are not seen, metres."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Spots:
    """Points as one camera sees them, axis by axis: vectors are what processors are fast with.

    Attributes:
        u_V: (V,) where they are across, pixels.
        v_V: (V,) down, pixels.
        z_V: (V,) depth, metres.
        across_V: (V,) half their width, pixels.
        down_V: (V,) half their height, pixels.
        there_V: (V,) bool; others are not there, or behind the camera.
    """

    u_V: Array
    v_V: Array
    z_V: Array
    across_V: Array
    down_V: Array
    there_V: Array


def look(points_V3: Array, wide_V: Array, tall_V: Array, valid_V: Array, camera: Camera) -> Spots:
    """Return what one camera sees of points; see ``cameras.project``.

    Args:
        points_V3: (V, 3) in the world, metres.
        wide_V: (V,) or () their width in the image, metres.
        tall_V: (V,) or () their height in the image, metres.
        valid_V: (V,) bool; others are not there.
        camera: one camera.
    """
    world, (fx, fy, cx, cy) = invert_rigid(camera.world_from_camera), camera.intrinsics_4
    x, y, z = (sum((row[i] * points_V3[:, i] for i in range(3)), start=row[3]) for row in world[:3])
    there = valid_V & (z > NEAREST_M)
    near = 1 / jnp.where(there, z, 1)
    return Spots(
        x * near * fx + cx,
        y * near * fy + cy,
        z,
        wide_V / 2 * fx * near,
        tall_V / 2 * fy * near,
        there,
    )


def window(place: Array, half: Array, most: int) -> tuple[Array, Array]:
    """Return the pixels that points cover along one axis, as ``(begin, wide)``, int32.

    Those whose centres lie in [place − half, place + half), at least the pixel at the place, and at
    most ``most``, then those in the middle.

    Args:
        place: (…) where the points are, pixels.
        half: (…) half their size, pixels.
        most: pixels at most.
    """
    half = jnp.minimum(half, most / 2)
    here = jnp.floor(place)
    begin = jnp.minimum(jnp.ceil(place - half - 0.5), here)
    wide = jnp.maximum(jnp.ceil(place + half - 0.5), here + 1) - begin
    return begin.astype(jnp.int32), jnp.clip(wide, 1, most).astype(jnp.int32)


def cover(spots: Spots, height: int, width: int, most: int) -> tuple[Array, Array]:
    """Return (H·W,) depth and index of the nearest point covering each pixel; inf and ≥ V if none.

    No window is drawn pixel by pixel. Windows of one size that begin at one pixel cover the same
    pixels, so that only the nearest of them counts: a z-buffer per size. And a window is the union
    of the two windows one pixel smaller that begin at the same and at the next pixel: each size is
    spread into the next smaller one, down to single pixels.

    Args:
        spots: the points.
        height: of the image, pixels.
        width: of the image, pixels.
        most: pixels that a point covers at most, across and down.
    """
    left, wide = window(spots.u_V, spots.across_V, most)
    above, tall = window(spots.v_V, spots.down_V, most)
    # A window may begin up to most − 1 pixels before the image.
    left, above, shape = left + most - 1, above + most - 1, (height + most - 1, width + most - 1)
    inside = (left >= 0) & (left < shape[1]) & (above >= 0) & (above < shape[0])
    level = (tall - 1) * most + wide - 1
    seat = (level * shape[0] + above) * shape[1] + left
    found = nearest(seat, spots.z_V, spots.there_V & inside, most * most * shape[0] * shape[1])
    depth, index = (x.reshape(most, most, *shape) for x in found)  # down, across, row, column
    depth, index = _spread(jnp.moveaxis(depth, 1, 0), jnp.moveaxis(index, 1, 0), axis=2)
    depth, index = _spread(depth, index, axis=0)
    return tuple(x[most - 1 :, most - 1 :].reshape(-1) for x in (depth, index))


def nearest(seat_V: Array, z_V: Array, there_V: Array, seats: int) -> tuple[Array, Array]:
    """Return the smallest depth at each seat and the lowest index that has it; inf and V if none.

    Args:
        seat_V: (V,) int32, the seat of each point; not used where it is not there.
        z_V: (V,) depths.
        there_V: (V,) bool.
        seats: how many seats there are.
    """
    count = len(z_V)
    seat = jnp.where(there_V, seat_V, seats)
    depth = jnp.full((seats,), jnp.inf).at[seat].min(z_V, mode="drop")
    first = there_V & (z_V <= depth[jnp.clip(seat_V, 0, seats - 1)])
    index = jnp.full((seats,), count, jnp.int32)
    seat = jnp.where(first, seat_V, seats)
    return depth, index.at[seat].min(jnp.arange(count, dtype=jnp.int32), mode="drop")


def _spread(depth: Array, index: Array, axis: int) -> tuple[Array, Array]:
    """Spread images (level, …) of windows of 1, 2, … pixels along an axis of each down to pixels.

    Of several at one pixel the nearest counts, of equals the lowest index.
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

    # A scan, so that each level is computed once and not anew by all that read it.
    smaller = depth[:-1], index[:-1]
    return jax.lax.scan(step, (depth[-1], index[-1]), smaller, reverse=True)[0]


RASTER, BIN, MOST = 32, 4, 4
"""Longest side of a z-buffer, side of a bin, and pixels that a point covers at most."""
RELATIVE = 0.1
"""Points on one surface lie within the larger of their width and this share of its depth."""
CLASS = 2.0**15
"""The rank of points by class: named, on a seen surface, hidden in view, others; metres are added
within a class."""


@functools.lru_cache(maxsize=64)
def turns(rows: int, columns: int) -> np.ndarray:
    """Return (rows · columns,) int32: each pixel's turn, from 0, in an order that goes round bins.

    Within a bin, pixels far apart come first (their places, bit by bit backwards).
    """
    row, column = np.divmod(np.arange(rows * columns), columns)
    v, u = row % BIN, column % BIN
    # The bits of u and v, lowest first: next turns are half a bin apart, then a quarter.
    within = np.zeros_like(row)
    for k in range(BIN.bit_length() - 1):
        within += (((u ^ v) >> k & 1) * 2 + (v >> k & 1)) << 2 * (BIN.bit_length() - 2 - k)
    bins = (row // BIN) * (-(-columns // BIN)) + column // BIN
    scattered = np.random.default_rng(0).permutation(bins.max() + 1)[bins]
    order = np.lexsort((scattered, np.asarray(within)))
    turn = np.empty(len(order), np.int32)
    turn[order] = np.arange(len(order), dtype=np.int32)
    return turn


def raster(size: tuple[int, int]) -> tuple[int, int]:
    """Return rows and columns of the z-buffer of an image of this height and width."""
    most = min(RASTER, max(size))
    return tuple(max(round(side * most / max(size)), 1) for side in size)  # type: ignore[return-value]


def rank(
    points_V3: Array,
    wide_V: Array,
    tall_V: Array,
    valid_V: Array,
    camera: Camera,
    size: tuple[int, int],
) -> Array:
    """Return (T, V) how early each camera would have each point; inf for points out of its view.

    Below ``CLASS`` are points that pixels name, those of most pixels first; then follow points on a
    surface that is seen, and from 2 ``CLASS`` on hidden ones, both by depth.

    Args:
        points_V3: (V, 3) in the world, metres.
        wide_V: (V,) or () their widths, metres.
        tall_V: (V,) or () their heights, metres.
        valid_V: (V,) bool; others are out of view.
        camera: (T,) cameras.
        size: image height and width in pixels.
    """
    count, (rows, columns) = len(points_V3), raster(size)
    scale = np.array([columns / size[1], rows / size[0]] * 2, np.float32)
    turn = jnp.asarray(turns(rows, columns))

    def one(camera: Camera) -> Array:
        small = Camera(camera.intrinsics_4 * scale, camera.world_from_camera)
        spots = look(points_V3, wide_V, tall_V, valid_V, small)
        front, shown = cover(spots, rows, columns, MOST)
        area = jnp.zeros((count,)).at[shown].add(1.0, mode="drop")
        first = jnp.full((count,), jnp.inf).at[shown].min(turn / len(turn), mode="drop")
        named = len(turn) - area + first
        u, v = spots.u_V, spots.v_V
        inside = spots.there_V & (u >= 0) & (u <= columns) & (v >= 0) & (v <= rows)
        column = jnp.clip(u, 0, columns - 1).astype(jnp.int32)
        row = jnp.clip(v, 0, rows - 1).astype(jnp.int32)
        before = front[row * columns + column]
        hidden = spots.z_V > before + jnp.maximum(wide_V, RELATIVE * before)
        behind = jnp.minimum(spots.z_V, CLASS / 2) + jnp.where(hidden, 2, 1) * CLASS
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

    Points that pixels of some camera show, those of most pixels first; then points on a
    seen surface and then hidden points in view, nearest first (by the smallest depth at which a
    camera has them); then others by distance to the nearest camera; invalid ones are last. Ties go
    to the lower index.

    Args:
        points_V3: (V, 3) in the world, metres.
        wide_V: (V,) or () their widths, metres.
        tall_V: (V,) or () their heights, metres.
        valid_V: (V,) bool.
        camera: (T,) cameras of the clip.
        size: image height and width in pixels.
        count: the most indices to return; fewer if there are fewer points.
    """
    rank_TV = rank(points_V3, wide_V, tall_V, valid_V, camera, size)
    centres = jnp.asarray(camera.world_from_camera)[:, :3, 3]
    squares = sum((points_V3[None, :, i] - centres[:, None, i]) ** 2 for i in range(3))
    far = 3 * CLASS + jnp.sqrt(jnp.min(jnp.asarray(squares), 0))
    pixels = float(np.prod(raster(size)))
    area = jnp.where(rank_TV < CLASS, pixels + 1 - rank_TV, 0).sum(0)
    best = rank_TV.min(0)
    best = jnp.where(best < CLASS, CLASS - area, best)
    score = jnp.where(valid_V, jnp.minimum(best, far), jnp.inf)
    return jax.lax.top_k(-score, min(count, len(points_V3)))[1]
