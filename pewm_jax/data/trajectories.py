"""Policies that walk over a navigation grid, with discrete or continuous actions.

A trajectory is a list of planar poses (x, y, yaw), one per frame, and the actions between them.
Policies never move through walls: a forward move is made only if the whole segment is free.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import numpy as np
from scipy import ndimage

from pewm_jax.config import ActionConfig, UserError
from pewm_jax.data.navigation import (
    NavGrid,
    distance_field,
    is_free,
    sample_free,
)
from pewm_jax.geometry.actions import FORWARD, TURN_LEFT, TURN_RIGHT
from pewm_jax.geometry.cameras import pose_from_yaw

Policy = Literal["follow", "walk", "revisit"]
TURN_COST_M = 0.02
"""Cost of a turn, metres; without it the agent zigzags."""
CLEARANCE_M = 0.3
"""Distance that the agent prefers to keep from the border of the free area, metres."""
GOALS_TRIED = 24
"""Free cells drawn as candidates for the next goal; one of the farther half is chosen."""


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """Poses of the agent and its actions.

    Attributes:
        planar_T3: float64 x, y, yaw in the world, metres and radians.
        actions: (T − 1, 3) float64 dx, dy, dyaw; or (T − 1, A) states of an articulated agent.
        action_ids: (T − 1,) int32, or None for continuous actions.
        return_frame: the frame at which a revisit trajectory turns back, or None.
    """

    planar_T3: np.ndarray
    actions: np.ndarray
    action_ids: np.ndarray | None
    return_frame: int | None = None

    def world_from_camera(self, camera_z: float) -> np.ndarray:
        """Return (T, 4, 4) float32 level cameras at this height."""
        return np.stack(
            [pose_from_yaw(np.array([x, y, camera_z]), yaw) for x, y, yaw in self.planar_T3]
        )


def advance(pose_3: np.ndarray, action_3: np.ndarray) -> np.ndarray:
    """Return the planar pose after one action: first move, then turn."""
    x, y, yaw = pose_3
    c, s = math.cos(yaw), math.sin(yaw)
    dx, dy, turn = action_3
    return np.array([x + c * dx - s * dy, y + s * dx + c * dy, yaw + turn])


def action_to(pose_3: np.ndarray, after_3: np.ndarray) -> np.ndarray:
    """Return the action that leads from one planar pose to another."""
    c, s = math.cos(pose_3[2]), math.sin(pose_3[2])
    dx, dy = after_3[:2] - pose_3[:2]
    turn = (after_3[2] - pose_3[2] + math.pi) % (2 * math.pi) - math.pi
    return np.array([c * dx + s * dy, -s * dx + c * dy, turn])


class _Agent:
    """An agent in a grid that records its poses and actions up to a number of frames."""

    def __init__(
        self,
        grid: NavGrid,
        actions: ActionConfig,
        frames: int,
        rng: np.random.Generator,
        continuous: bool,
    ):
        self.grid, self.config, self.frames, self.rng = grid, actions, frames, rng
        self.continuous = continuous
        self.turn = math.radians(actions.turn_deg)
        self.table = np.array([[actions.step_m, 0, 0], [0, 0, self.turn], [0, 0, -self.turn]])
        inside = ndimage.distance_transform_edt(np.pad(grid.free_YX, 1))
        self.clearance_YX = np.asarray(inside)[1:-1, 1:-1] * grid.cell_m
        start = sample_free(grid, rng, 1)[0]
        self.poses = [np.array([start[0], start[1], rng.uniform(-math.pi, math.pi)])]
        self.actions: list[np.ndarray] = []
        self.ids: list[int] = []

    @property
    def pose(self) -> np.ndarray:
        return self.poses[-1]

    @property
    def done(self) -> bool:
        return len(self.poses) >= self.frames

    def record(self, action_3: np.ndarray, action_id: int = -1) -> None:
        """Apply an action, unless the trajectory is complete."""
        if not self.done:
            self.poses.append(advance(self.pose, action_3))
            self.actions.append(np.asarray(action_3, np.float64))
            self.ids.append(action_id)

    def act(self, action_id: int) -> None:
        self.record(self.table[action_id], action_id)

    def clear(self, targets_N2: np.ndarray) -> np.ndarray:
        """Return (...) bool: whether the straight line to each of these points is free."""
        ways = np.asarray(targets_N2) - self.pose[:2]
        longest = float(np.linalg.norm(ways, axis=-1).max())
        steps = np.linspace(0, 1, 2 + int(longest / (0.25 * self.grid.cell_m)))
        points = self.pose[:2] + ways[..., None, :] * steps[:, None]
        return np.all(is_free(self.grid, points), axis=-1)

    def ahead(self, yaw: float | np.ndarray, length_m: float | None = None) -> np.ndarray:
        """Return (..., 2) points in these directions, one step or ``length_m`` away."""
        length = self.config.step_m if length_m is None else length_m
        return self.pose[:2] + length * np.stack([np.cos(yaw), np.sin(yaw)], -1)

    def turn_around(self) -> None:
        """Make a full turn, left or right."""
        side = TURN_LEFT if self.rng.random() < 0.5 else TURN_RIGHT
        for _ in range(round(2 * math.pi / self.turn)):
            self.act(side)

    def trajectory(self, return_frame: int | None = None) -> Trajectory:
        ids = None if self.continuous else np.array(self.ids, np.int32)
        actions = np.array(self.actions, np.float64).reshape(-1, 3)
        return Trajectory(np.stack(self.poses), actions, ids, return_frame)


def make_trajectory(
    grid: NavGrid,
    actions: ActionConfig,
    frames: int,
    rng: np.random.Generator,
    *,
    policy: Policy = "follow",
    turn_around: float = 0.5,
    continuous: bool = False,
) -> Trajectory:
    """Walk through a scene.

    Args:
        grid: the cells where the agent can stand.
        actions: step length and turning angle (upper bounds for continuous actions).
        frames: number of frames T; T − 1 actions are made.
        rng: source of all randomness.
        policy: ``follow`` walks shortest paths between far goals, ``walk`` goes straight up to
            obstacles, ``revisit`` turns, goes to a far goal and comes back over the same positions.
        turn_around: probability of a full turn at the start (``revisit`` always makes it).
        continuous: small (dx, dy, dyaw) instead of the three discrete actions.

    Raises:
        UserError: too few frames for the policy, or angles that cannot make a half turn.
    """
    agent = _Agent(grid, actions, frames, rng, continuous)
    if policy == "revisit":
        return _revisit(agent)
    if rng.random() < turn_around:
        agent.turn_around()
    if policy == "walk":
        _walk(agent)
    else:
        _follow(agent)
    return agent.trajectory()


def _half_turn(config: ActionConfig) -> int:
    turns = 180 / config.turn_deg
    if abs(turns - round(turns)) > 1e-6:
        raise UserError(
            f"turn_deg is {config.turn_deg}: a revisit trajectory turns by 180 degrees, so use an "
            "angle that divides 180, such as 30, or collect no revisit episodes."
        )
    return round(turns)


def _revisit(agent: _Agent) -> Trajectory:
    """Turn around, go to a goal, and come back along the same poses with the opposite heading."""
    total = agent.frames
    half = _half_turn(agent.config)
    out = (total - 1 - 3 * half) // 2
    if out < 4:
        raise UserError(
            f"{total} frames are too few for a revisit episode with turns of "
            f"{agent.config.turn_deg} degrees; use at least {3 * half + 9}."
        )
    agent.turn_around()
    begin = len(agent.poses) - 1
    agent.frames = begin + 1 + out
    _follow(agent)
    agent.frames = total
    way = agent.poses[begin:]
    ids = agent.ids[begin:]
    return_frame = len(agent.poses) - 1
    side = TURN_LEFT if agent.rng.random() < 0.5 else TURN_RIGHT
    for _ in range(half):
        agent.act(side)
    opposite = {FORWARD: FORWARD, TURN_LEFT: TURN_RIGHT, TURN_RIGHT: TURN_LEFT, -1: -1}
    for place, action_id in zip(reversed(way[:-1]), reversed(ids), strict=True):
        if action_id >= 0:
            agent.act(opposite[action_id])
        else:
            agent.record(action_to(agent.pose, place + np.array([0, 0, math.pi])))
    while not agent.done:
        agent.act(side)
    return agent.trajectory(return_frame)


def _follow(agent: _Agent) -> None:
    """Walk along shortest paths to far goals, one after the other."""
    while not agent.done:
        field, before = _next_goal(agent), len(agent.poses)
        stalled, best = 0, _value(agent, field, agent.pose[None, :2])[0]
        while not agent.done and stalled < 3:
            if agent.continuous:
                _drift(agent, _best_heading(agent, field)[0])
            else:
                heading, turns = _best_heading(agent, field)
                for _ in range(abs(turns)):
                    agent.act(TURN_LEFT if turns > 0 else TURN_RIGHT)
                if agent.clear(agent.ahead(heading)):
                    agent.act(FORWARD)
            value = _value(agent, field, agent.pose[None, :2])[0]
            stalled = 0 if value < best - 0.2 * agent.config.step_m else stalled + 1
            best = min(best, value)
            if _distance(agent.grid, field, agent.pose[None, :2])[0] < 2 * agent.config.step_m:
                break
        if stalled >= 3 or len(agent.poses) == before:  # steps do not fit here: move elsewhere
            _walk(agent, steps=4)


def _next_goal(agent: _Agent) -> np.ndarray:
    """Draw a far goal and return the field of distances to it."""
    here = distance_field(agent.grid, agent.pose[:2])
    candidates = sample_free(agent.grid, agent.rng, GOALS_TRIED)
    distance = _distance(agent.grid, here, candidates)
    distance = np.where(np.isfinite(distance), distance, -1.0)
    far = np.argsort(distance, kind="stable")[GOALS_TRIED // 2 :]
    return distance_field(agent.grid, candidates[agent.rng.choice(far)])


def _distance(grid: NavGrid, field_YX: np.ndarray, xy_N2: np.ndarray) -> np.ndarray:
    """Return a field's values at points; infinite outside the grid."""
    cell = grid.cell_of(xy_N2)
    inside = np.all((cell >= 0) & (cell < field_YX.shape), axis=-1)
    cell = np.where(inside[..., None], cell, 0)
    return np.where(inside, field_YX[cell[:, 0], cell[:, 1]], np.inf)


