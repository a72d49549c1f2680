"""Practice: a policy acts inside a world, and the imagined walks become training data.

A few posed images of a place start a world. From one of them the policy chooses actions, the world
imagines and stores the resulting frames, and so on (paper, Section 3.3). Every later image of such
a walk is a goal that the walk reached (hindsight relabelling): NoMaD's loss can be trained on any
walk in this way.

A world has no collision detection, but the given images have depth: if an observed obstacle blocks
a forward step, the rest of the block becomes a turn in place (``FloorMap``). So obstacles do not
depend on what the world imagines.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, Protocol, TypeAlias

import jax
import numpy as np

from pewm_jax import worlds
from pewm_jax.codecs.signals import rgb_from_signal
from pewm_jax.config import ActionConfig, Config, UserError
from pewm_jax.data.simulator import Simulator, move
from pewm_jax.data.trajectories import advance
from pewm_jax.errors import require
from pewm_jax.geometry.actions import (
    FORWARD,
    NAMES,
    TURN_LEFT,
    TURN_RIGHT,
    discrete_table,
    heading,
)
from pewm_jax.models.nomad.config import NomadConfig
from pewm_jax.planning import nomad_policy
from pewm_jax.types import Frames, Params

CELL_M = 0.05
RADIUS_M = 0.27
"""Distance from the line of motion within which points block it, metres."""
ABOVE_FLOOR_M, ABOVE_CAMERA_M = 0.2, 0.1
"""Points lower than the first, or higher above the camera than the second, are not obstacles."""
LEAST_POINTS = 3
"""Number of points that make a cell occupied: single ones are errors of measured or imagined
depth."""
FLOOR_PERCENTILE = 1.0
"""Percentile of the points' heights used as the floor."""
WAY_SAMPLES = 6
"""Number of positions along a move that are checked."""
FARTHEST_M = 6.0
"""Points farther from the camera are ignored, because their position is uncertain, metres."""
Act: TypeAlias = Callable[[np.ndarray, np.ndarray | None, jax.Array], np.ndarray]
"""``act(rgb_SHWC, goal_HWC, key) -> (N,)`` discrete actions, from observed images (the present
last) and a goal image or None."""


class FloorMap:
    """Occupied cells of the floor, from the posed depth of all frames that were added.

    A camera does not see obstacles beside the agent's feet, so one image is not enough: all earlier
    frames are used. Everything between the floor and slightly above the camera is an obstacle. The
    floor is the lowest level with many points.
    """

    def __init__(self) -> None:
        self._points = np.zeros((0, 3))
        self._cameras = np.zeros(0)
        self._cells: np.ndarray | None = None

    def add(self, frames: Frames) -> None:
        """Add (T,) posed depth; 0 is no measurement."""
        depth_THW = np.asarray(frames.depth_THW, np.float64)
        poses = np.asarray(frames.camera.world_from_camera, np.float64)
        fx, fy, cx, cy = np.moveaxis(
            np.asarray(frames.camera.intrinsics_4, np.float64)[:, None, None], -1, 0
        )
        rows, columns = np.indices(depth_THW.shape[1:]) + 0.5
        right, down = (columns - cx) / fx * depth_THW, (rows - cy) / fy * depth_THW
        seen = np.stack([right, down, depth_THW], -1)
        world = np.einsum("tij,thwj->thwi", poses[:, :3, :3], seen) + poses[:, None, None, :3, 3]
        measured = (depth_THW > 0) & (depth_THW <= FARTHEST_M)
        self._points = np.concatenate([self._points, world[measured]])
        self._cameras = np.concatenate([self._cameras, poses[:, 2, 3]])
        self._cells = None

    def free(self, start_xy: np.ndarray, end_xy: np.ndarray) -> bool:
        """Return whether the straight line between two points has no obstacle."""
        start, end = np.asarray(start_xy), np.asarray(end_xy)
        places = [start + share * (end - start) for share in np.linspace(0, 1, WAY_SAMPLES)[1:]]
        away = self._occupied()[:, None] - np.stack(places)
        return not (np.hypot(away[..., 0], away[..., 1]) < RADIUS_M).any()

    def _occupied(self) -> np.ndarray:
        """Return the centres (n, 2) of cells with obstacles, computed on first use."""
        if self._cells is None:
            points = self._points
            if not len(points):
                return np.zeros((0, 2))
            height = points[:, 2]
            floor = np.percentile(height, FLOOR_PERCENTILE)
            body = (height > floor + ABOVE_FLOOR_M) & (
                height < self._cameras.mean() + ABOVE_CAMERA_M
            )
            cells, counts = np.unique(
                np.floor(points[body, :2] / CELL_M).astype(int), axis=0, return_counts=True
            )
            self._cells = (cells[counts >= LEAST_POINTS] + 0.5) * CELL_M
        return self._cells


