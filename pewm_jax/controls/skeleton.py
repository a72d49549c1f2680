"""Drawings of a body's bones, as its camera sees them: a picture of what joint angles mean.

Which pixels an arm covers follows from the joints by kinematics. A network that is only told the
angles has to learn that; one that is given the drawing has to learn what the arm looks like.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.bodies.kinematics import Body
from pewm_jax.types import Array

POINTS = 12
"""Points of a bone that are drawn."""
RADIUS_M = 0.06
"""Radius at which a drawing has fallen to 1/e, metres."""
NEAREST_M = 0.05
"""Points nearer to the camera than this are not drawn, metres."""
SMALLEST = 0.7
"""The least radius of a drawn point, pixels."""


def draw_bones(
    body: Body, state_BTA: Array, intrinsics_BT4: Array, height: int, width: int
) -> Array:
    """Return (B, T, H, W, G) drawings of the groups of bones (``Body.bones``), 0 to 1.

    Args:
        body: the body.
        state_BTA: its states.
        intrinsics_BT4: fx, fy, cx, cy of the camera that its eyes carry.
        height: of the image, pixels.
        width: of the image, pixels.
    """
    places_BTL3 = body.seen_places(jnp.asarray(state_BTA))
    share = jnp.asarray((np.arange(POINTS) + 0.5) / POINTS)[:, None]
    rows = jnp.arange(height) + 0.5
    columns = jnp.arange(width) + 0.5

    def drawn(points_P3: Array, intrinsics_4: Array) -> Array:
        fx, fy, cx, cy = intrinsics_4
        x, y, z = points_P3.T
        far = jnp.maximum(z, NEAREST_M)
        radius = jnp.maximum(RADIUS_M * fx / far, SMALLEST)
        across = (columns[:, None] - (x / far * fx + cx)) / radius
        along = (rows[:, None] - (y / far * fy + cy)) / radius
        off = jnp.square(along)[:, None] + jnp.square(across)[None]  # (H, W, P)
        return jnp.exp(-jnp.where(z > NEAREST_M, off, jnp.inf).min(-1))

    groups = []
    for group in body.bones:
        begin, end = (
            places_BTL3[..., [body.links.index(one[k]) for one in group], :] for k in (0, 1)
        )
        points = begin[..., None, :] + share * (end - begin)[..., None, :]
        flat = points.reshape(*points.shape[:2], -1, 3)
        groups.append(jax.vmap(jax.vmap(drawn))(flat, jnp.asarray(intrinsics_BT4)))
    return jnp.stack(groups, -1)