def _value(agent: _Agent, field_YX: np.ndarray, xy_N2: np.ndarray) -> np.ndarray:
    """Return the distance to the goal plus a penalty near walls, metres."""
    near = np.maximum(0, CLEARANCE_M - _distance(agent.grid, agent.clearance_YX, xy_N2))
    return _distance(agent.grid, field_YX, xy_N2) + 0.3 * np.where(np.isfinite(near), near, 0)


def _best_heading(agent: _Agent, field_YX: np.ndarray) -> tuple[float, int]:
    """Return the heading whose next step is best, and the number of turns to it (left > 0)."""
    count = max(2, round(2 * math.pi / agent.turn))
    turns = np.arange(count) - count // 2
    turns = turns[np.argsort(np.abs(turns), kind="stable")]
    yaw = agent.pose[2] + turns * agent.turn
    # Look one step and three steps ahead: grid distances are too coarse for one step alone.
    value = np.full(count, np.inf)
    for steps in (1, 3):
        points = agent.ahead(yaw, steps * agent.config.step_m)
        reached = _value(agent, field_YX, points) + (steps - 1) * agent.config.step_m
        value = np.minimum(value, np.where(agent.clear(points), reached, np.inf))
    best = int(np.argmin(value + TURN_COST_M * np.abs(turns)))
    return float(yaw[best]), int(turns[best])


