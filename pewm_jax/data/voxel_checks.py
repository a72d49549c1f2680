"""Checks of the grids around the agent: shapes, classes, the lattice, and what the camera sees."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from pewm_jax.config import ConfigError, GridConfig, UserError
from pewm_jax.config.model import World
from pewm_jax.data.voxel_classes import PALETTE, SIDE_LIMIT, VoxelsConfig
from pewm_jax.data.voxel_frames import DTYPES, VoxelFrames, VoxelGrid
from pewm_jax.types import Camera

if TYPE_CHECKING:
    from pewm_jax.data.episodes import Episode

OFF_CELLS = 1e-3
"""Largest distance of a grid's corner from the lattice of the first frame's, cells."""
MOST_FLOATING = 0.1
"""Largest share of the points seen in a grid with only empty cells around them, over ``LOOKS``
frames; right data has next to none."""
LOOKS, STEP = 8, 3
"""Frames looked at, and of these every n-th row and column."""


def require_same_cells(world: World, episode: Episode) -> None:
    """Refuse collected grids of other classes, or pictures of something else, than a world expects.

    Args:
        world: its settings; worlds without a memory of kind ``grid`` ask for nothing.
        episode: of the data. Tables of other makers are not compared.

    Raises:
        ConfigError: another table of classes, or pictures of surfaces where cells are expected.
    """
    memory = getattr(world, "memory", None)
    if not isinstance(memory, GridConfig) or episode.voxel_grid is None:
        return
    for kinds in ("all", "groups"):
        for colours in range(1, len(PALETTE) + 1):
            same = (kinds, colours) == (memory.kinds, memory.colours)
            if not same and VoxelsConfig(kinds=kinds, colours=colours).names == (
                episode.voxel_grid.names
            ):
                raise ConfigError(
                    f"episode {episode.name} was collected with --voxels.kinds {kinds} "
                    f"--voxels.colours {colours}, and memory.kinds is {memory.kinds}, memory."
                    f"colours {memory.colours}: use the same."
                )
    shown = episode.info.get("pictures", "surfaces")
    if shown != memory.pictures:
        raise ConfigError(
            f"episode {episode.name} has pictures of {shown}, and memory.pictures is "
            f"{memory.pictures}: use that, or collect with --voxels.pictures {memory.pictures}."
        )


def refuse_misfits(voxels: VoxelFrames, frames: int, where: str) -> None:
    """Check grids before they are written.

    Args:
        voxels: the grids.
        frames: how many there have to be.
        where: what to call them in messages.

    Raises:
        UserError: another number of frames, a grid that is no cube, classes that are not in the
            table, or corners that are not whole cells apart.
    """
    classes, origin, names = voxels.classes_TXYZ, voxels.origin_T3, voxels.names
    shape = classes.shape
    if len(shape) != 4 or shape[0] != frames or len(set(shape[1:])) != 1:
        raise UserError(
            f"{where}, field voxels: shape {shape} for {frames} frames, expected ({frames}, n, n, "
            "n); the counts do not match."
        )
    if np.shape(origin) != (frames, 3) or not np.isfinite(origin).all():
        raise UserError(
            f"{where}, field voxel_origins: shape {np.shape(origin)} for {frames} frames, expected "
            f"({frames}, 3) finite numbers in metres."
        )
    if classes.dtype.newbyteorder("<").str not in DTYPES:
        raise UserError(
            f"{where}, field voxels: dtype {classes.dtype}, expected uint8 or uint16 class ids."
        )
    if not 1 <= shape[-1] <= SIDE_LIMIT or not voxels.cell_m > 0 or len(names) < 2:
        raise UserError(
            f"{where}, field voxels: {shape[-1]} cells of {voxels.cell_m} m and {len(names)} "
            f"classes: give 1 to {SIDE_LIMIT} cells above 0 m, and the names of 2 or more classes."
        )
    unknown = np.flatnonzero(classes.reshape(frames, -1).max(1) >= len(names))
    if len(unknown):
        found = int(classes[unknown[0]].max())
        raise UserError(
            f"{where}, frame {unknown[0]}, voxels: class {found} is not in the table, which has "
            f"{len(names)} classes (0 to {len(names) - 1}): give each class a name."
        )
    for frame, off in off_lattice(origin, voxels.cell_m):
        raise UserError(
            f"{where}, frame {frame}, voxels: the grid's corner is {off:.3g} cells off the lattice "
            "of frame 0: grids must move by whole cells."
        )


def off_lattice(origin_T3: np.ndarray, cell_m: float) -> Iterator[tuple[int, float]]:
    """Yield the frames whose corners are not whole cells from the first one's, and by how much."""
    cells = (np.asarray(origin_T3, np.float64) - origin_T3[0]) / cell_m
    off = np.abs(cells - np.round(cells)).max(-1)
    # Places are stored in single precision: far from the world's origin they are coarser.
    allowed = OFF_CELLS + 4 * np.spacing(np.abs(origin_T3).max().astype(np.float32)) / cell_m
    for frame in np.flatnonzero(off > allowed):
        yield int(frame), float(off[frame])


def outside(origin_T3: np.ndarray, grid: VoxelGrid, place_T3: np.ndarray) -> list[int]:
    """Return the frames in which a place (T, 3) does not lie in the grid."""
    at = (np.asarray(place_T3, np.float64) - origin_T3) / (grid.cell_m * grid.side)
    return np.flatnonzero(((at < 0) | (at > 1)).any(-1)).tolist()


def disagreement(
    voxels: VoxelFrames, depth_THW: np.ndarray, camera: Camera
) -> tuple[int, float] | None:
    """Return the frame that fits its grid worst, and the share of points that float in all frames.

    A point that the camera sees in the grid floats if its cell and those around it are empty.

    Args:
        voxels: the grids of T frames.
        depth_THW: their depths, metres.
        camera: (T,) their cameras.

    Returns:
        None where at most ``MOST_FLOATING`` float.
    """
    frames, height, width = depth_THW.shape
    rows, columns = np.mgrid[0:height:STEP, 0:width:STEP]
    lost, seen = np.zeros(frames), np.zeros(frames)
    for t in range(frames):
        depth = np.asarray(depth_THW[t, rows, columns], np.float64)
        fx, fy, cx, cy = np.asarray(camera.intrinsics_4[t], np.float64)
        ray = np.stack([(columns + 0.5 - cx) / fx, (rows + 0.5 - cy) / fy, np.ones_like(depth)], -1)
        pose = np.asarray(camera.world_from_camera[t], np.float64)
        points = (ray * depth[..., None])[depth > 0] @ pose[:3, :3].T + pose[:3, 3]
        grid = voxels.classes_TXYZ[t]
        near = np.asarray(ndimage.binary_dilation(grid > 0, np.ones((3, 3, 3))))
        cell = np.floor((points - voxels.origin_T3[t]) / voxels.cell_m).astype(int)
        cell = cell[((cell >= 0) & (cell < grid.shape)).all(-1)]
        lost[t], seen[t] = (near[tuple(cell.T)] == 0).sum(), len(cell)
    share = float(lost.sum() / max(1, seen.sum()))
    if share <= MOST_FLOATING:
        return None
    return int((lost / np.maximum(seen, 1)).argmax()), share
