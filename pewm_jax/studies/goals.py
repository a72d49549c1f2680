"""The tasks of Table 2: a start in a held-out house, earlier observations, and a goal image.

The goal is the end of a walk with as many actions as a plan, so it can be reached exactly. Before
the task the agent has made a full turn at the start and another around the middle of that walk: the
goal's surroundings were observed, the goal's own view was not. Everything is a function of the
task's number.
"""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from pewm_jax.config import ActionConfig, Config, UserError
from pewm_jax.data.make_episode import SPLITS
from pewm_jax.data.navigation import PathsToGoal, line_is_free, sample_free
from pewm_jax.data.simulator import Simulator, move, open_simulator
from pewm_jax.geometry.actions import FORWARD, TURN_LEFT, TURN_RIGHT, discrete_table
from pewm_jax.types import Frames

TRIES = 2000
LEAST_M = 0.5
"""Smallest distance from start to goal."""
NEAR_M, NEAR_LEAST_M = 1.5, 1.0
"""Largest distance of a nearby task's start from the place, and smallest distance from its start to
its goal."""
TEST = 2
"""The first house of the test split; every third house belongs to it."""


@dataclasses.dataclass(frozen=True, eq=False)
class TaskInput:
    """The inputs of a policy.

    The last frame of ``context``, the earlier observations, is the present one; ``frame`` is that
    at the goal, T = 1; ``number`` is used as a seed.
    """

    number: int
    actions: int
    context: Frames
    frame: Frames


@dataclasses.dataclass(frozen=True, eq=False)
class Goal:
    """A task.

    Attributes:
        simulator: the house.
        table_A3: the motion of each discrete action.
        expert_N: the actions of the walk that ends at the goal.
        walk_T3: its poses, x, y, yaw, including the start; T = N + 1.
        context: earlier observations; the last frame is the present one.
        frame: the frame at the goal, T = 1.
        shortest_m: length of the shortest path.
    """

    number: int
    simulator: Simulator
    table_A3: np.ndarray
    expert_N: np.ndarray
    walk_T3: np.ndarray
    context: Frames
    frame: Frames
    shortest_m: float

    @property
    def house(self) -> str:
        """Return the house's name."""
        return self.simulator.scene.name

    @property
    def input(self) -> TaskInput:
        """Return the inputs of a policy."""
        return TaskInput(self.number, len(self.expert_N), self.context, self.frame)

    def walked(self, actions_N: np.ndarray, start_3: np.ndarray | None = None) -> np.ndarray:
        """Return the poses (N + 1, 3) along actions from the start, with collisions."""
        start = self.walk_T3[0] if start_3 is None else start_3
        return walked(self.simulator, self.table_A3, start, actions_N)

    def seen(self, actions_KN: np.ndarray, start_3: np.ndarray | None = None) -> Frames:
        """Return the real frame after each candidate's last action, (K, 1) frames."""
        ends = np.stack([self.walked(actions, start_3)[-1] for actions in np.asarray(actions_KN)])
        return jax.tree.map(lambda x: x[:, None], self.simulator.frames(ends))


