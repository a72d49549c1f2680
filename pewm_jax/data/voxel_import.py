"""Voxels of others' recordings: one ``.npz`` per frame beside the images.

``voxels/`` lies in the recording's folder and holds, for the colour image ``00012.png``, the file
``00012.npz`` with

* ``classes``: (n, n, n) integers, class ids along the recording's own x, y and z axes, 0 = empty;
* ``origin``: (3,) position of the lowest corner of the grid in the recording's own world, metres;
* ``cell``: side of a cell, metres;

and ``classes.json``, a list of the names of the classes, the first one that of empty cells.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.data.progress import Meter
from pewm_jax.data.voxel_classes import SIDE_LIMIT
from pewm_jax.data.voxel_frames import VoxelFrames

FOLDER, TABLE = "voxels", "classes.json"
FIELDS = ("classes", "origin", "cell")
_UNREADABLE = (EOFError, KeyError, OSError, ValueError, zipfile.BadZipFile, zlib.error)
"""What NumPy raises on files that are no ``.npz``, are cut short, or hold pickled objects."""


def read_voxels(
    recording: Path, colours: Sequence[Path], world_from_recording: np.ndarray
) -> VoxelFrames | None:
    """Read the grids of a recording's frames, turned with its world.

    Args:
        recording: the folder.
        colours: the colour images of the frames.
        world_from_recording: (4, 4) rotation by right angles from the recording's axes to ours.

    Returns:
        The grids, or None where there is no folder ``voxels/``.

    Raises:
        UserError: a frame's file is missing or does not read, grids are of different sides or
            cells, or a class is not in the table.
    """
    folder = recording / FOLDER
    if not folder.is_dir():
        return None
    names = _table(folder / TABLE)
    grids, origins, cell, first = [], [], 0.0, None
    with Meter(f"reading {folder}", len(colours), "frames") as meter:
        for colour in colours:
            path = folder / f"{colour.stem}.npz"
            if not path.is_file():
                raise UserError(
                    f"{path} is missing: every colour image needs a grid of its name, here for "
                    f"{colour.name}."
                )
            classes, origin, here = _read(path)
            if first is None:
                first, cell = path, here
            if classes.shape[0] != len(grids[0] if grids else classes) or here != cell:
                raise UserError(
                    f"{path} has {classes.shape[0]}³ cells of {here:g} m, {first.name} has "
                    f"{len(grids[0])}³ of {cell:g} m: all grids must be alike."
                )
            if int(classes.max()) >= len(names) or int(classes.min()) < 0:
                wrong = int(classes.min() if classes.min() < 0 else classes.max())
                raise UserError(
                    f"{path}: class {wrong} is not in {TABLE}, which names the classes 0 to "
                    f"{len(names) - 1}: name it there."
                )
            classes, origin = turned(classes, origin, cell, world_from_recording[:3, :3])
            grids.append(classes.astype("<u1" if len(names) <= 256 else "<u2"))
            origins.append(origin)
            meter.advance(1)
    return VoxelFrames(np.stack(grids), np.stack(origins).astype(np.float32), cell, names)


def turned(
    classes_XYZ: np.ndarray, origin_3: np.ndarray, cell_m: float, rotation_33: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Turn a grid about the world's origin by right angles.

    Args:
        classes_XYZ: (n, n, n) the cells.
        origin_3: their lowest corner, metres.
        cell_m: side of a cell, metres.
        rotation_33: a signed permutation of the axes, from the old to the new.

    Returns:
        The cells along the new axes, and their lowest corner.
    """
    exact = np.rint(rotation_33).astype(int)
    order = np.abs(exact).argmax(1)  # new axis k is old axis order[k]
    sign = exact[np.arange(3), order]
    backward = tuple(axis for axis in range(3) if sign[axis] < 0)
    cells = np.flip(classes_XYZ.transpose(order), backward)
    ends = np.stack([origin_3, origin_3 + cell_m * len(classes_XYZ)])[:, order] * sign
    return cells, ends.min(0)


def _table(path: Path) -> tuple[str, ...]:
    """Read the names of the classes."""
    if not path.is_file():
        raise UserError(
            f"{path} is missing: give the names of the classes there, as a JSON list whose first "
            "entry is for empty cells."
        )
    try:
        names = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{path} does not parse as JSON ({error}).") from None
    fits = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not fits or not 2 <= len(names) <= 1 << 16:
        raise UserError(
            f"{path} must hold a JSON list of 2 to {1 << 16} names, of empty cells first."
        )
    return tuple(names)


def _read(path: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the classes, the origin and the cell of one file."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            classes, origin, cell = (np.asarray(file[field]) for field in FIELDS)
    except _UNREADABLE as error:
        raise UserError(
            f"{path} does not read as a grid ({' '.join(str(error).split())[:120]}): write it with "
            f"numpy.savez_compressed, with the arrays {', '.join(FIELDS)}."
        ) from None
    cubic = classes.ndim == 3 and len(set(classes.shape)) == 1
    if not cubic or not 1 <= len(classes) <= SIDE_LIMIT or classes.dtype.kind not in "iu":
        raise UserError(
            f"{path}: classes has shape {classes.shape} and dtype {classes.dtype}, expected "
            f"integers (n, n, n) with n from 1 to {SIDE_LIMIT}."
        )
    numbers = origin.dtype.kind in "fiu" and cell.dtype.kind in "fiu"
    if not numbers or origin.shape != (3,) or cell.size != 1 or not np.isfinite(origin).all():
        raise UserError(f"{path}: origin must be 3 numbers and cell one, in metres.")
    if not 0 < float(cell.reshape(())) < np.inf:
        raise UserError(f"{path}: cell is {float(cell.reshape(())):g}: give metres above 0.")
    return classes, origin.astype(np.float64), float(cell.reshape(()))
