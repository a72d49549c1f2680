"""Point clouds of what the frames of an episode measured: PLY (z up) and GLB (y up)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from pewm_jax.config import UserError
from pewm_jax.data.episodes import Episode
from pewm_jax.data.exports.options import ExportConfig
from pewm_jax.data.voxels import measured_points
from pewm_jax.geometry.cameras import Y_UP_FROM_Z_UP


class Fusion:
    """Coloured points, averaged in cubes of a side in metres."""

    def __init__(self, side_m: float):
        self.side_m = side_m
        self._keys = np.zeros((0, 3), np.int64)
        self._sums = np.zeros((0, 7))

    def add(self, points_N3: np.ndarray, colours_N3: np.ndarray) -> None:
        """Add points in metres with uint8 colours."""
        keys = np.floor(np.asarray(points_N3, np.float64) / self.side_m).astype(np.int64)
        own = np.concatenate([points_N3, colours_N3, np.ones((len(points_N3), 1))], 1)
        keys = np.concatenate([self._keys, keys])
        self._keys, cell = np.unique(keys, axis=0, return_inverse=True)
        values = np.concatenate([self._sums, own])
        self._sums = np.stack(
            [np.bincount(cell.reshape(-1), column, len(self._keys)) for column in values.T], 1
        )

    def result(self) -> tuple[np.ndarray, np.ndarray]:
        """Return points (N, 3) float32 and their colours (N, 3) uint8."""
        mean = self._sums[:, :6] / self._sums[:, 6:]
        return mean[:, :3].astype(np.float32), np.rint(mean[:, 3:]).astype(np.uint8)


def fuse(episode: Episode, side_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (N, 3) that all frames of an episode measured, and colours (N, 3)."""
    cloud = Fusion(side_m)
    for k in range(episode.length):
        frame = episode.frames([k])
        pose = episode.world_from_camera[k]
        points, (row, column) = measured_points(frame.depth_THW[0], episode.intrinsics_4, pose, 1)
        cloud.add(points, frame.rgb_THWC[0][row, column])
    return cloud.result()


def write(path: Path, points_N3: np.ndarray, colours_N3: np.ndarray) -> None:
    """Write points with uint8 colours as PLY or GLB, by the suffix."""
    cloud = trimesh.PointCloud(points_N3, colours_N3)
    kind = path.suffix.lower().removeprefix(".")
    if kind == "glb":
        cloud.apply_transform(Y_UP_FROM_Z_UP)
        data: Any = trimesh.Scene({"map": cloud}).export(file_type="glb")
    else:
        data = cloud.export(file_type="ply")
    path.write_bytes(data)


def export(config: ExportConfig, episode: Episode, file: Path) -> None:
    """Write the points of an episode.

    Raises:
        UserError: no frame has depth.
    """
    points, colours = fuse(episode, config.point_m)
    if not len(points):
        raise UserError(f"{episode.name} has no measured depth, so there are no points to write.")
    write(file, points, colours)
