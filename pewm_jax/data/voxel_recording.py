"""The grids of an episode: cut out of the house around the agent, with what moves at each frame."""

from __future__ import annotations

import functools

import numpy as np

from pewm_jax.data.moving import MovingHouse, part_at
from pewm_jax.data.scenes import Scene
from pewm_jax.data.voxel_classes import VoxelsConfig
from pewm_jax.data.voxel_frames import VoxelFrames
from pewm_jax.data.voxelise import Filled, Lattice, around, fill, lattice_of, together

PART_M = 1.5
"""Parts reach no farther than this from their own origin, metres."""


def record_voxels(
    config: VoxelsConfig,
    scene: Scene,
    floor_z: float,
    centre_T3: np.ndarray,
    moving: MovingHouse | None = None,
    poses_TP44: np.ndarray | None = None,
) -> VoxelFrames:
    """Return the grids around an agent at T frames.

    Args:
        config: cell, side and classes.
        scene: all that stands still.
        floor_z: height of the floor, which becomes a border of cells, metres.
        centre_T3: (T, 3) the agent's camera, metres.
        moving: the house whose parts move, if they do.
        poses_TP44: (T, P, 4, 4) where these are, from ``MovingHouse.poses``.
    """
    lattice = _lattice(config, scene, floor_z)
    moved: list[Filled] | None = None
    if moving is not None and poses_TP44 is not None and len(moving.moves):
        moved = _moved(config, moving, poses_TP44, centre_T3, lattice)
    classes, origin = around(lattice, config.side, centre_T3, moved)
    return VoxelFrames(classes, origin.astype(np.float32), config.cell, config.names)


@functools.lru_cache(maxsize=1)
def _lattice(config: VoxelsConfig, scene: Scene, floor_z: float) -> Lattice:
    """Fill the lattice of a scene; that of the last one is kept, for its next episode."""
    point_3 = np.array([0.0, 0.0, floor_z])
    return lattice_of(config, fill(config, scene, point_3), point_3)


def _moved(
    config: VoxelsConfig,
    moving: MovingHouse,
    poses_TP44: np.ndarray,
    centre_T3: np.ndarray,
    lattice: Lattice,
) -> list[Filled]:
    """Return the cells of what moves at each frame; what stays where it was is found once."""
    known: dict[tuple[int, bytes], Filled] = {}
    reach = (config.side / 2 + 1) * config.cell + PART_M
    nothing = Filled(np.zeros((0, 3), np.int64), np.zeros(0, np.int64), np.zeros(0))
    frames = []
    for poses, centre in zip(poses_TP44, centre_T3, strict=True):
        parts = [nothing]
        for number, pose in enumerate(poses):
            if np.abs(pose[:2, 3] - centre[:2]).max() > reach:
                continue
            key = number, pose.tobytes()
            if key not in known:
                known[key] = fill(config, part_at(moving, number, pose), lattice.point_3)
            parts.append(known[key])
        frames.append(together(parts))
    return frames
