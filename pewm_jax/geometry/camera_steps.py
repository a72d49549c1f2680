"""What a camera is in ten numbers, and how one upright camera leads to the next.

The numbers are PERSIST's (arXiv 2603.03482): two columns of the rotation (arXiv 1812.07035), the
position, the field of view. A step is what its camera model predicts: a change of position, pitch,
yaw and field of view. Positions are counted from the middle of the voxel grid, and moves along the
heading before the step, so that neither depends on where in the world the agent is.
"""

from __future__ import annotations

import jax.numpy as jnp

from pewm_jax.geometry.actions import heading, rotation_z
from pewm_jax.geometry.cameras import einsum
from pewm_jax.types import Array, Camera

NUMBERS = 10
"""Numbers of a camera: rotation 6, position 3, field of view 1."""
STEPS = 6
"""Numbers of a step: forward, left and up in metres; pitch, yaw and field of view in radians."""
STEEPEST = 1.55
"""Largest pitch, radians: straight up and down there is no heading."""


def numbers(camera: Camera, width: int, middle_3: Array) -> Array:
    """Return (..., 10) numbers of cameras.

    Args:
        camera: cameras of any leading shape.
        width: of the images that their intrinsics are for, pixels.
        middle_3: (..., 3) the middle of each one's voxel grid, metres.
    """
    pose = jnp.asarray(camera.world_from_camera)
    rotation = jnp.concatenate([pose[..., :3, 1], pose[..., :3, 2]], -1)
    view = field_of_view(camera, width)[..., None]
    return jnp.concatenate([rotation, pose[..., :3, 3] - middle_3, view], -1)


def field_of_view(camera: Camera, width: int) -> Array:
    """Return the horizontal field of view, radians."""
    return 2 * jnp.arctan2(width / 2.0, jnp.asarray(camera.intrinsics_4)[..., 0])


def pitch(world_from_camera: Array) -> Array:
    """Return by how much cameras (..., 4, 4) look up, radians."""
    return jnp.arcsin(jnp.clip(world_from_camera[..., 2, 2], -1, 1))


def between(before: Camera, after: Camera, width: int) -> Array:
    """Return the steps (..., 6) that lead from cameras to others of the same shape.

    Args:
        before: upright cameras.
        after: upright cameras.
        width: of the images that their intrinsics are for, pixels.
    """
    here, there = (jnp.asarray(x.world_from_camera) for x in (before, after))
    yaw = heading(here)
    away = there[..., :3, 3] - here[..., :3, 3]
    moved = einsum("...ji,...j->...i", rotation_z(yaw), away)
    turned = (heading(there) - yaw + jnp.pi) % (2 * jnp.pi) - jnp.pi
    tilted = pitch(there) - pitch(here)
    widened = field_of_view(after, width) - field_of_view(before, width)
    return jnp.concatenate([moved, jnp.stack([tilted, turned, widened], -1)], -1)


def follow(before: Camera, step_6: Array, width: int) -> Camera:
    """Return the upright cameras to which steps lead: the inverse of ``between``.

    Args:
        before: cameras; a roll is not kept.
        step_6: (..., 6) steps.
        width: of the images that the intrinsics are for, pixels.
    """
    here, intrinsics = jnp.asarray(before.world_from_camera), jnp.asarray(before.intrinsics_4)
    moved = einsum("...ij,...j->...i", rotation_z(heading(here)), step_6[..., :3])
    place = here[..., :3, 3] + moved
    up = jnp.clip(pitch(here) + step_6[..., 3], -STEEPEST, STEEPEST)
    yaw = heading(here) + step_6[..., 4]
    view = jnp.clip(field_of_view(before, width) + step_6[..., 5], 0.1, 3.0)
    focal = width / 2.0 / jnp.tan(view / 2)
    zoomed = intrinsics[..., :2] * (focal / intrinsics[..., 0])[..., None]
    flat, none = jnp.cos(up), jnp.zeros_like(up)
    ahead = jnp.stack([jnp.cos(yaw) * flat, jnp.sin(yaw) * flat, jnp.sin(up)], -1)
    right = jnp.stack([jnp.sin(yaw), -jnp.cos(yaw), none], -1)
    columns = jnp.stack([right, jnp.cross(ahead, right), ahead, place], -1)
    last = jnp.broadcast_to(jnp.array([0.0, 0, 0, 1]), (*columns.shape[:-2], 1, 4))
    pose = jnp.concatenate([columns, last], -2)
    return Camera(jnp.concatenate([zoomed, intrinsics[..., 2:]], -1), pose)
