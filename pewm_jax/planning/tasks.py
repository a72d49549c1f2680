"""Tasks in a house: where an episode begins and where it has to end."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.data.navigation import NavGrid, PathsToGoal, sample_free
from pewm_jax.planning.house_config import HouseConfig

GOALS_TRIED = 20
STARTS_TRIED = 10


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """An episode's task.

    Attributes:
        start_3: (3,) x, y, yaw of the first frame.
        goal_3: (3,) x, y, yaw of the goal; its heading is that of who comes by the shortest way.
        ways: the shortest ways to the goal.
        shortest_m: the length of the shortest one from the start.
    """

    start_3: np.ndarray
    goal_3: np.ndarray
    ways: PathsToGoal
    shortest_m: float


def draw(config: HouseConfig, grid: NavGrid, rng: np.random.Generator, where: str) -> Task:
    """Draw a start and a goal whose distance on foot lies within the configured bounds.

    The goal is uniform over the free area, the start over that part of it which is in bounds, the
    start's heading over the circle.

    Args:
        config: ``min_distance_m`` and ``max_distance_m`` count.
        grid: where the agent can stand.
        rng: everything random comes from here.
        where: name of the scene, for the refusal.

    Raises:
        UserError: no such pair was found.
    """
    low, high = config.min_distance_m, config.max_distance_m
    farthest = 0.0
    for goal in sample_free(grid, rng, GOALS_TRIED):
        ways = PathsToGoal(grid, goal)
        distance = np.where(np.isfinite(ways.distance_YX), ways.distance_YX, -1.0)
        farthest = max(farthest, float(distance.max()))
        # Distances from cell to cell are up to 8 % longer than the way pulled tight.
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
        f"{where} has no two places from {low:g} to {high:g} m apart on foot (the farthest found "
        f"are {farthest:.1f} m): change min_distance_m and max_distance_m, or take a scene with "
        "more room."
    )
