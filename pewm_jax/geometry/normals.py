"""Which way surfaces face, from depth images."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from pewm_jax.geometry.cameras import unproject
from pewm_jax.types import Array, Camera


def normals(depth_THW: Array, camera: Camera) -> Array:
    """Return the unit normals of what is seen at pixels, turned towards the camera.

    Across and down, a pixel's surface is taken to go on to that neighbour whose depth is closer, so
    that edges do not bend it.

    Args:
        depth_THW: (T, H, W) metres along the axis of view, 0 where not measured.
        camera: (T,) cameras.

    Returns:
        (T, H, W, 3) in the world; 0 where a neighbour's depth was not measured, or there is none.
    """
    depth = jnp.asarray(depth_THW)
    points = unproject(depth, camera)
    across, is_across = _step(points, depth, 2)
    down, is_down = _step(points, depth, 1)
    normal = jnp.cross(across, down)
    length = jnp.linalg.norm(normal, axis=-1, keepdims=True)
    rays = points - jnp.asarray(camera.world_from_camera)[:, None, None, :3, 3]
    away = (rays * normal).sum(-1, keepdims=True) > 0
    normal = jnp.where(away, -normal, normal) / jnp.where(length > 0, length, 1)
    known = (depth > 0) & jnp.isfinite(depth) & is_across & is_down
    return jnp.where(known[..., None], normal, 0)


def _step(points_THW3: Array, depth_THW: Array, axis: int) -> tuple[Array, Array]:
    """Return the way to the next point along an axis, and whether there is one."""
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
