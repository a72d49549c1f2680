"""Holes in images: the nearest pixel that has a value.

By jump flooding (steps of …, 4, 2, 1 and once more 1 pixels): a static number of passes, and seldom
a pixel that is a little farther than the nearest.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.types import Array


def nearest(known_THW: Array) -> tuple[Array, Array]:
    """Find for each pixel the nearest pixel of its image that is known.

    Args:
        known_THW: (T, H, W) bool.

    Returns:
        ``(index, found)``, both (T, H·W): the linear index of that pixel in its image, its own
        where it is known, and False where an image has none.
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
        # A scan, so that each pass is computed once and not anew by all that read it.
        return jax.lax.scan(flood, jnp.where(known_HW, place, -1), jnp.array(steps))[0]

    source = jax.vmap(one)(jnp.asarray(known_THW)).reshape(frames, -1)
    return jnp.maximum(source, 0), source >= 0


def fill_depth(depth_THW: Array, otherwise: float) -> Array:
    """Give pixels that were not measured the depth of the nearest that was; no work without holes.

    Args:
        depth_THW: (T, H, W) metres, 0 where not measured.
        otherwise: depth of an image without any measurement, metres.
    """
    depth = jnp.asarray(depth_THW)

    def fill(depth: Array) -> Array:
        index, found = nearest(depth > 0)
        near = jnp.take_along_axis(depth.reshape(len(depth), -1), index, 1)
        return jnp.where(found, near, otherwise).reshape(depth.shape).astype(depth.dtype)

    return jax.lax.cond((depth > 0).all(), lambda depth: depth, fill, depth)
