"""Rendering points by splatting them into a z-buffer.

Shapes are static and the result is deterministic. Each point covers the one pixel that it projects
to. Of several points at a pixel the nearest is seen; ties go to the lowest index.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from pewm_jax.geometry.cameras import project
from pewm_jax.types import Array, Camera

NEAREST_M = 0.05
"""Points nearer to the camera plane than this are not seen, metres."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class View:
    """The images of T cameras.

    Attributes:
        features_THWF: (T, H, W, F) features of the nearest point at each pixel, 0 without one.
        depth_THW: (T, H, W) its depth along z, metres, 0 without one.
        seen_THW: (T, H, W) bool, whether a point is at the pixel.
    """

    features_THWF: Array
    depth_THW: Array
    seen_THW: Array


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
