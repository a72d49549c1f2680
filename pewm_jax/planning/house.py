"""``pewm_jax/House-v0``: an agent with an RGB-D camera in a house that has to reach a goal.

The reward of a step is the decrease of the geodesic distance to the goal in metres (negative if it
increases), plus ``success_reward`` if the step reaches the goal. The return of a successful episode
is the geodesic distance at the start, minus the remaining distance, plus ``success_reward``.

An episode ends when the goal is reached (``terminated``): closer than ``success_m`` in geodesic
distance and ``success_deg`` in heading. It is truncated after ``max_steps`` (``truncated``).

``info`` contains

    geodesic_distance  geodesic distance to the goal, metres
    position_error     Euclidean distance to the goal, metres
    yaw_error          radians between the heading and the goal's, from 0 to π
    success            whether the goal is reached
    collision          whether the last move was blocked; the agent never leaves the free area
    steps              number of steps
    path_length        length of the path, metres
    shortest_path      geodesic distance from start to goal, metres
    spl                success weighted by path length (Anderson et al., arXiv:1807.06757)
    goal_pose          (4, 4) the camera at the goal
    scene              name of the scene
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.data.make_episode import SPLITS
from pewm_jax.data.navigation import NavGrid, PathsToGoal, sample_free
from pewm_jax.data.simulator import Simulator, move, open_simulator
from pewm_jax.planning import observations, scores
from pewm_jax.planning.house_config import HouseConfig, settings
from pewm_jax.planning.observations import GoalEnv
from pewm_jax.types import Frames

GOALS_TRIED = 20
STARTS_TRIED = 10


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """An episode's task.

    Attributes:
        start_3: (3,) x, y, yaw of the first frame.
        goal_3: (3,) x, y, yaw of the goal; its heading is that of an agent arriving by the
            shortest path.
        ways: the shortest paths to the goal.
        shortest_m: length of the shortest path from the start.
    """

    start_3: np.ndarray
    goal_3: np.ndarray
    ways: PathsToGoal
    shortest_m: float


def draw_task(config: HouseConfig, grid: NavGrid, rng: np.random.Generator, where: str) -> Task:
    """Sample a start and a goal whose geodesic distance is within the configured bounds.

    The goal is uniform over the free area, the start is uniform over the part of it within bounds,
    and the start's heading is uniform.

    Raises:
        UserError: no such pair exists; the message names the scene, ``where``.
    """
    low, high = config.min_distance_m, config.max_distance_m
    farthest = 0.0
    for goal in sample_free(grid, rng, GOALS_TRIED):
        ways = PathsToGoal(grid, goal)
        distance = np.where(np.isfinite(ways.distance_YX), ways.distance_YX, -1.0)
        farthest = max(farthest, float(distance.max()))
        # Grid distances are up to 8 % longer than the smoothed path.
        cells = np.argwhere((distance >= low) & (distance <= 1.1 * high + grid.cell_m))
        for _ in range(STARTS_TRIED if len(cells) else 0):
            start = grid.centre_of(cells[rng.integers(len(cells))])
            start = start + rng.uniform(-0.499, 0.499, 2) * grid.cell_m
            path = ways.path(start)
            length = ways.length(start)
            if path is not None and low <= length <= high:
                last = path[-1] - path[-2]
                heading = math.atan2(last[1], last[0])
                yaw = rng.uniform(-math.pi, math.pi)
                return Task(np.array([*start, yaw]), np.array([*goal, heading]), ways, length)
    raise UserError(
        f"{where} has no two places with a geodesic distance from {low:g} to {high:g} m (the "
        f"farthest found are {farthest:.1f} m apart): change min_distance_m and max_distance_m, or "
        "use a larger scene."
    )


class HouseEnv(GoalEnv):
    """A house environment, created by ``gymnasium.make("pewm_jax/House-v0", **settings)``.

    The same seed gives bit-identical episodes. Spaces: see ``planning.observations``.
    """

    def __init__(
        self, config: HouseConfig | None = None, render_mode: str | None = None, **overrides: Any
    ):
        """Open the house with these settings, which may be passed as keyword arguments instead.

        Raises:
            UserError: invalid settings, a mesh that does not load or has no free floor, or no
                renderer.
        """
        if config is not None and overrides:
            raise UserError("House got a HouseConfig and other settings; pass only one of the two.")
        super().__init__(settings(overrides) if config is None else config, render_mode, "House")
        self._simulator = self._open(self.config.house)
        self.intrinsics_4 = self._simulator.intrinsics_4.copy()
        self._task: Task | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode; there are no options.

        Raises:
            UserError: the scene is too small for the task, or there are options.
        """
        super().reset(seed=seed)
        if options:
            raise UserError(f"House.reset() takes no options, got {', '.join(options)}.")
        config = self.config
        if not config.scene and config.houses > 1:
            number = int(self.np_random.integers(config.houses))
            self._simulator = self._open(config.house + len(SPLITS) * number)
        simulator = self._simulator
        self._task = draw_task(config, simulator.grid, self.np_random, simulator.scene.name)
        self._planar = self._task.start_3
        self._goal = simulator.frames(self._task.goal_3[None])
        self._collided = False
        self._begin_episode()
        self._left = self._task.shortest_m
        self._look()
        return self._observation(), self._info()

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Apply an action; see the module docstring for reward, termination and ``info``.

        Raises:
            UserError: the action is not in the space, or there is no episode.
        """
        self._require_episode()
        moved = observations.require_action(self.config, action)
        before = self._planar
        self._planar, self._collided = move(
            self._simulator.grid, before, moved, sliding=self.config.sliding
        )
        self._steps += 1
        self._walked += float(np.linalg.norm(self._planar[:2] - before[:2]))
        before_m, self._left = self._left, self.task.ways.length(self._planar[:2])
        self._look()
        return self._outcome(before_m - self._left)

    def look_around(self) -> Frames:
        """Return the frames of one full turn in place; the state does not change.

        The last frame is the present one, so a world can be started from these frames.
        """
        turns = max(1, round(360 / self.config.turn_deg))
        planar = np.tile(self.planar, (turns, 1))
        planar[:-1, 2] += 2 * np.pi * np.arange(1, turns) / turns
        return self._simulator.frames(planar)

    def goal_frame(self) -> Frames:
        """Return the frame at the goal; there is none before the first ``reset``."""
        _ = self.task
        return self._goal

    @property
    def grid(self) -> NavGrid:
        """Return the navigation grid; the cell of the agent's centre is always free."""
        return self._simulator.grid

    @property
    def task(self) -> Task:
        """Return the episode's task, or raise UserError before the first ``reset``."""
        if self._task is None:
            raise UserError("the house has no episode yet: call reset() first.")
        return self._task

    @property
    def planar(self) -> np.ndarray:
        """Return a copy of the agent's pose: x, y, yaw in (−π, π], float64."""
        _ = self.task
        return self._planar.copy()

    def _open(self, house: int) -> Simulator:
        config = self.config
        return open_simulator(
            house_seed=house,
            scene=Path(config.scene) if config.scene else None,
            up=config.up,
            height=config.height,
            width=config.width,
            hfov=config.hfov,
            camera_height=config.camera_height,
        )

    def _look(self) -> None:
        seen = self._simulator.frames(self._planar[None])
        pose = seen.camera.world_from_camera
        self._seen = {"rgb": seen.rgb_THWC[0], "depth": seen.depth_THW[0], "pose": pose[0]}

    def _goal_seen(self) -> np.ndarray:
        if self.config.task == "image":
            return self._goal.rgb_THWC[0].copy()
        return observations.goal_in_frame(self._planar, self.task.goal_3[:2])

    def _info(self) -> dict[str, Any]:
        task, config = self.task, self.config
        goal = task.goal_3
        turned = scores.yaw_error(self._planar, goal)
        success = self._left <= config.success_m and np.degrees(turned) <= config.success_deg
        return {
            "geodesic_distance": self._left,
            "position_error": scores.position_error(self._planar, goal),
            "yaw_error": turned,
            "success": bool(success),
            "collision": self._collided,
            "steps": self._steps,
            "path_length": self._walked,
            "shortest_path": task.shortest_m,
            "spl": scores.spl(success, task.shortest_m, self._walked),
            "goal_pose": self._goal.camera.world_from_camera[0].copy(),
            "scene": self._simulator.scene.name,
        }
