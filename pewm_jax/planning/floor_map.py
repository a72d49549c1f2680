"""Where there is room to walk, by what was seen: a map of the floor from posed depth.

A camera does not see what stands beside the agent's feet, so one image is not enough: everything
that was seen before counts. What is between the floor and a little above the camera stands in the
way. The floor is the lowest level that was seen much of.
"""

from __future__ import annotations

import numpy as np

from pewm_jax.types import Frames

CELL_M = 0.05
RADIUS_M = 0.27
"""What is nearer to the middle of the way than this, is in it."""
ABOVE_FLOOR_M, ABOVE_CAMERA_M = 0.2, 0.1
"""What is lower than the first, or higher above the camera than the second, is in nobody's way."""
LEAST = 3
"""So many points make a cell occupied: single ones are measured or imagined wrongly."""
LOWEST = 1.0
"""The floor is where this share of the points, in per cent, lies at or below."""
STEPS = 6
"""Places along a way that are looked at."""
FAR_M = 6.0
"""What is farther from the camera is not put in: its place is uncertain, and coarse."""


class FloorMap:
    """Occupied cells of the floor, from all frames that were added."""

    def __init__(self) -> None:
        self._points = np.zeros((0, 3))
        self._cameras = np.zeros(0)
        self._cells: set[tuple[int, int]] | None = None

    def add(self, frames: Frames) -> None:
        """Add (T,) posed depth; 0 is no measurement."""
        depth_THW = np.asarray(frames.depth_THW, np.float64)
        poses = np.asarray(frames.camera.world_from_camera, np.float64)
        fx, fy, cx, cy = np.moveaxis(
            np.asarray(frames.camera.intrinsics_4, np.float64)[:, None, None], -1, 0
        )
        rows, columns = np.indices(depth_THW.shape[1:]) + 0.5
        right, down = (columns - cx) / fx * depth_THW, (rows - cy) / fy * depth_THW
        seen = np.stack([right, down, depth_THW], -1)
        world = np.einsum("tij,thwj->thwi", poses[:, :3, :3], seen) + poses[:, None, None, :3, 3]
        measured = (depth_THW > 0) & (depth_THW <= FAR_M)
        self._points = np.concatenate([self._points, world[measured]])
        self._cameras = np.concatenate([self._cameras, poses[:, 2, 3]])
        self._cells = None

    def free(self, start_xy: np.ndarray, end_xy: np.ndarray) -> bool:
        """Tell whether nothing that was seen stands in a straight way."""
        cells = self._occupied()
        reach = int(np.ceil(RADIUS_M / CELL_M)) + 1
        around = np.arange(-reach, reach + 1)
        for share in np.linspace(0, 1, STEPS)[1:]:
            place = np.asarray(start_xy) + share * (np.asarray(end_xy) - np.asarray(start_xy))
            middle = np.floor(place / CELL_M).astype(int)
            for dx in around:
                for dy in around:
                    cell = int(middle[0] + dx), int(middle[1] + dy)
                    if cell in cells:
                        away = (np.array(cell) + 0.5) * CELL_M - place
                        if np.hypot(*away) < RADIUS_M:
                            return False
        return True

    def _occupied(self) -> set[tuple[int, int]]:
        """Return the cells with something in the way of an agent, made when first asked for."""
        if self._cells is None:
            points = self._points
            if not len(points):
                return set()
            height = points[:, 2]
            floor = np.percentile(height, LOWEST)
            body = (height > floor + ABOVE_FLOOR_M) & (
                height < self._cameras.mean() + ABOVE_CAMERA_M
            )
            cells, counts = np.unique(
                np.floor(points[body, :2] / CELL_M).astype(int), axis=0, return_counts=True
            )
            self._cells = {(int(x), int(y)) for x, y in cells[counts >= LEAST]}
        return self._cells
