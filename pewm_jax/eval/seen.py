"""Seen-before masks: which pixels of a frame show surfaces that earlier frames have seen.

The masks are exact up to the sampling of the images: a pixel's true 3D point is projected into each
earlier frame and compared with that frame's true depth. No network is involved.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pewm_jax.geometry.cameras import project, unproject
from pewm_jax.types import Array, Camera, Frames

TOLERANCE_M, TOLERANCE_RELATIVE = 0.05, 0.03
"""Two depths of one surface agree within the larger of 5 cm and 3 %."""


def _agrees(depth_P: Array, z_P: Array) -> Array:
    close = jnp.maximum(TOLERANCE_M, TOLERANCE_RELATIVE * z_P)
    return (depth_P > 0) & (jnp.abs(depth_P - z_P) <= close)


def visible_in(points_world_P3: Array, depth_HW: Array, camera: Camera) -> Array:
    """Return which points (P,) are visible in a depth image.

    A point is visible if it projects inside the image, in front of the camera, and its depth agrees
    with the image there: either with the nearest pixel, or with 1/depth interpolated between the
    four surrounding pixels. (On a plane 1/depth is linear in the image. So a floor seen at a
    grazing angle is recognised, although its depth changes by more than the tolerance from row to
    row.) Depths are z, metres; 0 = no measurement.
    """
    height, width = depth_HW.shape
    uv, z = project(points_world_P3, camera)
    u, v = uv[:, 0], uv[:, 1]
    inside = (z > 1e-3) & (u >= 0) & (u < width) & (v >= 0) & (v < height)

    # One gather for the four pixels around a point, which include the nearest.
    padded = jnp.pad(depth_HW, 1, mode="edge")
    four = [padded[i : i + height + 1, j : j + width + 1] for i in (0, 1) for j in (0, 1)]
    left, top = jnp.floor(u - 0.5), jnp.floor(v - 0.5)
    across, down = u - 0.5 - left, v - 0.5 - top
    row = jnp.clip(top + 1, 0, height).astype(jnp.int32)
    column = jnp.clip(left + 1, 0, width).astype(jnp.int32)
    corners = jnp.moveaxis(jnp.stack(four, -1)[row, column], -1, 0)
    upper, lower = (jnp.where(across < 0.5, corners[i], corners[i + 1]) for i in (0, 2))
    nearest = jnp.where(down < 0.5, upper, lower)
    weights = jnp.stack(
        [(1 - down) * (1 - across), (1 - down) * across, down * (1 - across), down * across]
    )
    measured = (corners > 0).all(0)
    inverse = (weights / jnp.where(corners > 0, corners, 1)).sum(0)
    between = jnp.where(measured, 1 / inverse, 0)
    return inside & (_agrees(nearest, z) | _agrees(between, z))


def seen_masks(target: Frames, context: Frames) -> tuple[Array, Array]:
    """Return the bool masks ``(seen_THW, unseen_THW)`` of the pixels seen before and never seen.

    Both arguments have true depth and poses. A pixel without depth is in neither.
    """
    depth_THW = jnp.asarray(target.depth_THW)
    points = unproject(depth_THW, target.camera).reshape(-1, 3)

    def look(seen_P, frame):
        depth_HW, camera = frame
        return seen_P | visible_in(points, depth_HW, camera), None

    none = jnp.zeros(points.shape[0], bool)
    frames = (jnp.asarray(context.depth_THW), jax.tree.map(jnp.asarray, context.camera))
    seen_P, _ = jax.lax.scan(look, none, frames)
    measured = depth_THW > 0
    seen_THW = seen_P.reshape(depth_THW.shape) & measured
    return seen_THW, measured & ~seen_THW


seen_masks_batch = jax.jit(jax.vmap(seen_masks))
"""``seen_masks`` over a batch of clips."""
