"""Actions and camera motion: poses from actions, actions from poses, cameras as numbers.

A planar action is (dx, dy, dyaw) in the agent's body frame: metres forward, metres to the left,
radians counter-clockwise; the agent first moves, then turns. Discrete actions are rows of a
table: 0 forward, 1 turn left, 2 turn right.

PERSIST (arXiv 2603.03482) describes a camera by ten numbers: two columns of its rotation
(arXiv 1812.07035), its position and its field of view. Its camera model predicts a camera step: the
change of position, pitch, yaw and field of view. Positions are relative to the middle of the voxel
grid and moves are relative to the heading before the step, so neither depends on where in the world
the agent is.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import ActionConfig
from pewm_jax.geometry.cameras import einsum, matmul, require_array
from pewm_jax.types import Array, Camera

FORWARD, TURN_LEFT, TURN_RIGHT = 0, 1, 2
PLANAR = 3
"""Width of a planar action; recorded actions of another width are another kind of control."""
NAMES = ("forward", "turn left", "turn right")


def discrete_table(config: ActionConfig) -> np.ndarray:
    """Return the (3, 3) table whose row a is the motion (dx, dy, dyaw) of discrete action a."""
    turn = math.radians(config.turn_deg)
    return np.array([[config.step_m, 0, 0], [0, 0, turn], [0, 0, -turn]], np.float32)


def continuous(config: ActionConfig, actions: Array) -> Array:
    """Return actions as (..., 3) floats; integer actions are looked up in the table."""
    if jnp.issubdtype(jnp.asarray(actions).dtype, jnp.integer):
        return jnp.asarray(discrete_table(config))[actions]
    return jnp.asarray(actions)


def rotation_z(angle: Array) -> Array:
    """Return (..., 3, 3) rotations about the world's z axis (up), radians."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    rows = [jnp.stack(r, -1) for r in ((c, -s, zero), (s, c, zero), (zero, zero, one))]
    return jnp.stack(rows, -2)


def heading(world_from_camera: Array) -> Array:
    """Return the yaw of cameras (..., 4, 4): the angle of their z axis on the ground."""
    forward = world_from_camera[..., :3, 2]
    return jnp.arctan2(forward[..., 1], forward[..., 0])


def step_pose(world_from_camera: Array, action_3: Array) -> Array:
    """Return the (4, 4) pose after one (dx, dy, dyaw) action; height and pitch stay."""
    yaw = heading(world_from_camera)
    ahead = jnp.stack([action_3[0], action_3[1], jnp.zeros_like(action_3[0])])
    move = matmul(rotation_z(yaw), ahead)
    rotation = matmul(rotation_z(action_3[2]), world_from_camera[:3, :3])
    top = jnp.concatenate([rotation, (world_from_camera[:3, 3] + move)[:, None]], 1)
    return jnp.concatenate([top, world_from_camera[3:]], 0)


def integrate(world_from_camera: Array, actions_T3: Array) -> Array:
    """Return the (T + 1, 4, 4) poses reached from a (4, 4) pose by (T, 3) actions.

    Raises:
        UserError: an argument has another type or shape, or is not finite.
    """
    require_array("integrate", "world_from_camera", world_from_camera, 4, 4)
    require_array("integrate", "actions_T3", actions_T3, None, 3)

    def step(pose, action):
        after = step_pose(pose, action)
        return after, after

    start = jnp.asarray(world_from_camera, jnp.float32)
    _, rest = jax.lax.scan(step, start, jnp.asarray(actions_T3, jnp.float32))
    return jnp.concatenate([start[None], rest], 0)


def compose(actions_S3: np.ndarray) -> np.ndarray:
    """Compose consecutive planar actions (..., S, 3) into single ones (..., 3), float32.

    They are the final position in the initial frame and the sum of the turns (not wrapped: a full
    circle is 2π).
    """
    moves = np.asarray(actions_S3, np.float64)
    dx, dy, turn = moves[..., 0], moves[..., 1], moves[..., 2]
    yaw = np.cumsum(turn, -1) - turn  # before each action
    forward = (np.cos(yaw) * dx - np.sin(yaw) * dy).sum(-1)
    left = (np.sin(yaw) * dx + np.cos(yaw) * dy).sum(-1)
    return np.stack([forward, left, turn.sum(-1)], -1).astype(np.float32)


def actions_between(world_from_camera_T: Array) -> Array:
    """Return the (T − 1, 3) actions between consecutive upright poses (T, 4, 4)."""
    pose = jnp.asarray(world_from_camera_T)
    yaw = heading(pose)
    delta = pose[1:, :3, 3] - pose[:-1, :3, 3]
    body = einsum("tji,tj->ti", rotation_z(yaw[:-1]), delta)
    turn = (yaw[1:] - yaw[:-1] + jnp.pi) % (2 * jnp.pi) - jnp.pi
    return jnp.stack([body[:, 0], body[:, 1], turn], -1)


