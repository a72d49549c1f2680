"""Scores of a trajectory relative to a goal: ATE, RPE, final errors, SIM, success, SPL.

Trajectories are cameras (T, 4, 4), ``world_from_camera``, or planar poses (T, 3), x, y, yaw; two
compared trajectories must have the same number of frames and the same world frame: they are not
aligned. NumPy float64. ATE and RPE are those of ``evo`` (its ``APE`` and ``RPE`` of the translation
part, root mean square, RPE from each frame to the next), as in Sturm et al., "A benchmark for the
evaluation of RGB-D SLAM systems", IROS 2012.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from pewm_jax.config import UserError

LEAST_TASK_M = 0.25
"""Lower bound of a task's length where errors are relative to it, metres; one step."""


def ate(reference: ArrayLike, estimate: ArrayLike) -> float:
    """Return the absolute trajectory error: the root mean square distance of positions, metres.

    Raises:
        UserError: the shapes do not fit, or values are not finite.
    """
    true, made = _pair(reference, estimate, "ate", 1)
    away = np.linalg.norm(made[:, :3, 3] - true[:, :3, 3], axis=-1)
    return math.sqrt(np.mean(away**2))


def rpe(reference: ArrayLike, estimate: ArrayLike) -> float:
    """Return the relative pose error: root mean square translation error per step, metres, T ≥ 2.

    It compares the motion from each frame to the next, in the coordinates of the first of the two.

    Raises:
        UserError: as for ``ate``.
    """
    true, made = _pair(reference, estimate, "rpe", 2)
    true, made = (np.linalg.inv(poses[:-1]) @ poses[1:] for poses in (true, made))
    errors = np.linalg.inv(true) @ made
    return math.sqrt(np.mean(np.sum(errors[:, :3, 3] ** 2, -1)))


def position_error(pose: ArrayLike, goal: ArrayLike) -> float:
    """Return the Euclidean distance between two poses (4, 4) or (3,) on the ground, metres."""
    here, there = _planar(pose, "position_error"), _planar(goal, "position_error")
    return math.hypot(*(here[:2] - there[:2]))


def yaw_error(pose: ArrayLike, goal: ArrayLike) -> float:
    """Return the angle between the headings of two poses (4, 4) or (3,), from 0 to π."""
    here, there = _planar(pose, "yaw_error"), _planar(goal, "yaw_error")
    return float(abs((here[2] - there[2] + math.pi) % (2 * math.pi) - math.pi))


def path_length(trajectory: ArrayLike) -> float:
    """Return the metres walked along (T, 4, 4) or (T, 3) poses."""
    positions = _cameras(trajectory, "path_length", 1)[:, :3, 3]
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=-1).sum())


def sim(start: ArrayLike, final: ArrayLike, goal: ArrayLike) -> float:
    """Return the similarity of a final pose to the goal, in percent; poses are (4, 4) or (3,).

    The paper reports a "SIM" without defining it. This definition is ours and is not comparable
    with the paper's::

        SIM = 100 · (P + H) / 2
        P = max(0, 1 − |final − goal| / max(|start − goal|, 0.25 m))     position
        H = 1 − |heading of final − heading of goal| / π                 heading

    100 is the goal itself. P measures the remaining distance relative to the task, so tasks of all
    lengths count equally; an agent that stays in place, or ends farther away, has P = 0. H is 0 for
    the opposite heading. An agent that does nothing in a task without a turn scores 50.

    Raises:
        UserError: the shapes do not fit, or values are not finite.
    """
    task = max(position_error(start, goal), LEAST_TASK_M)
    position = max(0.0, 1 - position_error(final, goal) / task)
    heading = 1 - yaw_error(final, goal) / math.pi
    return 50 * (position + heading)


def success(
    final: ArrayLike, goal: ArrayLike, within_m: float = 0.5, within_deg: float = 180.0
) -> bool:
    """Return whether a pose is near the goal in distance and heading, bounds included."""
    near = position_error(final, goal) <= within_m
    return bool(near and math.degrees(yaw_error(final, goal)) <= within_deg)


def spl(success: ArrayLike, shortest_m: ArrayLike, walked_m: ArrayLike) -> float:
    """Return the mean success weighted by path length, S · L / max(P, L), of N episodes, 0 to 1.

    L is the shortest path from start to goal, P the path walked. It may be shorter than L, because
    an episode ends within a radius of the goal.

    Raises:
        UserError: there are no episodes, the shapes differ, or a shortest path is not above 0.
    """
    won, least, walked = (np.asarray(x, np.float64) for x in (success, shortest_m, walked_m))
    if won.size == 0 or not won.shape == least.shape == walked.shape:
        raise UserError(
            f"spl() got successes {won.shape}, shortest paths {least.shape} and paths "
            f"{walked.shape}: give one of each per episode, N ≥ 1."
        )
    if not bool((least > 0).all()) or not np.isfinite([won, least, walked]).all():
        raise UserError("spl() got a shortest path that is not above 0, or values not finite.")
    return float(np.mean(won * least / np.maximum(walked, least)))


def _pair(
    reference: ArrayLike, estimate: ArrayLike, who: str, least: int
) -> tuple[np.ndarray, np.ndarray]:
    true, made = _cameras(reference, who, least), _cameras(estimate, who, least)
    if len(true) != len(made):
        raise UserError(
            f"{who}() got trajectories of {len(true)} and {len(made)} poses: give equally many."
        )
    return true, made


def _cameras(trajectory: ArrayLike, who: str, least: int) -> np.ndarray:
    """Return poses as (T, 4, 4); planar ones as transforms on the ground."""
    poses = np.asarray(trajectory, np.float64)
    planar = poses.ndim == 2 and poses.shape[1:] == (3,)
    if not (planar or (poses.ndim == 3 and poses.shape[1:] == (4, 4))) or len(poses) < least:
        raise UserError(
            f"{who}() got poses of shape {poses.shape}: give (T, 4, 4) cameras or (T, 3) planar "
            f"poses x, y, yaw, with T ≥ {least}."
        )
    if not np.isfinite(poses).all():
        raise UserError(f"{who}() got poses with values that are not finite.")
    if not planar:
        return poses
    cameras = np.tile(np.eye(4), (len(poses), 1, 1))
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    cameras[:, 0, 0], cameras[:, 0, 1], cameras[:, 1, 0], cameras[:, 1, 1] = cos, -sin, sin, cos
    cameras[:, :2, 3] = poses[:, :2]
    return cameras


def _planar(pose: ArrayLike, who: str) -> np.ndarray:
    """Return one pose as x, y, yaw."""
    found = np.asarray(pose, np.float64)
    if found.shape not in ((4, 4), (3,)) or not np.isfinite(found).all():
        raise UserError(
            f"{who}() got a pose of shape {found.shape}: give a (4, 4) camera or x, y, yaw, finite."
        )
    if found.shape == (3,):
        return found
    return np.array([found[0, 3], found[1, 3], math.atan2(found[1, 2], found[0, 2])])
