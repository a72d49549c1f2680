"""Voxel grids around the agent: their classes, their arrays and bytes, and their checks.

A class is a kind of object in one of a few named colours: the renderer of a voxel world knows only
the class of a cell, so a wall of another colour has another class. Class 0 is empty.

A grid is a cube of cells, aligned with the world (it does not turn with the agent). The corners of
the grids of one episode are whole cells apart. In a record a grid is its cells, x slowest,
little-endian, deflated (zlib), so that a frame can be read without the others.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
from scipy import ndimage

from pewm_jax.config import ConfigError, UserError
from pewm_jax.data.record_format import DamagedError
from pewm_jax.houses.kinds import GROUPS, KINDS
from pewm_jax.types import Camera

EMPTY = "empty"
PALETTE = {
    "white": (235, 233, 228),
    "brown": (140, 95, 60),
    "red": (200, 75, 75),
    "green": (95, 165, 95),
    "blue": (75, 110, 190),
    "black": (45, 45, 48),
    "beige": (225, 200, 165),
    "grey": (150, 150, 150),
    "yellow": (225, 195, 90),
    "pink": (225, 165, 190),
    "mint": (165, 215, 180),
    "sky": (165, 195, 230),
    "purple": (130, 85, 165),
    "orange": (225, 140, 70),
    "teal": (70, 150, 155),
    "lilac": (195, 175, 225),
    "lime": (190, 210, 120),
    "wine": (115, 45, 65),
    "navy": (45, 60, 115),
    "olive": (110, 110, 55),
    "pine": (45, 95, 70),
    "tan": (185, 150, 115),
    "magenta": (195, 80, 165),
    "aqua": (120, 205, 210),
}
"""Named colours and their RGB values; the first ones distinguish most objects."""
SIDE_LIMIT = 256


@dataclasses.dataclass(frozen=True)
class VoxelsConfig:
    """Grids of class ids around the agent."""

    record: bool = False
    """Record a grid with every frame; `--voxels` alone is a short form."""
    cell: float = 0.2
    """Side of a cell, metres. Up to 0.16 the two sides of a wall, which may have different colours,
    never share a cell."""
    side: int = 48
    """Cells of the grid along each axis; the agent's camera is in the middle."""
    kinds: Literal["all", "groups"] = "all"
    """Kinds of objects: `all` (every kind of furniture), or `groups` (all furniture is one
    kind)."""
    colours: int = 16
    """Colours of each kind, 1 (colours are ignored) to 24."""
    pictures: Literal["surfaces", "cells"] = "surfaces"
    """Content of the images: the `surfaces` of the house, or the recorded `cells` as blocks in the
    colours of their classes."""

    def __post_init__(self):
        """Validate."""
        if not 0.01 <= self.cell <= 10:
            raise ConfigError(f"--voxels.cell is {self.cell}: use 0.01 to 10 metres.")
        if not 2 <= self.side <= SIDE_LIMIT:
            raise ConfigError(f"--voxels.side is {self.side}: use 2 to {SIDE_LIMIT} cells.")
        if not 1 <= self.colours <= len(PALETTE):
            raise ConfigError(f"--voxels.colours is {self.colours}: use 1 to {len(PALETTE)}.")

    @property
    def names(self) -> tuple[str, ...]:
        """The table of classes: name of each id, ``sofa/red``, or ``sofa`` with one colour."""
        if self.colours == 1:
            return (EMPTY, *self.kind_names)
        colours = list(PALETTE)[: self.colours]
        return (EMPTY, *(f"{kind}/{colour}" for kind in self.kind_names for colour in colours))

    @property
    def kind_names(self) -> tuple[str, ...]:
        """The kinds, or their groups, in the order of the table."""
        if self.kinds == "all":
            return KINDS
        return tuple(dict.fromkeys(GROUPS[kind] for kind in KINDS))

    @property
    def dtype(self) -> np.dtype:
        """The smallest of uint8 and uint16 that holds all ids."""
        return np.dtype("<u1" if len(self.names) <= 256 else "<u2")


def class_ids(config: VoxelsConfig, kind_N: np.ndarray, rgb_N3: np.ndarray) -> np.ndarray:
    """Return (N,) class ids of surfaces.

    The kinds are indices into ``KINDS``, the colours are without light, in [0, 1].
    """
    row = config.kind_names.index
    of_kind = [row(kind if config.kinds == "all" else GROUPS[kind]) for kind in KINDS]
    palette = _opponent(np.array(list(PALETTE.values())[: config.colours]) / 255)
    apart = np.linalg.norm(_opponent(np.asarray(rgb_N3))[:, None] - palette, axis=-1)
    return 1 + np.array(of_kind)[kind_N] * config.colours + apart.argmin(-1)


