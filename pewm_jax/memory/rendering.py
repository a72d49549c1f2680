"""Rendering points by splatting them into a z-buffer.

Shapes are static and the result is deterministic (``average`` adds in the order of the points on a
CPU). ``splat`` lets each point cover the one pixel that it projects to; of several points at a
pixel the nearest is seen, and ties go to the lowest index. Far surfaces show through between such
points; ``splat_surfels`` gives points a size, so that they do not. ``fill_nearest`` fills pixels
that no point covers.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.geometry.cameras import project
from pewm_jax.types import Array, Camera, View

NEAREST_M = 0.05
"""Points nearer to the camera plane than this are not seen, metres."""
TOLERANCE_M, TOLERANCE_RELATIVE = 0.05, 0.1
"""Points on one surface lie within the larger of 5 cm and 10 % behind its front (a floor seen at a
grazing angle is that deep from pixel to pixel)."""
LEAST = 1e-4
"""The least share of a point that shows it."""


def splat(
    points_V3: Array, features_VF: Array, valid_V: Array, camera: Camera, height: int, width: int
) -> View:
    """Render points for cameras.

    Args:
        points_V3: (V, 3) in the world, metres.
        features_VF: (V, F) their features.
        valid_V: (V,) bool; False points are ignored.
        camera: (T,) cameras, whose intrinsics are for images of ``height`` × ``width``.
        height: height of the images, pixels.
        width: width of the images, pixels.
    """
    count, pixels = len(points_V3), height * width

    def render(camera: Camera) -> tuple[Array, Array, Array]:
        uv, z = project(points_V3, camera)
        column, row = (jnp.floor(uv[:, i]).astype(jnp.int32) for i in (0, 1))
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        visible = inside & valid_V & (z > NEAREST_M)
        pixel = jnp.where(visible, row * width + column, pixels)
        depth = jnp.full((pixels,), jnp.inf).at[pixel].min(z, mode="drop")
        first = visible & (z <= depth[jnp.minimum(pixel, pixels - 1)])
        index = (
            jnp.full((pixels,), count)
            .at[jnp.where(first, pixel, pixels)]
            .min(jnp.arange(count), mode="drop")
        )
        seen = index < count
        features = jnp.where(seen[:, None], features_VF[jnp.minimum(index, count - 1)], 0)
        return features, jnp.where(seen, depth, 0), seen

    features, depth, seen = jax.vmap(render)(camera)
    frames = depth.shape[0]
    return View(
        features.reshape(frames, height, width, -1),
        depth.reshape(frames, height, width),
        seen.reshape(frames, height, width),
    )


def splat_surfels(
    points_V3: Array,
    features_VF: Array,
    size_V: Array,
    valid_V: Array,
    camera: Camera,
    height: int,
    width: int,
    *,
    most: int = 3,
    average: bool = True,
) -> View:
    """Return what cameras see of points that have a size, so that near surfaces hide far ones.

    A point covers the pixels whose centres lie in a square of its size at its depth around it, and
    always the pixel that it falls on. The nearest point that covers a pixel is its front; what
    lies behind the front by more than a tolerance is hidden. Where no point in front falls on or
    beside a pixel that is covered, the covering point is shown.

    Args:
        points_V3: (V, 3) in the world, metres.
        features_VF: (V, F).
        size_V: (V,) widths, metres.
        valid_V: (V,) bool; others are not there.
        camera: (T,) cameras, whose intrinsics are for images of ``height`` × ``width``.
        height: of the images, pixels.
        width: of the images, pixels.
        most: pixels that a point covers at most, across and down.
        average: show the mean of all that is not hidden, each point shared bilinearly by the four
            pixels around it; else the nearest point that falls on the pixel, as it is.
    """
    count, pixels = len(points_V3), height * width
    size = np.array([width, height])

    def one(camera: Camera) -> tuple[Array, Array, Array]:
        uv, z = project(points_V3, camera)
        there = valid_V & (z > NEAREST_M)
        half = size_V[:, None] / 2 * camera.intrinsics_4[:2] / jnp.where(there, z, 1)[:, None]
        cover, covering = _cover(uv, half, z, there, height, width, most)

        def visible(place: Array) -> tuple[Array, Array]:
            inside = ((place >= 0) & (place < size)).all(-1)
            pixel = jnp.where(inside, place[:, 1] * width + place[:, 0], 0)
            front = cover[pixel]
            return pixel, there & inside & (z <= front + tolerance(front))

        if average:
            corner = jnp.floor(uv - 0.5)
            share = uv - 0.5 - corner
            values = jnp.concatenate([features_VF, z[:, None], jnp.ones((count, 1))], -1)
            total = jnp.zeros((pixels, values.shape[-1]))
            for step in ((0, 0), (1, 0), (0, 1), (1, 1)):
                pixel, shown = visible(corner.astype(jnp.int32) + np.array(step))
                weight = jnp.where(np.array(step) == 1, share, 1 - share).prod(-1)
                rows = jnp.where(shown[:, None], values * weight[:, None], 0)
                total = total.at[jnp.where(shown, pixel, pixels)].add(rows, mode="drop")
            direct = total[:, -1] > LEAST
            mean = total / jnp.where(direct, total[:, -1], 1)[:, None]
            features, depth = mean[:, :-2], mean[:, -2]
        else:
            pixel, shown = visible(jnp.floor(uv).astype(jnp.int32))
            depth, index = _nearest(pixel, z, shown, pixels)
            direct = index < count
            features = features_VF[jnp.minimum(index, count - 1)]
        seen = direct | (covering < count)
        features = jnp.where(direct[:, None], features, features_VF[covering.clip(0, count - 1)])
        depth = jnp.where(direct, depth, cover)
        return jnp.where(seen[:, None], features, 0), jnp.where(seen, depth, 0), seen

    # Frame after frame: what one needs fits a processor's cache, which nine do not.
    features, depth, seen = jax.lax.map(one, jax.tree.map(jnp.asarray, camera))
    frames = depth.shape[0]
    return View(
        features.reshape(frames, height, width, -1),
        depth.reshape(frames, height, width),
        seen.reshape(frames, height, width),
    )


def tolerance(depth: Array) -> Array:
    """Return how far behind the front a point may lie and still be on it, metres."""
    return jnp.maximum(TOLERANCE_M, TOLERANCE_RELATIVE * depth)


def window(uv_V2: Array, half_V2: Array, most: int) -> tuple[Array, Array]:
    """Return the pixels that points cover, as ``(begin_V2, wide_V2)``, across and down, int32.

    Those whose centres lie in [uv − half, uv + half), at least the pixel at uv, and at most
    ``most``, then those in the middle.

    Args:
        uv_V2: (V, 2) where the points are, pixels.
        half_V2: (V, 2) half their size, pixels.
        most: pixels at most.
    """
    half = jnp.minimum(half_V2, most / 2)
    here = jnp.floor(uv_V2)
    begin = jnp.minimum(jnp.ceil(uv_V2 - half - 0.5), here)
    wide = jnp.maximum(jnp.ceil(uv_V2 + half - 0.5), here + 1) - begin
    return begin.astype(jnp.int32), jnp.clip(wide, 1, most).astype(jnp.int32)


def _cover(
    uv_V2: Array, half_V2: Array, z_V: Array, there_V: Array, height: int, width: int, most: int
) -> tuple[Array, Array]:
    """Return (H·W,) depth and index of the nearest point covering each pixel; inf and ≥ V if none.

    No window is drawn pixel by pixel. Windows of one size that begin at one pixel cover the same
    pixels, so that only the nearest of them counts: a z-buffer per size. And a window is the union
    of the two windows one pixel smaller that begin at the same and at the next pixel: each size is
    spread into the next smaller one, down to single pixels.
    """
    begin, wide = window(uv_V2, half_V2, most)
    # A window may begin up to most − 1 pixels before the image.
    begin, shape = begin + (most - 1), (height + most - 1, width + most - 1)
    inside = ((begin >= 0) & (begin < np.array(shape[::-1]))).all(-1)
    level = (wide[:, 1] - 1) * most + wide[:, 0] - 1
    seat = (level * shape[0] + begin[:, 1]) * shape[1] + begin[:, 0]
    found = _nearest(seat, z_V, there_V & inside, most * most * shape[0] * shape[1])
    depth, index = (x.reshape(most, most, *shape) for x in found)  # down, across, row, column
    depth, index = _spread(jnp.moveaxis(depth, 1, 0), jnp.moveaxis(index, 1, 0), axis=2)
    depth, index = _spread(depth, index, axis=0)
    return tuple(x[most - 1 :, most - 1 :].reshape(-1) for x in (depth, index))


def _nearest(seat_V: Array, z_V: Array, there_V: Array, seats: int) -> tuple[Array, Array]:
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


def fill_nearest(view: View) -> View:
    """Fill pixels that show nothing from the nearest pixel of their image that shows something.

    By jump flooding (steps of …, 4, 2, 1 and once more 1 pixels): a static number of passes, and
    seldom a pixel that is a little farther than the nearest. Images that show nothing stay empty.

    Args:
        view: what was seen.

    Returns:
        The view with features and depth everywhere; ``seen_THW`` still tells what was seen.
    """
    frames, height, width = view.seen_THW.shape
    place = np.arange(height * width, dtype=np.int32).reshape(height, width)
    row, column = np.divmod(place, width)
    most = max(height, width)
    steps = [2**k for k in range(max(most - 1, 1).bit_length() - 1, -1, -1)] + [1]
    far = np.int32(2 * most * most)

    def off(source_HW: Array) -> Array:
        distance = (source_HW // width - row) ** 2 + (source_HW % width - column) ** 2
        return jnp.where(source_HW >= 0, distance, far)

    def flood(source: Array, step: Array) -> Any:
        padded = jnp.pad(source, steps[0], constant_values=-1)
        best, nearest = off(source), source
        for move in np.ndindex(3, 3):
            start = steps[0] + (np.array(move) - 1) * step
            other = jax.lax.dynamic_slice(padded, start, (height, width))
            distance = off(other)
            better = (distance < best) | ((distance == best) & (other < nearest))
            better = better & (other >= 0)
            best = jnp.where(better, distance, best)
            nearest = jnp.where(better, other, nearest)
        return nearest, None

    def one(seen_HW: Array) -> Array:
        # A scan, so that each pass is computed once and not anew by all that read it.
        return jax.lax.scan(flood, jnp.where(seen_HW, place, -1), jnp.array(steps))[0]

    source = jax.vmap(one)(jnp.asarray(view.seen_THW)).reshape(frames, -1)
    index, found = jnp.maximum(source, 0), source >= 0
    features = jnp.asarray(view.features_THWF).reshape(frames, height * width, -1)
    features = jnp.take_along_axis(features, index[:, :, None], 1)
    depth = jnp.take_along_axis(jnp.asarray(view.depth_THW).reshape(frames, -1), index, 1)
    return View(
        jnp.where(found[:, :, None], features, 0).reshape(view.features_THWF.shape),
        jnp.where(found, depth, 0).reshape(view.depth_THW.shape),
        view.seen_THW,
    )
