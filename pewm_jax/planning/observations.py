"""What environments with a goal share: spaces, episodes, and observations as frames for worlds.

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
from typing import Any, ClassVar

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.data.episodes import DEPTH_LIMIT_M
from pewm_jax.geometry.actions import NAMES, discrete_table
from pewm_jax.planning.house_config import HouseConfig
from pewm_jax.types import Camera, Frames

try:
    import gymnasium
except ImportError:
    raise UserError(
        "environments need Gymnasium, which is not installed: pip install 'pewm-jax[planning]'."
    ) from None

FARTHEST_M = 1e4
"""Bound of positions in the spaces, which must be bounded, metres."""
_ROUNDING = 1e-6


class GoalEnv(gymnasium.Env):
    """An environment in which an agent with an RGB-D camera has to reach a goal.

    Attributes:
        config: the settings.
        intrinsics_4: (4,) fx, fy, cx, cy of the camera, pixels, centres at +0.5.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 8}
    intrinsics_4: np.ndarray
    _seen: Mapping[str, np.ndarray]
    """The present observation, without the goal."""

    def __init__(self, config: HouseConfig, render_mode: str | None, who: str):
        if render_mode not in (None, "rgb_array"):
            raise UserError(f"{who} has no render_mode {render_mode!r}; use 'rgb_array'.")
        self.config, self.render_mode = config, render_mode
        self.observation_space = observation_space(config)
        self.action_space = action_space(config)
        self._begun, self._over = False, True

    def render(self) -> np.ndarray | None:
        """Return the current image, (H, W, 3) uint8, with render mode "rgb_array".

        Raises:
            UserError: before the first ``reset``.
        """
        if self.render_mode is None:
            return None
        if not self._begun:
            raise UserError("render() was called before the first reset(): call reset() first.")
        return self._seen["rgb"].copy()

    def _begin_episode(self) -> None:
        self._steps, self._walked, self._begun, self._over = 0, 0.0, True, False

    def _require_episode(self) -> None:
        if self._over:
            raise UserError("step() was called outside of an episode: call reset() first.")

    def _observation(self) -> dict[str, np.ndarray]:
        """Return the present observation."""
        return {
            **{name: value.copy() for name, value in self._seen.items()},
            "goal": self._goal_seen(),
        }

    def _goal_seen(self) -> np.ndarray:
        """Return the goal as the agent observes it."""
        raise NotImplementedError

    def _info(self) -> dict[str, Any]:
        """Return facts about the present state, ``success`` among them."""
        raise NotImplementedError

    def _outcome(
        self, nearer: float
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Return the results of a step that brought the agent nearer to the goal."""
        info = self._info()
        success = info["success"]
        truncated = not success and self._steps >= self.config.max_steps
        self._over = success or truncated
        reward = nearer + (self.config.success_reward if success else 0.0)
        return self._observation(), reward, success, truncated, info


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
    """Return an action of the configured space (0, 1 or 2; or three numbers) as dx, dy, dyaw.

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
    """Return observations, the present last, as frames for ``worlds.start`` and ``worlds.observe``.

    ``intrinsics_4`` are fx, fy, cx, cy: ``env.unwrapped.intrinsics_4``.

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