def table_colours(names: tuple[str, ...]) -> np.ndarray:
    """Return (classes, 3) uint8 colours for drawing classes.

    A class whose name ends in a colour of the palette has that colour; the colours of other classes
    follow from their position in the table.
    """
    found = np.zeros((len(names), 3), np.uint8)
    for k, name in enumerate(names[1:], 1):
        named = PALETTE.get(name.rpartition("/")[2])
        spread = 0.5 + 0.45 * np.cos(2 * np.pi * (k * 0.618034 + np.array([0, 1 / 3, 2 / 3])))
        found[k] = np.round(255 * spread) if named is None else named
    return found


def _opponent(rgb_N3: np.ndarray) -> np.ndarray:
    """Return colours as lightness, red − green and blue − yellow, with more weight on hue."""
    red, green, blue = np.moveaxis(rgb_N3, -1, 0)
    light = (red + green + blue) / 3
    return np.stack([0.6 * light, red - green, (red + green) / 2 - blue], -1)


LEVEL = 6
DTYPES = ("|u1", "<u2")


@dataclasses.dataclass(frozen=True)
class VoxelGrid:
    """The properties that the grids of an episode share.

    Attributes:
        cell_m: side of a cell, metres.
        side: n, cells along each axis.
        names: the table of classes; class k is ``names[k]``, and class 0 is empty.
        dtype: of the class ids, "|u1" or "<u2".
    """

    cell_m: float
    side: int
    names: tuple[str, ...]
    dtype: str = "<u2"


@dataclasses.dataclass(frozen=True, eq=False)
class VoxelFrames:
    """The grids of T frames.

    Attributes:
        classes_TXYZ: (T, n, n, n) uint8 or uint16 class ids, 0 where nothing is.
        origin_T3: float32 world position of each grid's lowest corner, metres.
        cell_m: side of a cell, metres.
        names: the table of classes.
    """

    classes_TXYZ: np.ndarray
    origin_T3: np.ndarray
    cell_m: float
    names: tuple[str, ...]

    @property
    def grid(self) -> VoxelGrid:
        """The properties that the frames share."""
        dtype = self.classes_TXYZ.dtype.newbyteorder("<").str
        return VoxelGrid(float(self.cell_m), self.classes_TXYZ.shape[-1], tuple(self.names), dtype)


def encode(classes_XYZ: np.ndarray) -> bytes:
    """Return the bytes of a grid."""
    little = np.ascontiguousarray(classes_XYZ, classes_XYZ.dtype.newbyteorder("<"))
    return zlib.compress(little.tobytes(), LEVEL)


def decode(code: bytes | memoryview, grid: VoxelGrid, where: str) -> np.ndarray:
    """Return a grid (n, n, n) from its bytes.

    Raises:
        DamagedError: they do not decode to a grid of this side, or a class is not in the table.
    """
    shape, dtype = (grid.side,) * 3, np.dtype(grid.dtype)
    size = grid.side**3 * dtype.itemsize
    inflate = zlib.decompressobj()
    try:
        content = inflate.decompress(code, size + 1)
    except zlib.error:
        content = b""
    if len(content) != size or not inflate.eof:
        raise DamagedError(
            f"{where}, voxels: the grid does not decode to {grid.side}³ cells; the record is "
            "damaged, collect or import it again."
        )
    classes = np.frombuffer(content, dtype).reshape(shape)
    if int(classes.max()) >= len(grid.names):
        raise DamagedError(
            f"{where}, voxels: class {int(classes.max())} is not in the table of "
            f"{len(grid.names)} classes; the record is damaged, collect or import it again."
        )
    return classes


def header_of(voxels: VoxelFrames) -> dict[str, Any]:
    """Return the entries of a record's header that describe the grids, without their offsets."""
    grid = voxels.grid
    return {
        "codec": "zlib",
        "dtype": grid.dtype,
        "side": grid.side,
        "cell_m": grid.cell_m,
        "classes": list(grid.names),
    }


def grid_in(stream: dict[str, Any], where: str) -> VoxelGrid:
    """Return the grid that the header of a record describes; DamagedError if it is inconsistent."""
    try:
        cell, side, dtype = float(stream["cell_m"]), int(stream["side"]), str(stream["dtype"])
        names = tuple(map(str, stream["classes"]))
        sound = cell > 0 and 1 <= side <= SIDE_LIMIT and dtype in DTYPES and len(names) > 1
        sound = sound and stream["codec"] == "zlib"
    except (KeyError, TypeError, ValueError):
        sound = False
    if not sound:
        raise DamagedError(
            f"{where}: the header's entries of the voxels are inconsistent; the record is damaged, "
            "collect or import it again."
        )
    return VoxelGrid(cell, side, names, dtype)


