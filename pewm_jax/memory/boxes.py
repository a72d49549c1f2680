"""Boxes and rigid transforms that parts of a memory are named and moved by; bad ones are refused.

A box is (2, 3), its lower and upper corner in the world, metres. Lower faces belong to it, upper
ones do not. A transform is a rigid (4, 4) matrix from old to new positions.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from pewm_jax.config import UserError
from pewm_jax.types import Array


def within(points_V3: Array, valid_V: Array, box_23: Array) -> Array:
    """Return (V,) bool: which valid points lie in a box.

    Args:
        points_V3: (V, 3) world points, metres.
        valid_V: (V,) bool.
        box_23: (2, 3) lower and upper corner.

    Raises:
        UserError: the box is not a box.
    """
    box_23 = jnp.asarray(box_23, jnp.float32)
    if box_23.shape != (2, 3):
        raise UserError(
            f"a box is its lower and its upper corner, shape (2, 3), in metres; got {box_23.shape}."
        )
    if not isinstance(box_23, Tracer) and not np.all(box_23[0] <= box_23[1]):
        raise UserError(
            f"the box's lower corner {box_23[0]} is not below its upper corner {box_23[1]}; give "
            "the lower one first."
        )
    return valid_V & ((points_V3 >= box_23[0]) & (points_V3 < box_23[1])).all(-1)


def rigid(transform: Array | None, who: str) -> Array:
    """Return a (4, 4) float32 transform; None is the identity.

    Args:
        transform: rigid, from old to new positions, metres.
        who: the function that got it, for the message.

    Raises:
        UserError: it is not a rigid 4×4 (under jit only its shape is checked).
    """
    found = jnp.eye(4) if transform is None else jnp.asarray(transform, jnp.float32)
    if found.shape != (4, 4):
        raise UserError(f"{who}() got a transform of shape {found.shape}; give a rigid 4×4.")
    if not isinstance(found, Tracer) and not _is_rigid(np.asarray(found)):
        raise UserError(f"{who}() got a transform that is not rigid; give a rotation and a shift.")
    return found


def _is_rigid(transform: np.ndarray) -> bool:
    turn = transform[:3, :3]
    turns = np.allclose(turn @ turn.T, np.eye(3), atol=1e-4) and np.linalg.det(turn) > 0
    return bool(turns and (transform[3] == (0, 0, 0, 1)).all() and np.isfinite(transform).all())
