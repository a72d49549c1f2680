"""What a camera sees of points: a z-buffer over the pixels they fall on.

Static shapes, deterministic, jitted. Each point covers the one pixel that it projects to; of
several the nearest is seen, of equally near ones that of the lowest index.
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
    """What T cameras see.

    Attributes:
        features_THWF: (T, H, W, F) of the nearest point at each pixel, 0 where none is.
        depth_THW: (T, H, W) its depth along z, metres, 0 where none is.
        seen_THW: (T, H, W) bool, where there is one.
    """

    features_THWF: Array
    depth_THW: Array
    seen_THW: Array


def splat(
    points_V3: Array, features_VF: Array, valid_V: Array, camera: Camera, height: int, width: int
) -> View:
    """Return what cameras see of points.

    Args:
        points_V3: (V, 3) in the world, metres.
        features_VF: (V, F).
        valid_V: (V,) bool; others are not there.
        camera: (T,) cameras, whose intrinsics are for images of ``height`` × ``width``.
        height: of the images, pixels.
        width: of the images, pixels.
    """
    count, pixels = len(points_V3), height * width

    def one(camera: Camera) -> tuple[Array, Array, Array]:
        uv, z = project(points_V3, camera)
        column, row = (jnp.floor(uv[:, i]).astype(jnp.int32) for i in (0, 1))
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        there = inside & valid_V & (z > NEAREST_M)
        pixel = jnp.where(there, row * width + column, pixels)
        depth = jnp.full((pixels,), jnp.inf).at[pixel].min(z, mode="drop")
        first = there & (z <= depth[jnp.minimum(pixel, pixels - 1)])
        index = (
            jnp.full((pixels,), count)
            .at[jnp.where(first, pixel, pixels)]
            .min(jnp.arange(count), mode="drop")
        )
        seen = index < count
        features = jnp.where(seen[:, None], features_VF[jnp.minimum(index, count - 1)], 0)
        return features, jnp.where(seen, depth, 0), seen

    features, depth, seen = jax.vmap(one)(camera)
    frames = depth.shape[0]
    return View(
        features.reshape(frames, height, width, -1),
        depth.reshape(frames, height, width),
        seen.reshape(frames, height, width),
    )
