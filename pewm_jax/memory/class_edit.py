"""Editing a grid of class ids in world coordinates (metres): place, erase, copy, paste, move.

The calls are those of ``voxel_edit``: a box is (2, 3), its lower and upper corner, and a cell
belongs to it if its centre lies in it; a transform is a rigid 4×4 matrix from old to new positions.
What is erased is empty afterwards, not unknown. All functions are pure and jittable with ``config``
static; ``config`` is the ``GridConfig`` of the grid.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from pewm_jax.config import Memory, UserError
from pewm_jax.data.voxels import VoxelsConfig
from pewm_jax.geometry.cameras import invert_rigid, transform_points
from pewm_jax.memory import boxes
from pewm_jax.types import Array

if TYPE_CHECKING:
    from pewm_jax.memory.class_grid import ClassGrid

UNKNOWN = -1
"""The id of a cell of which nothing is known."""
EMPTY = 0
"""The id of a cell in which nothing is."""


def place(config: Memory, grid: ClassGrid, box_23: Array, number: int | Array) -> ClassGrid:
    """Fill a box with a class.

    Args:
        config: the grid's settings.
        grid: the grid.
        box_23: (2, 3) lower and upper corner in the world, metres.
        number: the class's id; see ``class_grid.number_of``.

    Raises:
        UserError: the box is not a box, or the id is not of the table.
    """
    if not isinstance(number, Tracer):
        given, table = np.asarray(number), VoxelsConfig(kinds=config.kinds, colours=config.colours)  # type: ignore[attr-defined]
        count = len(table.names)
        if np.any((given < EMPTY) | (given >= count)):
            raise UserError(
                f"place() got the class {number}: use an id of the table, 1 to {count - 1}, or 0 "
                "for nothing."
            )
    inside = _within(config, grid, box_23)
    return _with(grid, jnp.where(inside, jnp.asarray(number, jnp.int16), grid.classes_XYZ))


def erase(config: Memory, grid: ClassGrid, box_23: Array) -> ClassGrid:
    """Leave nothing in a box.

    Args:
        config: the grid's settings.
        grid: the grid.
        box_23: (2, 3) lower and upper corner in the world, metres.

    Raises:
        UserError: the box is not a box.
    """
    return place(config, grid, box_23, EMPTY)


def copy(config: Memory, grid: ClassGrid, box_23: Array) -> ClassGrid:
    """Return a grid of what is in a box; elsewhere nothing is known.

    Args:
        config: the grid's settings.
        grid: the grid.
        box_23: (2, 3) lower and upper corner in the world, metres.

    Raises:
        UserError: the box is not a box.
    """
    inside = _within(config, grid, box_23) & (grid.classes_XYZ > EMPTY)
    kept = jnp.where(inside, grid.classes_XYZ, jnp.int16(UNKNOWN))
    return dataclasses.replace(grid, classes_XYZ=kept, history=None)


def paste(
    config: Memory, grid: ClassGrid, piece: ClassGrid, transform: Array | None = None
) -> ClassGrid:
    """Put a piece into a grid; where it has something, that replaces what was there.

    Each cell takes the cell of the piece that its centre comes from (inverse warping), so a rotated
    piece has no holes. Quarter turns and shifts by whole cells are exact.

    Args:
        config: the settings of both.
        grid: the grid.
        piece: from ``copy``, or any grid of the same cell size.
        transform: (4, 4) rigid, metres; None for the identity.

    Raises:
        UserError: the transform is not a rigid 4×4.
    """
    back = invert_rigid(boxes.rigid(transform, "paste"))
    points = centres(config, grid).reshape(-1, 3)
    at = (transform_points(back, points) - piece.low_3) / config.cell_m[0]
    cell_N3 = jnp.floor(at + 1e-4).astype(jnp.int32)
    shape = jnp.asarray(piece.classes_XYZ.shape)
    inside = ((cell_N3 >= 0) & (cell_N3 < shape)).all(-1)
    x, y, z = jnp.where(inside[:, None], cell_N3, 0).T
    found = jnp.where(inside, piece.classes_XYZ[x, y, z], jnp.int16(UNKNOWN))
    found = found.reshape(grid.classes_XYZ.shape)
    return _with(grid, jnp.where(found > EMPTY, found, grid.classes_XYZ))


def move(
    config: Memory,
    grid: ClassGrid,
    box_23: Array,
    transform: Array,
    *,
    leave: bool = False,
) -> ClassGrid:
    """Move what is in a box: copy it, erase it, paste it elsewhere.

    Args:
        config: the grid's settings.
        grid: the grid.
        box_23: (2, 3) lower and upper corner in the world, metres.
        transform: (4, 4) rigid, from old to new positions, metres.
        leave: erase nothing: a copy.

    Raises:
        UserError: the box is not a box, or the transform not a rigid 4×4.
    """
    piece = copy(config, grid, box_23)
    rest = grid if leave else erase(config, grid, box_23)
    return paste(config, rest, piece, transform)


def centres(config: Memory, grid: ClassGrid) -> Array:
    """Return the (X, Y, Z, 3) centres of all cells, metres."""
    places = np.stack(np.meshgrid(*map(np.arange, grid.classes_XYZ.shape), indexing="ij"), -1)
    return grid.low_3 + (places.astype(np.float32) + 0.5) * config.cell_m[0]


def _within(config: Memory, grid: ClassGrid, box_23: Array) -> Array:
    points = centres(config, grid)
    return boxes.within(points, jnp.ones(points.shape[:3], bool), box_23)


def _with(grid: ClassGrid, classes_XYZ: Array) -> ClassGrid:
    return dataclasses.replace(grid, classes_XYZ=classes_XYZ)
