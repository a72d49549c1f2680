"""Simulate an agent in a scene: render frames from planar poses, and move with collisions.

Environments are based on it. It is stateless: ``frames`` maps poses to frames, ``move`` maps a pose
and an action to the next pose.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from pathlib import Path
from typing import Literal

import numpy as np

from pewm_jax.data.episodes import DEPTH_LIMIT_M
from pewm_jax.data.navigation import NavGrid, is_free, line_is_free, navigable
from pewm_jax.data.render import render
from pewm_jax.data.scenes import Scene, house, load_scene
from pewm_jax.data.shading import require_embree
from pewm_jax.data.trajectories import advance
from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw
from pewm_jax.types import Camera, Frames

HEADROOM_M = 0.1
"""Free space above the camera that the agent needs, metres."""
KEPT_HOUSES, KEPT_MESHES = 16, 2
"""Number of scenes cached per process, so that environments of one scene share it."""


@dataclasses.dataclass(frozen=True, eq=False)
class Simulator:
    """A scene, the cells where an agent's centre can be, and the agent's camera.

    Sizes of images are in pixels, the height of the camera above the floor in metres.
    """

    scene: Scene
    grid: NavGrid
    intrinsics_4: np.ndarray
    height: int
    width: int
    camera_height: float

    def world_from_camera(self, planar_3: np.ndarray) -> np.ndarray:
        """Return the (4, 4) float32 level camera of a planar pose x, y, yaw."""
        x, y, yaw = (float(value) for value in planar_3)
        return pose_from_yaw(np.array([x, y, self.grid.floor_z + self.camera_height]), yaw)

    def frames(self, planar_T3: np.ndarray) -> Frames:
        """Render the T NumPy frames seen from planar poses (T, 3): x, y, yaw, metres and radians.

        Depth is 0 where nothing is hit, and beyond the largest depth that episodes can store
        (65.534 m).
        """
        poses = np.stack([self.world_from_camera(pose) for pose in np.asarray(planar_T3)])
        intrinsics = np.tile(self.intrinsics_4, (len(poses), 1))
        camera = Camera(intrinsics, poses)
        seen = render(self.scene, camera, self.height, self.width)
        depth = np.where(seen.depth_THW <= DEPTH_LIMIT_M, seen.depth_THW, np.float32(0))
        return Frames(seen.rgb_THWC, depth, camera)


def open_simulator(
    *,
    house_seed: int = 0,
    scene: Path | None = None,
    up: Literal["auto", "y", "z"] = "auto",
    height: int = 64,
    width: int = 64,
    hfov: float = 90.0,
    camera_height: float = 1.25,
) -> Simulator:
    """Open a mesh file in metres, or the generated house of a seed.

    ``up`` is the axis of the mesh that points up; ``auto``: y for GLB and glTF, z for the others.
    Sizes of images are in pixels, the field of view in degrees, the camera's height above the floor
    in metres.

    Raises:
        UserError: there is no renderer, or a mesh does not load or has no free floor.
    """
    require_embree()
    if scene is None:
        world, grid = _kept_house(house_seed, camera_height)
    else:
        changed = scene.stat().st_mtime_ns if scene.is_file() else 0
        world, grid = _cached_mesh(scene, changed, up, camera_height)
    intrinsics = intrinsics_from_fov(height, width, hfov)
    return Simulator(world, grid, intrinsics, height, width, camera_height)


def move(
    grid: NavGrid, planar_3: np.ndarray, action_3: np.ndarray, *, sliding: bool = False
) -> tuple[np.ndarray, bool]:
    """Return the pose after an action with collisions: first move, then turn.

    The move is made if the whole straight line is free. Otherwise the agent stays in place, or
    slides: of the two components of the move along the grid's axes it makes the longer one that is
    free. The turn is made in either case.

    Args:
        grid: the cells where the agent can stand.
        planar_3: x, y, yaw; x and y lie in a free cell.
        action_3: metres forward, metres left, radians counter-clockwise.
        sliding: whether the agent slides along obstacles.

    Returns:
        The next pose, yaw in (−π, π], in a free cell; and whether the straight line was blocked.
    """
    planar = np.asarray(planar_3, np.float64)
    after = advance(planar, np.asarray(action_3, np.float64))
    after[2] = math.pi - (math.pi - after[2]) % (2 * math.pi)
    collided = not _passable(grid, planar[:2], after[:2])
    if collided:
        way, after[:2] = after[:2] - planar[:2], planar[:2]
        for axis in np.argsort(-np.abs(way), kind="stable") if sliding else ():
            there = planar[:2].copy()
            there[axis] += way[axis]
            if way[axis] and _passable(grid, planar[:2], there):
                after[:2] = there
                break
    return after, collided


def _passable(grid: NavGrid, start_xy: np.ndarray, end_xy: np.ndarray) -> bool:
    """Return whether the straight line is free, including its end, regardless of rounding."""
    return line_is_free(grid, start_xy, end_xy) and bool(is_free(grid, end_xy))


def open_house(seed: int, camera_height: float) -> tuple[Scene, NavGrid]:
    """Return the generated house of a seed, and the cells where the agent can stand."""
    scene = house(seed)
    return scene, navigable(scene, agent_height_m=camera_height + HEADROOM_M)


def open_mesh(
    path: Path, up: Literal["auto", "y", "z"], camera_height: float
) -> tuple[Scene, NavGrid]:
    """Return the scene of a mesh file, and the cells where the agent can stand."""
    scene = load_scene(path, up)
    return scene, navigable(scene, agent_height_m=camera_height + HEADROOM_M)


_kept_house = functools.lru_cache(maxsize=KEPT_HOUSES)(open_house)


@functools.lru_cache(maxsize=KEPT_MESHES)
def _cached_mesh(
    path: Path, changed: int, up: Literal["auto", "y", "z"], camera_height: float
) -> tuple[Scene, NavGrid]:
    """Open a mesh; it is read again if it has changed on disk."""
    del changed
    return open_mesh(path, up, camera_height)