@dataclasses.dataclass(frozen=True)
class Practice:
    """Settings of practice.

    Attributes:
        walks: number of walks.
        blocks: number of consecutive proposals executed in a walk.
        with_goal: share of walks with a goal image, one of those that the world was started with;
            in the others the policy explores.
    """

    walks: int = 32
    blocks: int = 4
    with_goal: float = 0.5

    def __post_init__(self):
        """Validate."""
        for name in ("walks", "blocks"):
            value = getattr(self, name)
            require(value >= 1, f"practice.{name} is {value}: use 1 or more.")
        require(
            0 <= self.with_goal <= 1,
            f"practice.with_goal is {self.with_goal}: use a share in [0, 1].",
        )


@dataclasses.dataclass(frozen=True, eq=False)
class PracticeWalk:
    """A walk: frames and actions.

    Attributes:
        frames: (T,) NumPy frames, colours uint8.
        actions_N: the T − 1 discrete actions.
    """

    frames: Frames
    actions_N: np.ndarray


class PracticeEnvironment(Protocol):
    """An environment for practice: a world, or a simulator."""

    def begin(self, number: int) -> tuple[Any, Frames]:
        """Return the state at the pose of a given image, and that image."""
        ...

    def possible(self, state: Any, actions_N: np.ndarray) -> int:
        """Return the number of actions before the first collision; N if there is none."""
        ...

    def go(self, state: Any, actions_N: np.ndarray, key: jax.Array) -> tuple[Any, Frames]:
        """Return the state after N actions, and the frames."""
        ...


def walks(
    place: PracticeEnvironment, seen: Frames, act: Act, practice: Practice, seed: int
) -> Iterator[PracticeWalk]:
    """Yield walks of a policy.

    Args:
        place: the environment.
        seen: the images with which the place was started; walks start at one of them.
        act: the policy.
        practice: number and length of walks.
        seed: seed of starts, goals and actions; equal seeds give equal starts in every environment.

    Yields:
        Walks with the same number of frames if the policy always proposes the same number of
        actions.

    Raises:
        UserError: the policy does not return discrete actions.
    """
    for number in range(practice.walks):
        rng, key = np.random.default_rng((seed, number)), jax.random.key(seed)
        key = jax.random.fold_in(key, number)
        state, first = place.begin(int(rng.integers(len(seen.depth_THW))))
        picture = int(rng.integers(len(seen.depth_THW)))
        goal = seen.rgb_THWC[picture] if rng.random() < practice.with_goal else None
        frames, done = [first], []
        for _ in range(practice.blocks):
            key, one, two = jax.random.split(key, 3)
            pictures = np.concatenate([each.rgb_THWC for each in frames])
            actions = require_discrete(act(pictures, goal, one), "the policy")
            turn = int(rng.choice([TURN_LEFT, TURN_RIGHT]))
            actions[place.possible(state, actions) :] = turn
            state, after = place.go(state, actions, two)
            frames.append(after)
            done.append(actions)
        together = jax.tree.map(lambda *x: np.concatenate(x), *frames)
        yield PracticeWalk(together, np.concatenate(done))


