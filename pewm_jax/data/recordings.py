"""Read recordings in the layouts of Open3D and TUM: the files and the camera pose of each frame.

Two layouts are read. Open3D's: a folder of colour images, a folder of depth images and a ``.log``
trajectory (a line of three integers, then a 4×4 camera-to-world matrix, per frame). Its images
are sorted in natural order (2.png before 10.png), and frames are matched by their position. TUM's:
``rgb.txt``, ``depth.txt`` and ``groundtruth.txt`` whose lines begin with a time stamp.

A folder ``voxels/`` beside the images may hold grids of class ids: for the colour image
``00012.png`` the file ``00012.npz`` with

* ``classes``: (n, n, n) integers, class ids along the recording's own x, y and z axes, 0 = empty;
* ``origin``: (3,) position of the lowest corner of the grid in the recording's own world, metres;
* ``cell``: side of a cell, metres;

and ``classes.json``, a list of the names of the classes, the name of empty cells first.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pewm_jax.config import UserError
from pewm_jax.data.voxels import SIDE_LIMIT, VoxelFrames
from pewm_jax.io.progress import Meter
from pewm_jax.io.store import DAMAGED

COLOUR_FOLDERS = ("image", "color", "colour", "rgb")
DEPTH_FOLDERS = ("depth",)
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".pgm", ".ppm", ".bmp")
TUM_TOLERANCE_S = 0.02
"""Largest difference in time between the images and the pose of one frame, seconds."""


@dataclasses.dataclass(frozen=True)
class RecordedFrame:
    """One frame: paths of its images, and its float64 pose (4, 4) in the recording's own world."""

    colour: Path
    depth: Path
    world_from_camera: np.ndarray


def read_recording(folder: Path, trajectory: Path | None = None) -> list[RecordedFrame]:
    """Return the frames of a recording, in order.

    Args:
        folder: the recording.
        trajectory: its trajectory, by default ``groundtruth.txt`` or the only ``.log`` file in it;
            a file that ends in ``.log`` is read as Open3D's, any other as TUM's.

    Raises:
        UserError: files are missing or do not parse, or counts do not match.
    """
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder; give the folder of a recording.")
    path = _find_trajectory(folder, trajectory)
    frames = _read_log_folder(folder, path) if path.suffix == ".log" else _read_tum(folder, path)
    if not frames:
        raise UserError(f"{folder} has no frames: {path.name} matches no images.")
    return frames


def _find_trajectory(folder: Path, trajectory: Path | None) -> Path:
    if trajectory is not None:
        for path in (folder / trajectory, trajectory):
            if path.is_file():
                return path
        raise UserError(
            f"--trajectory {trajectory} exists neither in {folder} nor in the current folder."
        )
    if (folder / "groundtruth.txt").is_file():
        return folder / "groundtruth.txt"
    logs = sorted(folder.glob("*.log"))
    if len(logs) != 1:
        found = ", ".join(path.name for path in logs) or "none"
        raise UserError(
            f"{folder} needs one trajectory, groundtruth.txt or a .log file (found: {found}); "
            "name it with --trajectory."
        )
    return logs[0]


def _read_log_folder(folder: Path, trajectory: Path) -> list[RecordedFrame]:
    colours = _images(folder, COLOUR_FOLDERS, "colour")
    depths = _images(folder, DEPTH_FOLDERS, "depth")
    poses = read_log(trajectory)
    if not len(colours) == len(depths) == len(poses):
        raise UserError(
            f"{folder} has {len(colours)} colour images, {len(depths)} depth images and "
            f"{len(poses)} poses in {trajectory.name}: the counts must match, one per frame."
        )
    _require_same_numbers(folder, colours, depths)
    return [RecordedFrame(*frame) for frame in zip(colours, depths, poses, strict=True)]


def natural_key(path: Path) -> tuple[tuple[tuple[int, int | str], ...], str]:
    """Return a sort key for natural order: 2.png before 10.png."""
    parts = re.split(r"([0-9]+)", path.name)
    return tuple((0, int(p)) if p.isdecimal() else (1, p) for p in parts if p), path.name


def _require_same_numbers(folder: Path, colours: list[Path], depths: list[Path]) -> None:
    """Raise UserError if numbered colour and depth images have different numbers.

    The first or the last number in a name may count the frames (the other can be a time stamp).
    Two series that begin with different numbers, or count in different steps, are matched by
    position.
    """
    differing = None
    for place in (0, -1):
        one, other = (_numbers(files, place) for files in (colours, depths))
        if one is None or other is None:
            continue
        if set(one) == set(other) or (_is_series(one) and _is_series(other)):
            return
        differing = differing or (one, other)
    if differing is None:
        return
    one, other = differing
    number = min(set(one) ^ set(other))
    has, lacks = ("colour", "depth") if number in one else ("depth", "colour")
    raise UserError(
        f"{folder} has a {has} image {number} and no {lacks} image {number}: give the images of a "
        "frame the same number, and remove frames that are not complete."
    )


def _numbers(files: list[Path], place: int) -> list[int] | None:
    """Return the first (0) or last (−1) number of each name.

    None if one has none or two share one.
    """
    found = [re.findall(r"[0-9]+", path.stem) for path in files]
    numbers = [int(each[place]) for each in found if each]
    return numbers if len(set(numbers)) == len(files) else None


def _is_series(numbers: list[int]) -> bool:
    """Return whether numbers are evenly spaced."""
    return len(set(np.diff(numbers).tolist())) <= 1


def _images(folder: Path, names: tuple[str, ...], what: str) -> list[Path]:
    for name in names:
        if (folder / name).is_dir():
            files = (folder / name).iterdir()
            images = (path for path in files if path.suffix.lower() in SUFFIXES)
            return sorted(images, key=natural_key)
    raise UserError(f"{folder} has no folder of {what} images; it must be named {names[0]}/.")


