"""Episodes of Habitat: their files, and the walk of each, by turns and steps with z up."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from pewm_jax.config import UserError
from pewm_jax.data import navigation
from pewm_jax.data.formats.options import ImportConfig
from pewm_jax.geometry.cameras import pose_from_yaw

TURN = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""From y up to z up."""
STOREY_M = 0.5
"""A start farther from the floor of the navigation grid is on another storey, metres."""
START_M, GOAL_M = 0.5, 2.0
"""Largest distances of a start and of a goal from the cells where the agent can stand, metres."""
GOAL_RISE_M = 1.8
"""A goal, which may be an object, higher above the start or below it is on another storey."""

Grids: TypeAlias = Callable[[float | None], navigation.NavGrid]
"""Return where the agent can stand: on the main storey, or on the one near a height."""


class NoWayError(UserError):
    """An episode has nowhere to go in its mesh; other episodes may have."""


def read_episodes(path: Path) -> list[dict[str, Any]]:
    """Read one file of episodes; a file that only refers to others has none."""
    try:
        with gzip.open(path, "rt", encoding="utf-8") as file:
            table = json.load(file)
        found = [one for one in table["episodes"] if isinstance(one, dict)]
        shared = dict(table.get("goals_by_category") or {})
    except (OSError, EOFError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} cannot be read as episodes of Habitat ({error!r}).") from None
    return [one if one.get("goals") else one | {"goals": _goals(one, shared)} for one in found]


def _goals(episode: dict[str, Any], shared: dict[str, Any]) -> list[Any]:
    """Return the goals of an episode's category, the closest one first if the episode names it."""
    scene, category = Path(str(episode.get("scene_id", ""))).name, episode.get("object_category")
    goals = list(shared.get(f"{scene}_{category}") or [])
    closest = (episode.get("info") or {}).get("closest_goal_object_id")
    return sorted(goals, key=lambda goal: closest is None or goal.get("object_id") != closest)


def walk(
    episode: dict[str, Any],
    options: ImportConfig,
    grid: Grids,
    what: str,
) -> np.ndarray:
    """Return the poses (T, 4, 4) of level cameras on an episode's way, at most ``frames``.

    Args:
        episode: its entries in the file.
        options: height of the camera, step, turn and number of frames.
        grid: called if the shortest path is needed.
        what: the episode in error messages.

    Raises:
        UserError: the episode has no usable start.
        NoWayError: it has no path and no goal, or its goal cannot be reached on the start's storey.
    """
    try:
        start = TURN @ np.array(episode["start_position"], float).reshape(3)
        facing = Rotation.from_quat(np.array(episode["start_rotation"], float)).as_matrix()
        goal = [list(_place(one)) for one in (episode.get("goals") or [])[:1]]
        listed = np.array(episode.get("reference_path") or goal, float).reshape(-1, 3) @ TURN.T
    except (KeyError, ValueError, TypeError) as error:
        raise UserError(f"{what} lacks a start, a rotation or a goal ({error!r}).") from None
    if not np.isfinite([*start, *facing.ravel()]).all():
        raise UserError(f"{what} starts at a position that is not finite.")
    forward = TURN @ facing @ [0, 0, -1]
    if not episode.get("reference_path") and len(listed):
        listed = _around(grid, start, listed[0], what)
    poses = [np.array([*start, np.arctan2(forward[1], forward[0])])]
    for target in listed:
        poses += _towards(poses[-1], target, options)
    if len(poses) == 1:
        raise NoWayError(f"{what} has no reference path and no goal away from its start")
    eye = np.array([0, 0, options.camera_height])
    shown = poses[: options.frames]
    return np.stack([pose_from_yaw(one[:3] + eye, float(one[3])) for one in shown])


def _towards(pose_4: np.ndarray, target_3: np.ndarray, options: ImportConfig) -> list[np.ndarray]:
    """Return poses x, y, z, yaw that turn to a point and go there in equal steps."""
    way = target_3 - pose_4[:3]
    far = float(np.linalg.norm(way[:2]))
    if far < 1e-3:
        return []
    turn = (np.arctan2(way[1], way[0]) - pose_4[3] + np.pi) % (2 * np.pi) - np.pi
    turns = int(np.ceil(abs(turn) / np.radians(options.turn_deg) - 1e-6))
    steps = int(np.ceil(far / options.step - 1e-6))
    turned = [pose_4 + np.array([0, 0, 0, turn * k / turns]) for k in range(1, turns + 1)]
    faced, move = turned[-1] if turned else pose_4, np.append(way, 0)
    return [*turned, *(faced + move * (k / steps) for k in range(1, steps + 1))]


def _place(goal: dict[str, Any]) -> list[float]:
    """Return where a goal is reached: its first view point, else its own position."""
    views = goal.get("view_points") or []
    return views[0]["agent_state"]["position"] if views else goal["position"]


def _around(grids: Grids, start: np.ndarray, goal: np.ndarray, what: str) -> np.ndarray:
    """Return the points (N, 3) of the shortest path to a goal."""
    if abs(goal[2] - start[2]) > GOAL_RISE_M:
        raise NoWayError(f"{what} has its goal on another storey than its start")
    grid = grids(None)
    if abs(start[2] - grid.floor_z) > STOREY_M:
        try:
            grid = grids(round(float(start[2]), 1))
        except UserError as error:
            raise NoWayError(f"{what} starts where no floor is ({error})") from None
    ends = []
    for name, point, most in (("starts", start, START_M), ("has its goal", goal, GOAL_M)):
        ends.append(navigation.nearest_free(grid, point[:2]))
        away = float(np.linalg.norm(ends[-1] - point[:2]))
        if away > most:
            raise NoWayError(f"{what} {name} {away:.1f} m from where an agent can stand")
    path = navigation.shortest_path(grid, *ends)
    assert path is not None  # both ends are free, and the free cells are connected
    return np.column_stack([path[1:], np.full(len(path) - 1, start[2])])
