"""Which of many points conditions a clip: first those that its cameras can see.

Each camera draws the points into a small z-buffer, as wide as they are; every pixel of it names the
point it shows. Points named by most pixels come first: they stand for the largest part of what is
to be imagined. Of equals the one whose pixel has the earlier turn, in an order that goes round all
bins of the image, so that no part of it is starved. Then come points on a surface that is seen,
then those hidden in view, then all others.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.geometry import zbuffer
from pewm_jax.types import Array, Camera

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
        spots = zbuffer.look(points_V3, wide_V, tall_V, valid_V, small)
        front, shown = zbuffer.cover(spots, rows, columns, MOST)
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