def read_log(path: Path) -> np.ndarray:
    """Read an Open3D ``.log`` trajectory as (T, 4, 4) poses; UserError names a bad line."""
    lines = [(i, line.split()) for i, line in enumerate(_lines(path), 1) if line.strip()]
    if len(lines) % 5:
        raise UserError(
            f"{path} has {len(lines)} lines, a .log trajectory has 5 per frame (three integers, "
            "then four rows of a matrix); the file is truncated or has another format."
        )
    poses = np.empty((len(lines) // 5, 4, 4))
    for k, (number, fields) in enumerate(lines):
        if k % 5:
            poses[k // 5, k % 5 - 1] = _floats(path, number, fields, 4)
    return poses


def _read_tum(folder: Path, trajectory: Path) -> list[RecordedFrame]:
    colours, depths = (_listed(folder / name) for name in ("rgb.txt", "depth.txt"))
    poses = _stamped_lines(trajectory)
    depth_times, pose_times = (np.array([row[1] for row in rows]) for rows in (depths, poses))
    frames = []
    for _, stamp, (name, *_) in colours:
        depth, pose = _nearest(depth_times, stamp), _nearest(pose_times, stamp)
        if depth is not None and pose is not None:
            number, _, fields = poses[pose]
            matrix = _from_quaternion(trajectory, number, fields)
            frames.append(RecordedFrame(folder / name, folder / depths[depth][2][0], matrix))
    if not frames:
        raise UserError(
            f"{folder}: no colour image of rgb.txt has a depth image and a pose within "
            f"{TUM_TOLERANCE_S} s; check the time stamps."
        )
    return frames


def _nearest(times: np.ndarray, stamp: float) -> int | None:
    if not len(times):
        return None
    index = int(np.argmin(np.abs(times - stamp)))
    return index if abs(times[index] - stamp) <= TUM_TOLERANCE_S else None


def _listed(path: Path) -> list[tuple[int, float, list[str]]]:
    """Return the lines of a list of images: number, time stamp, and name first of the rest."""
    if not path.is_file():
        raise UserError(f"{path} does not exist; a TUM recording lists its images there.")
    rows = _stamped_lines(path)
    for number, _, fields in rows:
        if not fields:
            raise UserError(f"{path}, line {number}: a time stamp without a file name.")
    return rows


def _stamped_lines(path: Path) -> list[tuple[int, float, list[str]]]:
    rows = []
    for number, line in enumerate(_lines(path), 1):
        fields = line.split()
        if fields and not fields[0].startswith("#"):
            rows.append((number, float(_floats(path, number, fields[:1], 1)[0]), fields[1:]))
    return rows


def _from_quaternion(path: Path, number: int, fields: list[str]) -> np.ndarray:
    values = _floats(path, number, fields, 7)
    if not np.isfinite(values).any():  # a lost pose
        return np.full((4, 4), np.nan)
    norm = float(np.linalg.norm(values[3:]))
    if not abs(norm - 1) < 1e-2:
        raise UserError(f"{path}, line {number}: the quaternion has length {norm:.3g}, not 1.")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
    pose[:3, 3] = values[:3]
    return pose


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path} cannot be read as text ({error}).") from None


def _floats(path: Path, line: int, fields: list[str], count: int) -> np.ndarray:
    try:
        values = np.array([float(field) for field in fields])
    except ValueError:
        values = np.empty(0)
    if len(values) != count:
        raise UserError(
            f"{path}, line {line}: expected {count} numbers, found {' '.join(fields)!r}."
        )
    return values


FOLDER, TABLE = "voxels", "classes.json"
FIELDS = ("classes", "origin", "cell")


def read_voxels(
    recording: Path, colours: Sequence[Path], world_from_recording: np.ndarray
) -> VoxelFrames | None:
    """Read the grids of a recording's frames, given their colour images, rotated with its world.

    ``world_from_recording`` is a (4, 4) rotation by right angles from the recording's axes to ours.
    None if there is no folder ``voxels/``.

    Raises:
        UserError: a frame's file is missing or cannot be read, the grids have different sides or
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
                    f"{path} is missing: every colour image needs a grid of the same name, here "
                    f"{colour.name}."
                )
            classes, origin, here = _read(path)
            if first is None:
                first, cell = path, here
            if classes.shape[0] != len(grids[0] if grids else classes) or here != cell:
                raise UserError(
                    f"{path} has {classes.shape[0]}³ cells of {here:g} m, {first.name} has "
                    f"{len(grids[0])}³ of {cell:g} m: all grids must have the same size."
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
    """Rotate a grid (n, n, n) about the world's origin by right angles.

    ``origin_3`` is its lowest corner, ``cell_m`` the side of a cell, metres; the rotation is a
    signed permutation of the axes, from the old to the new. Return the cells along the new axes,
    and the grid's lowest corner.
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
            f"{path} is missing: write the names of the classes there, as a JSON list whose first "
            "entry is the name of empty cells."
        )
    try:
        names = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{path} does not parse as JSON ({error}).") from None
    fits = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not fits or not 2 <= len(names) <= 1 << 16:
        raise UserError(
            f"{path} must hold a JSON list of 2 to {1 << 16} names, that of empty cells first."
        )
    return tuple(names)


def _read(path: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the classes, the origin and the cell of one file."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            classes, origin, cell = (np.asarray(file[field]) for field in FIELDS)
    except (OSError, *DAMAGED) as error:
        raise UserError(
            f"{path} cannot be read as a grid ({' '.join(str(error).split())[:120]}): write the "
            f"arrays {', '.join(FIELDS)} with numpy.savez_compressed."
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
