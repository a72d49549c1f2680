"""Depth images: filling their holes, and the normals of the surfaces they show.

Holes are filled from the nearest known pixel, found by jump flooding (steps of …, 4, 2, 1 and once
more 1 pixels): the number of passes is static, and in rare cases the found pixel is slightly
farther away than the nearest.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.geometry.cameras import unproject
from pewm_jax.types import Array, Camera


def nearest_known(known_THW: Array) -> tuple[Array, Array]:
    """Return the nearest known pixel of each pixel of (T, H, W) images.

    Returns:
        ``(index, found)``, both (T, H·W): the linear index of the nearest known pixel in the same
        image (a known pixel's own index), and False where an image has no known pixel.
    """
    frames, height, width = known_THW.shape
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
        best, found = off(source), source
        for move in np.ndindex(3, 3):
            start = steps[0] + (np.array(move) - 1) * step
            other = jax.lax.dynamic_slice(padded, start, (height, width))
            distance = off(other)
            better = (distance < best) | ((distance == best) & (other < found))
            better = better & (other >= 0)
            best = jnp.where(better, distance, best)
            found = jnp.where(better, other, found)
        return found, None

    def one(known_HW: Array) -> Array:
        # Use a scan: unrolled passes would be fused and recomputed by each of their consumers.
        return jax.lax.scan(flood, jnp.where(known_HW, place, -1), jnp.array(steps))[0]

    source = jax.vmap(one)(jnp.asarray(known_THW)).reshape(frames, -1)
    return jnp.maximum(source, 0), source >= 0


def fill_depth(depth_THW: Array, otherwise: float) -> Array:
    """Return depths (T, H, W) whose holes (0) have the depth of the nearest measured pixel.

    Images without any measurement get the depth ``otherwise``, metres. Images without holes are
    returned unchanged, at no cost.
    """
    depth = jnp.asarray(depth_THW)

    def fill(depth: Array) -> Array:
        index, found = nearest_known(depth > 0)
        near = jnp.take_along_axis(depth.reshape(len(depth), -1), index, 1)
        return jnp.where(found, near, otherwise).reshape(depth.shape).astype(depth.dtype)

    return jax.lax.cond((depth > 0).all(), lambda depth: depth, fill, depth)


def normals(depth_THW: Array, camera: Camera) -> Array:
    """Return the unit normals (T, H, W, 3) of the surfaces at pixels, turned towards the camera.

    Along each image axis the difference is taken to the neighbour with the closer depth, so that
    depth edges do not bend the normal. They are in the world, and 0 where the depth of the
    neighbours is unknown.
    """
    depth, camera = jax.tree.map(jnp.asarray, (depth_THW, camera))
    points = unproject(depth, camera)
    across, is_across = _step(points, depth, 2)
    down, is_down = _step(points, depth, 1)
    rays = points - camera.world_from_camera[:, None, None, :3, 3]
    (a, b, c), (d, e, f), (x, y, z) = (jnp.moveaxis(v, -1, 0) for v in (across, down, rays))
    normal = b * f - c * e, c * d - a * f, a * e - b * d  # by coordinates: a CPU's fastest form
    length = jnp.sqrt(sum(jnp.square(part) for part in normal))
    away = x * normal[0] + y * normal[1] + z * normal[2] > 0
    known = (depth > 0) & jnp.isfinite(depth) & is_across & is_down
    scale = jnp.where(away, -1.0, 1.0) * jnp.where(length > 0, length, 1)
    return jnp.stack([jnp.where(known, part / scale, 0) for part in normal], -1)


def _step(points_THW3: Array, depth_THW: Array, axis: int) -> tuple[Array, Array]:
    """Return the difference to the next point along an image axis, and whether it is known."""
    count = depth_THW.shape[axis]
    place = np.arange(count).reshape([-1 if a == axis else 1 for a in range(depth_THW.ndim)])
    ahead, behind = jnp.roll(points_THW3, -1, axis), jnp.roll(points_THW3, 1, axis)

    def apart(moved: int, edge: int) -> Array:
        other = jnp.roll(depth_THW, moved, axis)
        measured = (other > 0) & jnp.isfinite(other) & (place != edge)
        return jnp.where(measured, jnp.abs(other - depth_THW), jnp.inf)

    forward, backward = apart(-1, count - 1), apart(1, 0)
    nearer = (forward <= backward)[..., None]
    step = jnp.where(nearer, ahead - points_THW3, points_THW3 - behind)
    return step, jnp.isfinite(jnp.minimum(forward, backward))