def open_goal(
    number: int, *, houses: int, actions: int, context: int, motion: ActionConfig, size: int
) -> Goal:
    """Return a task; tasks use the ``houses`` held-out houses in turn.

    There are at least 2 earlier frames, ``context``; images are squares of ``size`` pixels.

    Raises:
        UserError: the house is too small for such a walk.
    """
    house = TEST + len(SPLITS) * (number % houses)
    simulator = open_simulator(house_seed=house, height=size, width=size)
    rng = np.random.default_rng((house, number))
    table = discrete_table(motion).astype(np.float64)
    for start in sample_free(simulator.grid, rng, TRIES):
        planar = np.array([*start, rng.uniform(-np.pi, np.pi)])
        expert = wander(rng, actions)
        walk = walked(simulator, table, planar, expert)
        if _blocked(walk, expert) or np.linalg.norm(walk[-1, :2] - walk[0, :2]) < LEAST_M:
            continue
        around = _around(walk[actions // 2], context // 2)
        context_frames = simulator.frames(
            np.concatenate([around, _around(walk[0], context - context // 2)])
        )
        shortest = PathsToGoal(simulator.grid, walk[-1, :2]).length(walk[0, :2])
        goal = simulator.frames(walk[-1:])
        return Goal(number, simulator, table, expert, walk, context_frames, goal, shortest)
    raise UserError(
        f"{simulator.scene.name} is too small for a walk of {actions} actions that ends "
        f"{LEAST_M:g} m away: use fewer houses."
    )


def goal_of(config: Config, number: int, houses: int, actions: int) -> Goal:
    """Return a task with the context, the actions and the images of a model; see ``open_goal``."""
    return open_goal(
        number,
        houses=houses,
        actions=actions,
        context=config.data.context,
        motion=config.model.actions,
        size=config.model.clip.height,
    )


def near(home: Goal, count: int, actions: int) -> list[Goal]:
    """Return tasks near the places observed before a task, each a walk of ``actions`` actions.

    They start at most ``NEAR_M`` from its start or from the middle of its walk, visible from that
    place, and end at most twice as far from there and at least ``NEAR_LEAST_M`` from their own
    start. The last frame of each one's context is the view at its own start.

    Raises:
        UserError: the house is too small for them.
    """
    simulator, tasks = home.simulator, list[Goal]()
    places = home.walk_T3[[0, len(home.expert_N) // 2], :2]
    rng = np.random.default_rng((home.number, count, actions))
    for start in sample_free(simulator.grid, rng, TRIES):
        if len(tasks) == count:
            break
        planar = np.array([*start, rng.uniform(-np.pi, np.pi)])
        expert = wander(rng, actions)
        walk = walked(simulator, home.table_A3, planar, expert)
        far = np.linalg.norm(walk[-1, :2] - walk[0, :2])
        beside = any(
            np.linalg.norm(place - walk[0, :2]) <= NEAR_M
            and np.linalg.norm(place - walk[-1, :2]) <= 2 * NEAR_M
            and line_is_free(simulator.grid, place, walk[0, :2])
            for place in places
        )
        if not beside or far < NEAR_LEAST_M or _blocked(walk, expert):
            continue
        seen = simulator.frames(np.stack([walk[0], walk[-1]]))
        present = jax.tree.map(lambda *x: np.concatenate(x), home.context, _one(seen, 0))
        shortest = PathsToGoal(simulator.grid, walk[-1, :2]).length(walk[0, :2])
        goal = _one(seen, 1)
        number = home.number * count + len(tasks)
        tasks.append(Goal(number, simulator, home.table_A3, expert, walk, present, goal, shortest))
    if len(tasks) < count:
        raise UserError(
            f"{home.house} has room for only {len(tasks)} of {count} walks near the observed "
            "places: use fewer tasks."
        )
    return tasks


def _one(frames: Frames, number: int) -> Frames:
    return jax.tree.map(lambda x: x[number : number + 1], frames)


def _blocked(walk_T3: np.ndarray, actions_N: np.ndarray) -> bool:
    """Return whether a forward step was blocked."""
    moves = np.linalg.norm(np.diff(walk_T3[:, :2], axis=0), axis=-1)
    return bool(((moves < 1e-6) & (actions_N == FORWARD)).any())


def wander(rng: np.random.Generator, actions: int) -> np.ndarray:
    """Return a random walk: it turns to one side for a while, then goes forward."""
    done: list[int] = []
    while len(done) < actions:
        done += [int(rng.choice([TURN_LEFT, TURN_RIGHT]))] * int(rng.integers(0, 4))
        done += [FORWARD] * int(rng.integers(1, 6))
    return np.array(done[:actions])


def walked(
    simulator: Simulator, table_A3: np.ndarray, start_3: np.ndarray, actions_N: np.ndarray
) -> np.ndarray:
    """Return the poses (N + 1, 3) of an agent that executes discrete actions."""
    poses = [np.asarray(start_3, np.float64)]
    for action in np.asarray(actions_N):
        poses.append(move(simulator.grid, poses[-1], table_A3[int(action)])[0])
    return np.stack(poses)


def _around(planar_3: np.ndarray, views: int) -> np.ndarray:
    """Return the poses of a full turn in ``views`` steps, the last one straight ahead."""
    poses = np.tile(planar_3, (views, 1))
    poses[:, 2] += 2 * np.pi * np.arange(1, views + 1) / views
    return poses