def require_alike(first: VoxelGrid, other: VoxelGrid, where: str) -> None:
    """Raise UserError if grids differ in cell, side or classes from others of the same data."""
    if (other.side, other.dtype) != (first.side, first.dtype) or not np.isclose(
        other.cell_m, first.cell_m
    ):
        raise UserError(
            f"{where} has grids of {other.side}³ cells of {other.cell_m:g} m ({other.dtype}), the "
            f"others have {first.side}³ of {first.cell_m:g} m ({first.dtype}): record all with the "
            "same grid."
        )
    if other.names != first.names:
        k = next(
            (k for k, (a, b) in enumerate(zip(first.names, other.names, strict=False)) if a != b),
            min(len(first.names), len(other.names)),
        )
        raise UserError(
            f"{where} has another table of classes than the others ({len(other.names)} names and "
            f"{len(first.names)}, which differ from class {k} on): record all with the same table."
        )


OFF_CELLS = 1e-3
"""Largest distance of a grid's corner from the lattice of the first frame, cells."""
MOST_FLOATING = 0.1
"""Largest allowed share of the points seen in a grid that have only empty cells around them, over
``LOOKS`` frames; correct data has almost none."""
LOOKS, STEP = 8, 3
"""Frames checked, and the stride of their rows and columns."""


def check_voxels(voxels: VoxelFrames, frames: int, where: str) -> None:
    """Check grids before they are written; ``frames`` is their expected number.

    Raises:
        UserError: the number of grids is wrong, a grid is not a cube, a class is not in the table,
            or corners are not whole cells apart.
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
            f"classes: use 1 to {SIDE_LIMIT} cells above 0 m, and name 2 or more classes."
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
    """Yield the frames whose corners are not whole cells from the first frame's, and the offset."""
    cells = (np.asarray(origin_T3, np.float64) - origin_T3[0]) / cell_m
    off = np.abs(cells - np.round(cells)).max(-1)
    # Positions are stored in single precision, which is coarser far from the world's origin.
    allowed = OFF_CELLS + 4 * np.spacing(np.abs(origin_T3).max().astype(np.float32)) / cell_m
    for frame in np.flatnonzero(off > allowed):
        yield int(frame), float(off[frame])


def outside(origin_T3: np.ndarray, grid: VoxelGrid, place_T3: np.ndarray) -> list[int]:
    """Return the frames in which a position (T, 3) does not lie in the grid."""
    at = (np.asarray(place_T3, np.float64) - origin_T3) / (grid.cell_m * grid.side)
    return np.flatnonzero(((at < 0) | (at > 1)).any(-1)).tolist()


def measured_points(
    depth_HW: np.ndarray, intrinsics_4: np.ndarray, world_from_camera: np.ndarray, step: int = 1
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return the world points (N, 3) of measured pixels, and their rows and columns.

    In float64 on the host; of the rows and of the columns every ``step``-th is used.
    """
    v, u = np.mgrid[0 : depth_HW.shape[0] : step, 0 : depth_HW.shape[1] : step]
    seen = depth_HW[v, u] > 0
    u, v = u[seen], v[seen]
    z = depth_HW[v, u].astype(np.float64)
    fx, fy, cx, cy = np.asarray(intrinsics_4, np.float64)
    pose = np.asarray(world_from_camera, np.float64)
    points = np.stack([(u + 0.5 - cx) / fx * z, (v + 0.5 - cy) / fy * z, z], -1)
    return points @ pose[:3, :3].T + pose[:3, 3], (v, u)


def disagreement(
    voxels: VoxelFrames, depth_THW: np.ndarray, camera: Camera
) -> tuple[int, float] | None:
    """Return the frame that disagrees most with its grid, and the share of floating points.

    A point that the camera sees in the grid, by the depths (T, H, W) in metres, floats if its cell
    and the cells around it are empty. None if at most ``MOST_FLOATING`` of the points of all frames
    float.
    """
    lost, seen = np.zeros(len(depth_THW)), np.zeros(len(depth_THW))
    for t, depth_HW in enumerate(depth_THW):
        pose = camera.world_from_camera[t]
        points, _ = measured_points(depth_HW, camera.intrinsics_4[t], pose, STEP)
        grid = voxels.classes_TXYZ[t]
        near = np.asarray(ndimage.binary_dilation(grid > 0, np.ones((3, 3, 3))))
        cell = np.floor((points - voxels.origin_T3[t]) / voxels.cell_m).astype(int)
        cell = cell[((cell >= 0) & (cell < grid.shape)).all(-1)]
        lost[t], seen[t] = (near[tuple(cell.T)] == 0).sum(), len(cell)
    share = float(lost.sum() / max(1, seen.sum()))
    if share <= MOST_FLOATING:
        return None
    return int((lost / np.maximum(seen, 1)).argmax()), share
