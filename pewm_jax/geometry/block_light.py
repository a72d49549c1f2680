"""Lighting of block worlds: it depends on the side of a block, on distance, and on nearby corners.

``data.voxel_pictures`` renders with it; PERSIST's world inverts it to read the colours of blocks.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from pewm_jax.types import Array

SIDES = (0.88, 0.74, 1.0, 0.5)
"""Light on sides perpendicular to x, y and z, and on the cell in which a ray starts."""
BELOW = 0.62
"""Light on a side seen from below, such as a ceiling."""
HALF_M = 7.0
"""Distance at which light falls to one half, metres."""
CORNER, CORNER_M = 0.35, 0.2
"""Darkening in a corner, and the distance from the corner at which it ends, metres."""


def light(
    occupied_XYZ: Array,
    low_3: Array,
    cell_m: float | Array,
    eye_3: Array,
    way_HW3: Array,
    far_HW: Array,
    side_HW: Array,
) -> Array:
    """Return the (H, W) factors that multiply the colours of the cells that rays hit.

    Args:
        occupied_XYZ: bool, which cells are occupied.
        low_3: lowest corner of the grid, metres.
        cell_m: side of a cell, metres.
        eye_3: origin of the rays, metres.
        way_HW3: (H, W, 3) directions of the rays.
        far_HW: distance from the origin to the hit cell, in lengths of the direction.
        side_HW: axis (0, 1, 2) across which the ray enters the cell; −1 if it starts inside.
    """
    facing = jnp.asarray(SIDES, jnp.float32)[side_HW]
    facing = jnp.where((side_HW == 2) & (way_HW3[..., 2] > 0), BELOW, facing)
    metres = far_HW * jnp.linalg.norm(way_HW3, axis=-1)
    at = (eye_3 - low_3 + far_HW[..., None] * way_HW3) / cell_m
    dark = _corner_darkness(occupied_XYZ, cell_m, at, way_HW3, side_HW)
    return facing / (1 + jnp.square(metres / HALF_M)) * (1 - CORNER * dark)


def side_of(at_HW3: Array) -> Array:
    """Return the (H, W) axis of the cell border nearest to points on the sides of cells.

    Args:
        at_HW3: points, in cells from the grid's lowest corner.
    """
    return jnp.abs(at_HW3 - jnp.round(at_HW3)).argmin(-1)


def _corner_darkness(
    occupied_XYZ: Array, cell_m: float | Array, at_HW3: Array, way_HW3: Array, side_HW: Array
) -> Array:
    """Return (H, W) how close points are to a corner: 1 in it, 0 from ``CORNER_M`` on."""
    met = side_HW >= 0
    across = np.arange(3) == jnp.where(met, side_HW, 0)[..., None]
    # The open cell in front of the side, from which the ray comes.
    before = jnp.where(across, jnp.round(at_HW3) - (way_HW3 > 0), jnp.floor(at_HW3))
    before, inside = before.astype(jnp.int32), at_HW3 - jnp.floor(at_HW3)
    shape, dark = np.array(occupied_XYZ.shape), jnp.zeros(side_HW.shape)
    for axis in range(3):
        for sign in (-1, 1):
            beside = before + sign * (np.arange(3) == axis)
            within = ((beside >= 0) & (beside < shape)).all(-1)
            x, y, z = jnp.moveaxis(jnp.clip(beside, 0, shape - 1), -1, 0)
            wall = met & within & occupied_XYZ[x, y, z] & ~across[..., axis]
            gap = inside[..., axis] if sign < 0 else 1 - inside[..., axis]
            dark = jnp.maximum(dark, jnp.where(wall, 1 - gap * cell_m / CORNER_M, 0))
    return dark