def _drift(agent: _Agent, heading: float) -> None:
    """Make one continuous action towards a heading: bounded turn, slower in curves."""
    config, rng = agent.config, agent.rng
    error = (heading - agent.pose[2] + math.pi) % (2 * math.pi) - math.pi
    turn = float(np.clip(error, -agent.turn, agent.turn)) * rng.uniform(0.5, 1.0)
    speed = config.step_m * rng.uniform(0.5, 1.0) * max(0.0, math.cos(error))
    side = 0.1 * config.step_m * rng.uniform(-1.0, 1.0)
    after = advance(agent.pose, np.array([speed, side, turn]))
    if agent.clear(after[:2]):
        agent.record(np.array([speed, side, turn]))
    else:
        agent.record(np.array([0.0, 0.0, turn or agent.turn]))


def _walk(agent: _Agent, steps: int | None = None) -> None:
    """Go straight; turn by a random angle at obstacles, and elsewhere with probability 0.05."""
    remaining = agent.frames if steps is None else steps
    while not agent.done and remaining > 0:
        remaining -= 1
        if agent.clear(agent.ahead(agent.pose[2])) and agent.rng.random() > 0.05:
            if agent.continuous:
                _drift(agent, agent.pose[2])
            else:
                agent.act(FORWARD)
            continue
        side = TURN_LEFT if agent.rng.random() < 0.5 else TURN_RIGHT
        for _ in range(int(agent.rng.integers(1, 2 + round(math.pi / agent.turn)))):
            agent.act(side)
