"""A world as a Gymnasium environment with the spaces of ``pewm_jax/House-v0``.

A policy for the house runs in it unchanged: its observations are imagined. An episode starts from
real frames, of the configured house or passed by the caller.

Reward and goal differ from the house's, because imagination has no collision detection: the reward
of a step is the decrease of the Euclidean distance to the goal in metres, plus ``success_reward``
if it reaches the goal. With a custom cost, the reward is the decrease of that cost, and the goal is
reached when it is at most ``cost_at_most``.

``info`` contains ``position_error``, ``yaw_error``, ``success``, ``steps``, ``path_length`` and
``goal_pose`` as in the house, and ``cost`` if one is given. There are no collisions, and a goal on
the other side of a wall may count as reached; with ``blocks``, obstacles that were seen at the
start block a move.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from pewm_jax import worlds
from pewm_jax.codecs.signals import rgb_from_signal
from pewm_jax.config import Config, UserError, World
from pewm_jax.data.episodes import DEPTH_LIMIT_M
from pewm_jax.data.trajectories import advance
from pewm_jax.planning import imagined, observations, scores
from pewm_jax.planning.house import HouseEnv
from pewm_jax.planning.house_config import HouseConfig
from pewm_jax.planning.observations import GoalEnv
from pewm_jax.planning.practice import FloorMap
from pewm_jax.types import Frames, Params


class WorldModelEnv(GoalEnv):
    """An imagined world as an environment; spaces and settings are the house's.

    Image size and actions are those of the model; the camera is that of the first frames.
    """

    def __init__(
        self,
        model: Config | World,
        params: Params,
        house: HouseConfig | None = None,
        *,
        cost: Callable[[np.ndarray], float] | None = None,
        cost_at_most: float = 0.0,
        blocks: bool = False,
        render_mode: str | None = None,
    ):
        """Wrap a trained world, as returned by ``pewm_jax.load``.

        Args:
            model: the experiment; or the model's settings.
            params: its parameters.
            house: start and goal of episodes. Image size, step and turn are replaced by the
                model's. The house is opened at the first ``reset`` that needs it.
            cost: a cost that defines the goal: image (H, W, 3) uint8 → cost. By default the goal is
                a pose.
            cost_at_most: the goal is reached when the cost is at most this.
            blocks: whether obstacles in the depth of the first frames block a move: the agent then
                stays (``practice.FloorMap``).
            render_mode: None or "rgb_array".

        Raises:
            UserError: the render mode is unknown, or the world has no actions.
        """
        self._model, self._params = model, params
        world = worlds.model_of(model)
        if not (isinstance(world, World) and world.capabilities.actions):
            raise UserError(
                f"a {type(world).__name__} has no actions, so it cannot be an environment: use a "
                "world with actions, such as pewm_jax.load('small')."
            )
        clip, actions = world.clip, world.actions
        of_model = {"height": clip.height, "width": clip.width}
        of_model |= {"step_m": actions.step_m, "turn_deg": actions.turn_deg}
        config = dataclasses.replace(house or HouseConfig(), **of_model)
        super().__init__(config, render_mode, "the world")
        self._cost, self._cost_at_most, self._blocks = cost, cost_at_most, blocks
        self.floor: FloorMap | None = None
        self._house: HouseEnv | None = None
        self._house_seed: int | None = None
        self.state: imagined.ImaginedState | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode from real frames.

        ``options`` are ``frames``, S ≥ 1 posed frames (an episode's, or ``frames_of`` of a house's
        observations), and ``goal``, the frame at the goal. Without options an episode of the house
        starts, in which the agent first makes a full turn. The seed determines the house's episode
        and the sampling noise.

        Raises:
            UserError: the frames do not fit the model or are invalid, or there is no goal.
        """
        super().reset(seed=seed)
        self._house_seed = self._house_seed if seed is None else seed
        frames, self._goal = self._begin(options or {})
        self.intrinsics_4 = np.asarray(frames.camera.intrinsics_4[-1], np.float32)
        self._key = jax.random.key(int(self.np_random.integers(2**31)))
        self.floor = FloorMap() if self._blocks else None
        if self.floor is not None:
            self.floor.add(frames)
        state = imagined.reset(self._model, self._params, frames, self._key)
        self._begin_episode()
        self._look(imagined.observation(state))
        self.state = state
        self._left = self._measure()
        return self._observation(), self._info()

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Imagine the frame after an action; see the module for reward, termination and ``info``.

        Raises:
            UserError: the action is not in the space, or there is no episode.
        """
        move, key = self.motion(action)
        assert self.state is not None
        self.state, seen = imagined.step(self._model, self._params, self.state, move, key)
        return self.arrive(seen)

    def motion(self, action: Any) -> tuple[np.ndarray, jax.Array]:
        """Return the (3,) motion of an action, zero if it is blocked, and the key of its noise.

        Raises:
            UserError: as for ``step``.
        """
        self._require_episode()
        move = observations.require_action(self.config, action).astype(np.float32)
        here = observations.planar_of(self._seen["pose"])
        if self.floor is not None and not self.floor.free(here[:2], advance(here, move)[:2]):
            move = np.zeros_like(move)
        return move, jax.random.fold_in(self._key, self._steps)

    def arrive(
        self, seen: dict[str, Any]
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Return the results of a step that leads to an observation, which somebody imagined."""
        before = self._seen["pose"]
        self._look(seen)
        self._steps += 1
        self._walked += scores.position_error(before, self._seen["pose"])
        left, self._left = self._left, self._measure()
        return self._outcome(left - self._left)

    def _begin(self, options: dict[str, Any]) -> tuple[Frames, Frames]:
        """Return the first frames, and the frame at the goal."""
        unknown = options.keys() - {"frames", "goal"}
        if unknown or (options and len(options) < 2):
            raise UserError(
                f"the world's reset() got the options {', '.join(sorted(options))}: pass frames "
                "(posed RGB-D frames) and goal (the frame at the goal), or no options to start "
                "in the house."
            )
        if options:
            return options["frames"], options["goal"]
        if self._house is None:
            self._house = HouseEnv(self.config)
        self._house.reset(seed=self._house_seed)
        self._house_seed = None
        return self._house.look_around(), self._house.goal_frame()

    def _look(self, seen: dict[str, Any]) -> None:
        """Store an observation, clipped to the space."""
        found = {name: np.array(value) for name, value in seen.items()}
        found["depth"] = np.clip(np.nan_to_num(found["depth"], posinf=0.0), 0, DEPTH_LIMIT_M)
        self._seen = found

    @property
    def _goal_pose(self) -> np.ndarray:
        return np.array(self._goal.camera.world_from_camera[-1], np.float32)

    def _measure(self) -> float:
        """Return the quantity to minimize: the cost, or the distance to the goal."""
        if self._cost is not None:
            return float(self._cost(self._seen["rgb"]))
        return scores.position_error(self._seen["pose"], self._goal_pose)

    def _goal_seen(self) -> np.ndarray:
        if self.config.task == "image":
            image = self._goal.rgb_THWC[-1]
            whole = np.issubdtype(image.dtype, np.integer)
            return np.array(image if whole else rgb_from_signal(image))
        planar = observations.planar_of(self._seen["pose"])
        return observations.goal_in_frame(planar, self._goal_pose[:2, 3])

    def _info(self) -> dict[str, Any]:
        pose, goal = self._seen["pose"], self._goal_pose
        success = scores.success(pose, goal, self.config.success_m, self.config.success_deg)
        info: dict[str, Any] = {
            "position_error": scores.position_error(pose, goal),
            "yaw_error": scores.yaw_error(pose, goal),
            "success": success,
            "steps": self._steps,
            "path_length": self._walked,
            "goal_pose": goal,
        }
        if self._cost is not None:
            info |= {"cost": self._left, "success": self._left <= self._cost_at_most}
        return info
