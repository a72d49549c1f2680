"""Voxelise surfaces: a house as a lattice of class ids, and the grids around an agent.

Cells are aligned with the world: their corners are whole multiples of their side from a point of
the lattice. Triangles are cut at the borders of cells, so every cell that a surface passes through
is found. A cell has the class with the largest area in it; walls and floors have less weight than
the objects in front of them.

A surface belongs to the cell just behind it (``BEHIND_M``): a floor at height 0 fills the cells
below 0, and so does a rug on it. Only walls belong to the cell just in front of them, so that the
two sides of one wall, in two colours, are farther apart. Solid objects are hollow: a cell without a
surface is empty.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np

from pewm_jax.data.moving import MovingHouse, part_at
from pewm_jax.data.scenes import Scene
from pewm_jax.data.voxels import VoxelFrames, VoxelsConfig, class_ids
from pewm_jax.houses.kinds import KINDS, SHELL, kind_of

BEHIND_M = 0.02
"""Distance by which surfaces are moved back, and walls forward, before they are cut; at most a
quarter of a cell."""
SHELL_WEIGHT = 1.0 / 3
"""Weight of an area of a wall or a floor relative to the same area of an object in front of it."""
EQUAL = 1e-3
"""Areas that differ by less than this share of a cell's face count as equal; the smaller class id
then wins, independently of rounding."""
NEAR = 1e-9
"""A corner within this distance of a cell border does not cross it, cells."""


@dataclasses.dataclass(frozen=True, eq=False)
class FilledCells:
    """The cells that surfaces pass through, each once.

    Attributes:
        cell_N3: int64 indices of the cells in the lattice, any sign.
        class_N: class ids.
        weight_N: weights of the classes: their area, in faces of a cell.
    """

    cell_N3: np.ndarray
    class_N: np.ndarray
    weight_N: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Lattice:
    """The class ids of the cells in a box of the world.

    Attributes:
        classes_XYZ: class ids, 0 in empty cells.
        weight_XYZ: float32 weights of the classes.
        first_3: index of the lowest cell along each axis.
        cell_m: side of a cell, metres.
        point_3: the lowest corner of cell (0, 0, 0), metres.
    """

    classes_XYZ: np.ndarray
    weight_XYZ: np.ndarray
    first_3: np.ndarray
    cell_m: float
    point_3: np.ndarray


def fill(config: VoxelsConfig, scene: Scene, point_3: np.ndarray) -> FilledCells:
    """Return the cells that the surfaces of a scene pass through.

    The scene may be moving parts at one moment; ``point_3`` is the lowest corner of the lattice's
    cell (0, 0, 0), metres.
    """
    kind_O = np.array([KINDS.index(kind_of(name)) for name in scene.objects])
    kind_F = kind_O[scene.object_F]
    back_F = np.where(kind_F == KINDS.index("wall"), -1, 1) * min(BEHIND_M, config.cell / 4)
    back = back_F[:, None, None] * scene.normals_F3[:, None]
    piece_N33, face_N = split_at_borders(
        (scene.vertices_V3[scene.faces_F3] - back - point_3) / config.cell
    )
    sides = piece_N33[:, 1:] - piece_N33[:, :1]
    area_N = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=-1) / 2
    class_F = class_ids(config, kind_F, scene.albedo_F3)
    shell_F = np.isin(kind_F, [KINDS.index(kind) for kind in SHELL])
    weight_N = area_N * np.where(shell_F, SHELL_WEIGHT, 1.0)[face_N]
    return _heaviest(np.floor(piece_N33.mean(1)).astype(np.int64), class_F[face_N], weight_N)


def lattice_of(config: VoxelsConfig, filled: FilledCells, point_3: np.ndarray) -> Lattice:
    """Return filled cells as a box that contains them all."""
    first = filled.cell_N3.min(0)
    shape = tuple(filled.cell_N3.max(0) - first + 1)
    classes, weight = np.zeros(shape, config.dtype), np.zeros(shape, np.float32)
    where = tuple((filled.cell_N3 - first).T)
    classes[where], weight[where] = filled.class_N, filled.weight_N
    return Lattice(classes, weight, first, config.cell, np.asarray(point_3, np.float64))


def crop_grids(
    lattice: Lattice, side: int, centre_T3: np.ndarray, moving: list[FilledCells] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Crop the grids around positions (T, 3), metres, from a lattice.

    If ``side``, the number of cells along each axis, is odd, a position lies in the middle cell of
    its grid; if it is even, within half a cell of the grid's middle. The moving cells of each frame
    replace static cells of lower weight.

    Returns:
        ``(classes_TXYZ, origin_T3)``: (T, n, n, n) class ids, and (T, 3) float64 lowest corners,
        metres.
    """
    at = (np.asarray(centre_T3, np.float64) - lattice.point_3) / lattice.cell_m
    low_T3 = np.floor(at - (side - 1) / 2).astype(np.int64)
    grids = np.zeros((len(low_T3), side, side, side), lattice.classes_XYZ.dtype)
    for t, low in enumerate(low_T3):
        _copy(lattice.classes_XYZ, lattice.first_3 - low, grids[t])
        if moving is not None:
            _overlay(grids[t], low, moving[t], lattice)
    return grids, lattice.point_3 + low_T3 * lattice.cell_m


