"""Grids of class ids around the agent, one per frame: as arrays, and as bytes in a record.

A grid is a cube of cells aligned with the world (it does not turn with the agent) whose corners are
whole multiples of the cell's side apart from frame to frame. Bytes of a grid are its cells, x
slowest, little-endian, deflated (zlib), so that a frame is read without the others.
"""

from __future__ import annotations

import dataclasses
import zlib
from typing import Any

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.data.record_format import DamagedError
from pewm_jax.data.voxel_classes import SIDE_LIMIT

LEVEL = 6
DTYPES = ("|u1", "<u2")


@dataclasses.dataclass(frozen=True)
class VoxelGrid:
    """What the grids of an episode have in common.

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
        origin_T3: (T, 3) float32 world position of each grid's lowest corner, metres.
        cell_m: side of a cell, metres.
        names: the table of classes.
    """

    classes_TXYZ: np.ndarray
    origin_T3: np.ndarray
    cell_m: float
    names: tuple[str, ...]

    @property
    def grid(self) -> VoxelGrid:
        """What the frames have in common."""
        dtype = self.classes_TXYZ.dtype.newbyteorder("<").str
        return VoxelGrid(float(self.cell_m), self.classes_TXYZ.shape[-1], tuple(self.names), dtype)


def encode(classes_XYZ: np.ndarray) -> bytes:
    """Return the bytes of a grid."""
    little = np.ascontiguousarray(classes_XYZ, classes_XYZ.dtype.newbyteorder("<"))
    return zlib.compress(little.tobytes(), LEVEL)


def decode(code: bytes | memoryview, grid: VoxelGrid, where: str) -> np.ndarray:
    """Return a grid (n, n, n) from its bytes.

    Raises:
        DamagedError: they are not those of a grid of this side, or a class is not in the table.
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
    """Return what a record's header says of the grids, beside where they lie."""
    grid = voxels.grid
    return {
        "codec": "zlib",
        "dtype": grid.dtype,
        "side": grid.side,
        "cell_m": grid.cell_m,
        "classes": list(grid.names),
    }


def grid_in(stream: dict[str, Any], where: str) -> VoxelGrid:
    """Read what a record's header says of the grids.

    Raises:
        DamagedError: it is incomplete, or makes no sense.
    """
    try:
        cell, side, dtype = float(stream["cell_m"]), int(stream["side"]), str(stream["dtype"])
        names = tuple(map(str, stream["classes"]))
        sound = cell > 0 and 1 <= side <= SIDE_LIMIT and dtype in DTYPES and len(names) > 1
        sound = sound and stream["codec"] == "zlib"
    except (KeyError, TypeError, ValueError):
        sound = False
    if not sound:
        raise DamagedError(
            f"{where}: what the header says of the voxels cannot be; the record is damaged, "
            "collect or import it again."
        )
    return VoxelGrid(cell, side, names, dtype)


def require_alike(first: VoxelGrid, other: VoxelGrid, where: str) -> None:
    """Refuse grids that do not go together with others.

    Raises:
        UserError: another cell, side or table.
    """
    if (other.side, other.dtype) != (first.side, first.dtype) or not np.isclose(
        other.cell_m, first.cell_m
    ):
        raise UserError(
            f"{where} has grids of {other.side}³ cells of {other.cell_m:g} m ({other.dtype}), the "
            f"others have {first.side}³ of {first.cell_m:g} m ({first.dtype}): record all with the "
            "same."
        )
    if other.names != first.names:
        k = next(
            (k for k, (a, b) in enumerate(zip(first.names, other.names, strict=False)) if a != b),
            min(len(first.names), len(other.names)),
        )
        raise UserError(
            f"{where} has another table of classes than the others ({len(other.names)} names and "
            f"{len(first.names)}, which differ from class {k} on): record all with the same."
        )
