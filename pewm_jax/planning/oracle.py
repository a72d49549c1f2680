"""An oracle for the house: it knows the navigation grid and follows a shortest path to the goal.

It is an upper bound for policies, and a source of demonstrations::

    for action in oracle.actions(env):
        observation, reward, terminated, truncated, info = env.step(action)
"""

from __future__ import annotations

import heapq
import itertools
import math
from typing import Any

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.data.simulator import move
from pewm_jax.geometry.actions import FORWARD, TURN_LEFT, TURN_RIGHT, discrete_table
from pewm_jax.planning import scores
from pewm_jax.planning.house import HouseEnv
from pewm_jax.planning.observations import gymnasium

TURN_STEPS = 0.25
"""Cost of a turn, in forward steps."""
HEURISTIC_WEIGHT = 1.3
"""Weight of A*'s heuristic: above 1 the search is much faster and its path slightly longer."""
SAME_M = 0.05
"""Positions closer than this with the same heading are one node of the search, metres."""


def actions(env: gymnasium.Env) -> list[Any]:
    """Return the actions from the agent's pose to the goal, for a house within an episode.

    A* over forward steps and turns, guided by the geodesic distance; the house is deterministic, so
    these actions reach the goal. For a house with continuous actions they are the rows of the
    discrete actions' table.

    Raises:
        UserError: it is not a house, no episode has started, or steps of this length and angle
            cannot reach the goal.
    """
    house = env.unwrapped
    if not isinstance(house, HouseEnv):
        raise UserError(f"the oracle needs a house, got a {type(house).__name__}.")
    found = _search(house)
    if house.config.actions == "discrete":
        return found
    return list(discrete_table(house.config.action_config)[found])


def _search(house: HouseEnv) -> list[int]:
    """Return discrete actions to the goal."""
    config, ways = house.config, house.task.ways
    table = discrete_table(config.action_config).astype(np.float64)
    order = itertools.count()  # the heap never compares poses
    start = house.planar
    waiting = [(_estimate(house, start), next(order), 0.0, start, 0)]
    came: dict[int, tuple[int, int]] = {}
    numbers, closed = itertools.count(1), set()
    while waiting:
        _, _, cost, planar, number = heapq.heappop(waiting)
        key = _key(planar, config.turn_deg)
        if key in closed:
            continue
        closed.add(key)
        # Grid distances are up to 8 % too long; compute the exact one only near the goal.
        row, column = house.grid.cell_of(planar[:2])
        near = ways.distance_YX[row, column] <= 1.1 * config.success_m + 2 * house.grid.cell_m
        near = near and ways.length(planar[:2]) <= config.success_m
        turned = math.degrees(scores.yaw_error(planar, house.task.goal_3))
        if near and turned <= config.success_deg:
            return _actions_to(came, number)
        for action in (FORWARD, TURN_LEFT, TURN_RIGHT):
            after, collided = move(house.grid, planar, table[action], sliding=False)
            if collided or _key(after, config.turn_deg) in closed:
                continue
            child, paid = next(numbers), cost + (1.0 if action == FORWARD else TURN_STEPS)
            came[child] = (number, action)
            waiting_for = paid + _estimate(house, after)
            heapq.heappush(waiting, (waiting_for, next(order), paid, after, child))
    raise UserError(
        f"steps of {config.step_m:g} m and turns of {config.turn_deg:g} degrees do not lead to "
        "this goal: use smaller ones, or a larger success_m and success_deg."
    )


def _estimate(house: HouseEnv, planar: np.ndarray) -> float:
    """Return an estimate of the remaining forward steps, from grid distances."""
    ways = house.task.ways
    row, column = house.grid.cell_of(planar[:2])
    left = float(ways.distance_YX[row, column]) - house.config.success_m
    return HEURISTIC_WEIGHT * max(0.0, left) / house.config.step_m


def _key(planar: np.ndarray, turn_deg: float) -> tuple[int, int, int]:
    """Return a key that is equal for nearly equal poses."""
    around = max(1, round(360 / turn_deg))
    heading = round(planar[2] / math.radians(turn_deg)) % around
    return round(planar[0] / SAME_M), round(planar[1] / SAME_M), heading


def _actions_to(came: dict[int, tuple[int, int]], number: int) -> list[int]:
    """Return the actions that lead to a node of the search."""
    done = []
    while number:
        number, action = came[number]
        done.append(action)
    return done[::-1]