def split_at_borders(corners_F33: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut triangles (F, 3, 3), in cells, at whole numbers along each axis.

    Returns:
        ``(piece_N33, face_N)``: triangles that each lie within one cell, and the index of the
        triangle that each is part of.
    """
    pieces, faces = np.asarray(corners_F33, np.float64), np.arange(len(corners_F33))
    for axis in range(3):
        done, done_faces = [], []
        while len(pieces):
            low = np.floor(pieces[:, :, axis].min(1) + NEAR)
            high = np.ceil(pieces[:, :, axis].max(1) - NEAR)
            over = high - low > 1
            done.append(pieces[~over])
            done_faces.append(faces[~over])
            plane = np.floor((low + high)[over] / 2)
            pieces, which = _halve(pieces[over], axis, plane)
            faces = faces[over][which]
        pieces, faces = np.concatenate(done), np.concatenate(done_faces)
    return pieces, faces


def _halve(
    corners_F33: np.ndarray, axis: int, plane_F: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Cut each triangle into three at a plane between its corners; return their triangle too."""
    order = corners_F33[:, :, axis].argsort(1)
    low, mid, high = np.take_along_axis(corners_F33, order[:, :, None], 1).swapaxes(0, 1)

    def meet(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the intersection of the side from a to b with the plane."""
        length = b[:, axis] - a[:, axis]
        share = (plane_F - a[:, axis]) / np.where(length == 0, 1, length)
        point = a + np.clip(share, 0, 1)[:, None] * (b - a)
        point[:, axis] = plane_F
        return point

    across = meet(low, high)
    below = (mid[:, axis] <= plane_F)[:, None]  # the middle corner lies below the plane
    alone, pair = np.where(below, high, low), np.where(below, low, high)
    other = np.where(below, meet(mid, high), meet(low, mid))
    pieces = [(alone, other, across), (pair, mid, across), (mid, other, across)]
    found = np.concatenate([np.stack(piece, 1) for piece in pieces])
    return found, np.tile(np.arange(len(corners_F33)), 3)


def _heaviest(cell_N3: np.ndarray, class_N: np.ndarray, weight_N: np.ndarray) -> FilledCells:
    """Sum the weights of each class in each cell, and keep the class with the largest sum."""
    kept = weight_N > 0
    cell_N3, class_N, weight_N = cell_N3[kept], class_N[kept], weight_N[kept]
    if not len(cell_N3):
        return FilledCells(cell_N3, class_N, weight_N)
    first = cell_N3.min(0)
    shape = tuple(cell_N3.max(0) - first + 1)
    classes = 1 + int(class_N.max())
    number_N = np.ravel_multi_index(tuple((cell_N3 - first).T), shape)
    key, inverse = np.unique(number_N * classes + class_N, return_inverse=True)
    counted = np.round(np.bincount(inverse, weight_N) / EQUAL) * EQUAL
    number, name = np.divmod(key, classes)
    order = np.lexsort((-name, counted, number))  # the heaviest last; among equals the smaller id
    chosen = order[np.append(np.flatnonzero(np.diff(number[order])), len(order) - 1)]
    cell = np.stack(np.unravel_index(number[chosen], shape), -1) + first
    return FilledCells(cell, name[chosen], counted[chosen])


def merge_cells(parts: Sequence[FilledCells]) -> FilledCells:
    """Return the cells that any of the parts fill, each with its heaviest class."""
    fields = ("cell_N3", "class_N", "weight_N")
    return _heaviest(*(np.concatenate([getattr(p, name) for p in parts]) for name in fields))


def _overlay(grid_XYZ: np.ndarray, low_3: np.ndarray, moving: FilledCells, still: Lattice) -> None:
    """Fill the cells of a grid in which a moving class has a larger weight than the static one."""
    here_N3 = moving.cell_N3 - low_3
    inside = ((here_N3 >= 0) & (here_N3 < grid_XYZ.shape)).all(-1)
    there_N3 = moving.cell_N3 - still.first_3
    known = np.all((there_N3 >= 0) & (there_N3 < still.weight_XYZ.shape), axis=-1)
    where = np.where(known[:, None], there_N3, 0)
    before = np.where(known, still.weight_XYZ[tuple(where.T)], 0)
    won = inside & (moving.weight_N > before)
    grid_XYZ[tuple(here_N3[won].T)] = moving.class_N[won]


def _copy(source_XYZ: np.ndarray, at_3: np.ndarray, target_XYZ: np.ndarray) -> None:
    """Copy a box into another, with its lowest cell at an index that may lie outside."""
    take, put = [], []
    for start, size, room in zip(at_3, source_XYZ.shape, target_XYZ.shape, strict=True):
        low, high = max(0, int(start)), min(room, int(start) + size)
        if low >= high:
            return
        put.append(slice(low, high))
        take.append(slice(low - int(start), high - int(start)))
    target_XYZ[tuple(put)] = source_XYZ[tuple(take)]


PART_M = 1.5
"""Largest distance of a part's surface from its own origin, metres."""


def record_voxels(
    config: VoxelsConfig,
    scene: Scene,
    floor_z: float,
    centre_T3: np.ndarray,
    moving: MovingHouse | None = None,
    poses_TP44: np.ndarray | None = None,
) -> VoxelFrames:
    """Return the grids around an agent, whose camera is at (T, 3) metres, at T frames.

    The floor at ``floor_z`` becomes a border of cells. Moving parts have the poses of
    ``MovingHouse.poses``.
    """
    lattice = _lattice(config, scene, floor_z)
    moved: list[FilledCells] | None = None
    if moving is not None and poses_TP44 is not None and len(moving.moves):
        moved = _moved(config, moving, poses_TP44, centre_T3, lattice)
    classes, origin = crop_grids(lattice, config.side, centre_T3, moved)
    return VoxelFrames(classes, origin.astype(np.float32), config.cell, config.names)


@functools.lru_cache(maxsize=1)
def _lattice(config: VoxelsConfig, scene: Scene, floor_z: float) -> Lattice:
    """Return the lattice of a scene; the last one is cached for the scene's next episode."""
    point_3 = np.array([0.0, 0.0, floor_z])
    return lattice_of(config, fill(config, scene, point_3), point_3)


def _moved(
    config: VoxelsConfig,
    moving: MovingHouse,
    poses_TP44: np.ndarray,
    centre_T3: np.ndarray,
    lattice: Lattice,
) -> list[FilledCells]:
    """Return the cells of the moving parts at each frame; each pose of a part is voxelised once."""
    known: dict[tuple[int, bytes], FilledCells] = {}
    reach = (config.side / 2 + 1) * config.cell + PART_M
    nothing = FilledCells(np.zeros((0, 3), np.int64), np.zeros(0, np.int64), np.zeros(0))
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
        frames.append(merge_cells(parts))
    return frames