def there_and_back(actions_T3: Array) -> Array:
    """Return planar actions (..., T, 3) and those that lead back: (..., 2 T, 3).

    The pose after k actions equals the pose after 2 T − k.
    """
    out = jnp.asarray(actions_T3)
    turn = -out[..., 2:]
    ahead = jnp.concatenate([out[..., :2], jnp.zeros_like(turn)], -1)
    move = matmul(rotation_z(turn[..., 0]), ahead[..., None])
    back = jnp.concatenate([-move[..., :2, 0], turn], -1)
    return jnp.concatenate([out, back[..., ::-1, :]], -2)


CAMERA_NUMBERS = 10
"""Numbers that describe a camera: rotation 6, position 3, field of view 1."""
CAMERA_STEP_NUMBERS = 6
"""Numbers of a camera step: forward, left, up in metres; pitch, yaw, field of view in radians."""
STEEPEST_PITCH = 1.55
"""Largest pitch, radians: a camera that looks straight up or down has no heading."""


def camera_numbers(camera: Camera, width: int, middle_3: Array) -> Array:
    """Return the (..., 10) numbers that describe cameras.

    Args:
        camera: cameras of any leading shape.
        width: width of the images that the intrinsics belong to, pixels.
        middle_3: (..., 3) the middle of each camera's voxel grid, metres.
    """
    pose = jnp.asarray(camera.world_from_camera)
    rotation = jnp.concatenate([pose[..., :3, 1], pose[..., :3, 2]], -1)
    view = field_of_view(camera, width)[..., None]
    return jnp.concatenate([rotation, pose[..., :3, 3] - middle_3, view], -1)


def field_of_view(camera: Camera, width: int) -> Array:
    """Return the horizontal field of view, radians."""
    return 2 * jnp.arctan2(width / 2.0, jnp.asarray(camera.intrinsics_4)[..., 0])


def pitch(world_from_camera: Array) -> Array:
    """Return the pitch of cameras (..., 4, 4), radians; positive looks up."""
    return jnp.arcsin(jnp.clip(world_from_camera[..., 2, 2], -1, 1))


def camera_steps_between(before: Camera, after: Camera, width: int) -> Array:
    """Return the steps (..., 6) that lead from upright cameras to others of the same shape.

    ``width`` is that of the images that the intrinsics belong to, pixels.
    """
    here, there = (jnp.asarray(x.world_from_camera) for x in (before, after))
    yaw = heading(here)
    away = there[..., :3, 3] - here[..., :3, 3]
    moved = einsum("...ji,...j->...i", rotation_z(yaw), away)
    turned = (heading(there) - yaw + jnp.pi) % (2 * jnp.pi) - jnp.pi
    tilted = pitch(there) - pitch(here)
    widened = field_of_view(after, width) - field_of_view(before, width)
    return jnp.concatenate([moved, jnp.stack([tilted, turned, widened], -1)], -1)


def follow_camera_steps(before: Camera, step_6: Array, width: int) -> Camera:
    """Return the upright cameras after steps (..., 6); the inverse of ``camera_steps_between``.

    The roll of the cameras before is dropped.
    """
    here, intrinsics = jnp.asarray(before.world_from_camera), jnp.asarray(before.intrinsics_4)
    moved = einsum("...ij,...j->...i", rotation_z(heading(here)), step_6[..., :3])
    position = here[..., :3, 3] + moved
    up = jnp.clip(pitch(here) + step_6[..., 3], -STEEPEST_PITCH, STEEPEST_PITCH)
    yaw = heading(here) + step_6[..., 4]
    view = jnp.clip(field_of_view(before, width) + step_6[..., 5], 0.1, 3.0)
    focal = width / 2.0 / jnp.tan(view / 2)
    zoomed = intrinsics[..., :2] * (focal / intrinsics[..., 0])[..., None]
    flat, none = jnp.cos(up), jnp.zeros_like(up)
    ahead = jnp.stack([jnp.cos(yaw) * flat, jnp.sin(yaw) * flat, jnp.sin(up)], -1)
    right = jnp.stack([jnp.sin(yaw), -jnp.cos(yaw), none], -1)
    columns = jnp.stack([right, jnp.cross(ahead, right), ahead, position], -1)
    last = jnp.broadcast_to(jnp.array([0.0, 0, 0, 1]), (*columns.shape[:-2], 1, 4))
    pose = jnp.concatenate([columns, last], -2)
    return Camera(jnp.concatenate([zoomed, intrinsics[..., 2:]], -1), pose)