class ImaginedEnvironment:
    """A world as an environment for practice, started from posed RGB-D frames.

    If ``memory`` is False, the world's memory is not used.
    """

    def __init__(self, config: Config, params: Params, seen: Frames, *, memory: bool = True):
        self.config, self.params, self.seen, self.memory = config, params, seen, memory
        self.table_A3 = discrete_table(config.model.actions).astype(np.float64)
        self.floor = FloorMap()
        self.floor.add(seen)

    def begin(self, number: int) -> tuple[Any, Frames]:
        """Start from all images; the given one is the present."""
        count = len(self.seen.depth_THW)
        order = np.array([*(n for n in range(count) if n != number), number])
        seen = jax.tree.map(lambda x: np.asarray(x)[order], self.seen)
        state = worlds.start(self.config.model, self.params, seen)
        return state, jax.tree.map(lambda x: x[-1:], seen)

    def possible(self, state: Any, actions_N: np.ndarray) -> int:
        """Check moves against the obstacles in the given images."""
        pose = planar(np.asarray(state.frame.camera.world_from_camera)[0])
        for number, action in enumerate(actions_N):
            after = advance(pose, self.table_A3[int(action)])
            if action == FORWARD and not self.floor.free(pose[:2], after[:2]):
                return number
            pose = after
        return len(actions_N)

    def go(self, state: Any, actions_N: np.ndarray, key: jax.Array) -> tuple[Any, Frames]:
        """Imagine the frames and insert them into the memory."""
        state, frames = worlds.imagine(
            self.config.model, self.params, state, actions_N, key, memory=self.memory
        )
        camera = jax.tree.map(np.asarray, frames.camera)
        rgb = np.asarray(rgb_from_signal(frames.rgb_THWC))
        return state, Frames(rgb, np.asarray(frames.depth_THW), camera)


class SimulatedEnvironment:
    """A simulator as an environment for practice: equally many real walks.

    Walks start from the poses of the frames ``seen``; ``motion`` is that of an action.
    """

    def __init__(self, simulator: Simulator, motion: ActionConfig, seen: Frames):
        self.simulator, self.seen = simulator, seen
        self.table_A3 = discrete_table(motion).astype(np.float64)

    def begin(self, number: int) -> tuple[Any, Frames]:
        """Start at the pose of a given image."""
        here = jax.tree.map(lambda x: np.asarray(x)[number : number + 1], self.seen)
        return planar(here.camera.world_from_camera[0]), here

    def possible(self, state: Any, actions_N: np.ndarray) -> int:
        """Simulate moves until a collision."""
        for number, action in enumerate(actions_N):
            state, collided = move(self.simulator.grid, state, self.table_A3[int(action)])
            if collided:
                return number
        return len(actions_N)

    def go(self, state: Any, actions_N: np.ndarray, key: jax.Array) -> tuple[Any, Frames]:
        """Simulate the moves, with collisions."""
        del key
        poses = [state]
        for action in actions_N:
            poses.append(move(self.simulator.grid, poses[-1], self.table_A3[int(action)])[0])
        return poses[-1], self.simulator.frames(np.stack(poses[1:]))


def planar(world_from_camera: np.ndarray) -> np.ndarray:
    """Return x, y, yaw of a camera (4, 4)."""
    return np.array([*world_from_camera[:2, 3], float(heading(world_from_camera))])


def require_discrete(actions_N: Any, who: str) -> np.ndarray:
    """Return a copy of (N,) discrete actions, or raise UserError if they are none."""
    actions = np.array(actions_N)
    known = actions.dtype.kind in "iu" and actions.ndim == 1 and actions.size > 0
    if not known or not ((actions >= 0) & (actions < len(NAMES))).all():
        raise UserError(
            f"{who} gave {actions.dtype} of shape {actions.shape}: give integers from 0 to "
            f"{len(NAMES) - 1}, one per action."
        )
    return actions


def nomad(config: NomadConfig, params: Params, motion: ActionConfig) -> Act:
    """Return NoMaD as an ``Act``: one proposal, converted to discrete actions."""

    def act(rgb_SHWC: np.ndarray, goal_HWC: np.ndarray | None, key: jax.Array) -> np.ndarray:
        seen = nomad_policy.history(config, rgb_SHWC)
        way = nomad_policy.propose(config, params, seen, goal_HWC, key, 1)
        return nomad_policy.discrete(motion, np.asarray(way))[0]

    return act
