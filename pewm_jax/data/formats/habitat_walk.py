"""The walk of an episode of Habitat: turns and steps along its path, in a world with z up."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

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


def walk(
    episode: dict[str, Any],
    options: ImportConfig,
    grid: Callable[[], navigation.NavGrid],
    what: str,
) -> np.ndarray:
    """Return the poses (T, 4, 4) of level cameras on an episode's way, at most ``frames``.

    Args:
        episode: its entries in the file.
        options: height of the camera, step, turn and number of frames.
        grid: returns where the agent can stand; called if the shortest path is needed.
        what: the episode in error messages.

    Raises:
        UserError: the episode has no usable start.
    """
    try:
        start = TURN @ np.array(episode["start_position"], float).reshape(3)
        facing = Rotation.from_quat(np.array(episode["start_rotation"], float)).as_matrix()
        goal = [list(one["position"]) for one in (episode.get("goals") or [])[:1]]
        listed = np.array(episode.get("reference_path") or goal, float).reshape(-1, 3) @ TURN.T
    except (KeyError, ValueError, TypeError) as error:
        raise UserError(f"{what} lacks a start, a rotation or a goal ({error!r}).") from None
    if not np.isfinite([*start, *facing.ravel()]).all():
        raise UserError(f"{what} starts at a position that is not finite.")
    forward = TURN @ facing @ [0, 0, -1]
    if not episode.get("reference_path") and len(listed):
        listed = _around(grid(), start, listed[0])
    poses = [np.array([*start, np.arctan2(forward[1], forward[0])])]
    for target in listed:
        poses += _towards(poses[-1], target, options)
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


def _around(grid: navigation.NavGrid, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return the points (N, 3) of the shortest path to a goal; a straight line if none is found."""
    ends = [navigation.nearest_free(grid, point[:2]) for point in (start, goal)]
    path = navigation.shortest_path(grid, *ends)
    if path is None or abs(start[2] - grid.floor_z) > STOREY_M:
        return goal[None]
    return np.column_stack([path[1:], np.full(len(path) - 1, start[2])])
