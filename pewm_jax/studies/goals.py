"""The tasks of Table 2: a place in a held-out house, seen before, and the picture of a goal.

The goal is where a walk of as many actions as a plan has ends, so it can be reached exactly. Before
the task the agent has looked around where it stands, and around the middle of that walk: the goal's
surroundings were seen, the goal's own view was not. Everything follows from the task's number.
"""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from pewm_jax.config import ActionConfig, UserError
from pewm_jax.data.make_episode import SPLITS
from pewm_jax.data.navigation import PathsToGoal, line_is_free, sample_free
from pewm_jax.data.simulator import Simulator, move, open_simulator
from pewm_jax.geometry.actions import FORWARD, TURN_LEFT, TURN_RIGHT, discrete_table
from pewm_jax.types import Frames

TRIES = 2000
LEAST_M = 0.5
"""A walk that ends nearer to its start is no task."""
NEAR_M, NEAR_LEAST_M = 1.5, 1.0
"""Tasks near a place start no farther from it, and end at least so far from their start."""
TEST = 2
"""The first house of the split that nobody is trained on; every third one is of it."""


@dataclasses.dataclass(frozen=True, eq=False)
class TaskInput:
    """What a policy knows of a task.

    Attributes:
        number: of the task, to draw from.
        actions: N, how many actions to propose.
        context: what was seen before; the last frame is the present one.
        frame: what is seen at the goal, T = 1.
    """

    number: int
    actions: int
    context: Frames
    frame: Frames


@dataclasses.dataclass(frozen=True, eq=False)
class Goal:
    """A task.

    Attributes:
        number: of the task.
        simulator: the house.
        table_A3: what each discrete action does.
        expert_N: the actions of the walk that the goal is the end of.
        walk_T3: its poses, x, y, yaw, from the start on; T = N + 1.
        context: what was seen before; the last frame is the present one.
        frame: what is seen at the goal, T = 1.
        shortest_m: the length of the shortest way.
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
        """The house's name."""
        return self.simulator.scene.name

    @property
    def input(self) -> TaskInput:
        """What a policy knows of it."""
        return TaskInput(self.number, len(self.expert_N), self.context, self.frame)

    def walked(self, actions_N: np.ndarray, start_3: np.ndarray | None = None) -> np.ndarray:
        """Return the poses (N + 1, 3) that actions lead through, from the start; walls hold."""
        start = self.walk_T3[0] if start_3 is None else start_3
        return walked(self.simulator, self.table_A3, start, actions_N)

    def seen(self, actions_KN: np.ndarray, start_3: np.ndarray | None = None) -> Frames:
        """Return what is truly seen after each candidate's last action, (K, 1) frames."""
        ends = np.stack([self.walked(actions, start_3)[-1] for actions in np.asarray(actions_KN)])
        return jax.tree.map(lambda x: x[:, None], self.simulator.frames(ends))


def open_goal(
    number: int, *, houses: int, actions: int, context: int, motion: ActionConfig, size: int
) -> Goal:
    """Make a task.

    Args:
        number: of the task; tasks take houses in turn.
        houses: how many held-out houses there are.
        actions: N, of the walk.
        context: frames seen before, at least 2.
        motion: what an action does.
        size: side of the square pictures, pixels.

    Raises:
        UserError: the house has no such walk.
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
        f"{simulator.scene.name} has no room for a walk of {actions} actions that ends {LEAST_M:g} "
        "m away: take fewer houses."
    )


def near(home: Goal, count: int, actions: int) -> list[Goal]:
    """Make tasks near the places that were seen before a task.

    They start at most ``NEAR_M`` from where it starts or from the middle of its walk, in sight of
    that place, and end at most twice as far from there and at least ``NEAR_LEAST_M`` from their
    start. The last frame of each one's context is what is seen at its own start.

    Args:
        home: the task.
        count: how many.
        actions: of the walk to each goal.

    Raises:
        UserError: the house has no room for them.
    """
    simulator, made = home.simulator, list[Goal]()
    places = home.walk_T3[[0, len(home.expert_N) // 2], :2]
    rng = np.random.default_rng((home.number, count, actions))
    for start in sample_free(simulator.grid, rng, TRIES):
        if len(made) == count:
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
        number = home.number * count + len(made)
        made.append(Goal(number, simulator, home.table_A3, expert, walk, present, goal, shortest))
    if len(made) < count:
        raise UserError(
            f"{home.house} has room for {len(made)} of {count} walks near where it was seen: take "
            "fewer tasks."
        )
    return made


def _one(frames: Frames, number: int) -> Frames:
    return jax.tree.map(lambda x: x[number : number + 1], frames)


def _blocked(walk_T3: np.ndarray, actions_N: np.ndarray) -> bool:
    """Tell whether a step forward led nowhere."""
    moves = np.linalg.norm(np.diff(walk_T3[:, :2], axis=0), axis=-1)
    return bool(((moves < 1e-6) & (actions_N == FORWARD)).any())


def wander(rng: np.random.Generator, actions: int) -> np.ndarray:
    """Return a walk that knows nothing: it turns to one side for a while, then goes on."""
    done: list[int] = []
    while len(done) < actions:
        done += [int(rng.choice([TURN_LEFT, TURN_RIGHT]))] * int(rng.integers(0, 4))
        done += [FORWARD] * int(rng.integers(1, 6))
    return np.array(done[:actions])


def walked(
    simulator: Simulator, table_A3: np.ndarray, start_3: np.ndarray, actions_N: np.ndarray
) -> np.ndarray:
    """Return the poses (N + 1, 3) of an agent that carries out discrete actions."""
    poses = [np.asarray(start_3, np.float64)]
    for action in np.asarray(actions_N):
        poses.append(move(simulator.grid, poses[-1], table_A3[int(action)])[0])
    return np.stack(poses)


def _around(planar_3: np.ndarray, views: int) -> np.ndarray:
    """Return a turn around a place in so many views, the last one straight ahead."""
    poses = np.tile(planar_3, (views, 1))
    poses[:, 2] += 2 * np.pi * np.arange(1, views + 1) / views
    return poses
