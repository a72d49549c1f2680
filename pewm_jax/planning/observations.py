"""Observation and action spaces, and conversion of observations to the frames that worlds take.

An observation is a dictionary:

    rgb    (H, W, 3) uint8
    depth  (H, W) float32, metres along z, 0 = no measurement
    pose   (4, 4) float32, world_from_camera, OpenCV axes, z up, metres
    goal   (2,) float32, metres forward and metres left of the agent (task ``point``), or
           (H, W, 3) uint8, the image at the goal (task ``image``)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.data.episodes import DEPTH_LIMIT_M
from pewm_jax.geometry.actions import NAMES, discrete_table
from pewm_jax.planning.extra import gymnasium
from pewm_jax.planning.house_config import HouseConfig
from pewm_jax.types import Camera, Frames

FARTHEST_M = 1e4
"""Bound of positions in the spaces, which must be bounded, metres."""
_ROUNDING = 1e-6


def observation_space(config: HouseConfig) -> gymnasium.spaces.Dict:
    """Return the observation space; see the module docstring."""
    size = (config.height, config.width)
    box = gymnasium.spaces.Box
    image = box(0, 255, (*size, 3), np.uint8)
    point = box(-FARTHEST_M, FARTHEST_M, (2,), np.float32)
    return gymnasium.spaces.Dict(
        {
            "rgb": image,
            "depth": box(0, DEPTH_LIMIT_M, size, np.float32),
            "pose": box(-FARTHEST_M, FARTHEST_M, (4, 4), np.float32),
            "goal": box(0, 255, (*size, 3), np.uint8) if config.task == "image" else point,
        }
    )


def action_space(config: HouseConfig) -> gymnasium.Space:
    """Return ``Discrete(3)``, or a box of (dx, dy, dyaw)."""
    if config.actions == "discrete":
        return gymnasium.spaces.Discrete(len(NAMES))
    high = np.array([config.step_m, config.step_m, math.radians(config.turn_deg)], np.float32)
    return gymnasium.spaces.Box(-high, high, dtype=np.float32)


def require_action(config: HouseConfig, action: Any) -> np.ndarray:
    """Return an action as (dx, dy, dyaw), float64.

    Args:
        config: defines the action space.
        action: 0, 1 or 2; or three numbers.

    Raises:
        UserError: it is not in the space, or not finite.
    """
    if config.actions == "discrete":
        value = np.asarray(action)
        known = ", ".join(f"{number} {name}" for number, name in enumerate(NAMES))
        if value.size != 1 or value.dtype.kind not in "iu" or not 0 <= value.item() < len(NAMES):
            raise UserError(f"step() got the action {action!r}; choose from {known}.")
        return discrete_table(config.action_config)[value.item()].astype(np.float64)
    high = [config.step_m, config.step_m, math.radians(config.turn_deg)]
    try:
        value = np.asarray(action, np.float64)
    except (TypeError, ValueError):
        value = np.zeros(())
    if value.shape != (3,) or not bool((np.abs(value) <= np.array(high) + _ROUNDING).all()):
        raise UserError(
            f"step() got the action {action!r}; give three finite numbers (dx, dy, dyaw), metres "
            f"forward and left up to ±{high[0]:g}, radians counter-clockwise up to ±{high[2]:.4g}."
        )
    return value


def goal_in_frame(planar_3: np.ndarray, goal_xy: np.ndarray) -> np.ndarray:
    """Return a goal (2,) float32 relative to the agent: metres forward, metres left."""
    cos, sin = math.cos(planar_3[2]), math.sin(planar_3[2])
    x, y = np.asarray(goal_xy, np.float64) - np.asarray(planar_3[:2], np.float64)
    return np.array([cos * x + sin * y, -sin * x + cos * y], np.float32)


def planar_of(world_from_camera: np.ndarray) -> np.ndarray:
    """Return x, y, yaw (..., 3) float64 of cameras (..., 4, 4)."""
    pose = np.asarray(world_from_camera, np.float64)
    yaw = np.arctan2(pose[..., 1, 2], pose[..., 0, 2])
    return np.concatenate([pose[..., :2, 3], yaw[..., None]], -1)


def frames_of(observations: Sequence[Mapping[str, Any]], intrinsics_4: np.ndarray) -> Frames:
    """Return observations as frames, for ``worlds.start`` and ``worlds.observe``.

    Args:
        observations: S ≥ 1 observations, in order; the last one is the present.
        intrinsics_4: (4,) fx, fy, cx, cy: ``env.unwrapped.intrinsics_4``.

    Raises:
        UserError: there are none.
    """
    if not observations:
        raise UserError("frames_of() got no observations; give at least one.")
    rgb, depth, pose = (
        np.stack([seen[name] for seen in observations]) for name in ("rgb", "depth", "pose")
    )
    intrinsics = np.tile(np.asarray(intrinsics_4, np.float32), (len(observations), 1))
    return Frames(rgb, depth, Camera(intrinsics, pose))
