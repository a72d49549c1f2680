"""Editing a voxel map in world coordinates (metres): erase, copy, paste, move.

The world model imagines what the map shows, so moving a part of the map moves that part of the
world. A box is (2, 3), its lower and upper corner. A cell belongs to a box if its centre lies in
it; lower faces are included, upper ones are not. A transform is a rigid 4×4 matrix from old to new
positions.

All functions are pure and jittable with ``config`` static, and keep a map's capacity.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import jax.numpy as jnp
import numpy as np

from pewm_jax.config import Memory
from pewm_jax.geometry.cameras import invert_rigid, transform_points
from pewm_jax.memory import boxes, cells, voxel_cells, voxel_core
from pewm_jax.types import Array, VoxelMap


def erase(config: Memory, voxels: VoxelMap, box_23: Array) -> VoxelMap:
    """Forget the cells in a box, as if nothing had ever been seen there.

    Args:
        config: cell size, extent, capacity.
        voxels: the map.
        box_23: (2, 3) lower and upper corner in the world, metres.

    Raises:
        UserError: the box is not a box.
    """
    return _only(config, voxels, ~_within(config, voxels, box_23))


def copy(config: Memory, voxels: VoxelMap, box_23: Array) -> VoxelMap:
    """Return a map of only the cells in a box; its counts of dropped and outside are 0.

    Args:
        config: cell size, extent, capacity.
        voxels: the map.
        box_23: (2, 3) lower and upper corner in the world, metres.

    Raises:
        UserError: the box is not a box.
    """
    piece = _only(config, voxels, _within(config, voxels, box_23))
    zero = jnp.zeros((), jnp.int32)
    return dataclasses.replace(piece, dropped=zero, outside=zero)


def paste(
    config: Memory, voxels: VoxelMap, piece: VoxelMap, transform: Array | None = None
) -> VoxelMap:
    """Insert a piece into a map; where both have a cell, take the maximum.

    Each cell of the map takes the cell of the piece that its centre comes from (inverse warping),
    so a rotated piece has no holes and does not grow. Quarter turns and shifts by whole cells are
    exact.

    Args:
        config: cell size, extent, capacity of both.
        voxels: the map; its cells have precedence where the capacity is full.
        piece: from ``copy``, or any map of the same cell size.
        transform: (4, 4) rigid, metres; None for the identity.

    Returns:
        The map. Cells that do not fit are counted as dropped; cells of the piece whose centre
        leaves the grid are counted as outside.

    Raises:
        UserError: the transform is not a rigid 4×4.
    """
    transform = boxes.rigid(transform, "paste")
    no_cell, back = voxel_cells.nowhere(config), invert_rigid(transform)

    def source(cell: Array) -> tuple[Array, Array]:
        """Return the piece's slot that each cell of the map takes, and whether there is one."""
        centres = voxel_core.cell_centres(
            config, voxels.origin_3, jnp.where(cell < no_cell, cell, 0)
        )
        origin = cells.keys(config, piece.origin_3, transform_points(back, centres))
        slot, found = voxel_cells.find(piece.cell_of_slot_V, origin)
        return slot, found & (origin < no_cell) & (cell < no_cell)

    points, _, valid = voxel_core.to_points(config, piece)
    moved = transform_points(transform, points)
    target = cells.keys(config, voxels.origin_3, moved)
    around = moved + _neighbours(config)[:, None]
    near = cells.keys(config, voxels.origin_3, around.reshape(-1, 3))
    near = jnp.where(jnp.tile(valid, len(around)), near, no_cell)
    cell_V, dropped = voxel_cells.admit(
        voxels.cell_of_slot_V, jnp.where(source(near)[1], near, no_cell), no_cell
    )

    old = voxel_cells.relocate(voxels.cell_of_slot_V, voxels.features_VF, cell_V, no_cell)
    slot, taken = source(cell_V)
    lowest = jnp.asarray(-jnp.inf, old.dtype)
    new = jnp.where(taken[:, None], piece.features_VF[slot].astype(old.dtype), lowest)
    outside = (valid & (target == no_cell)).sum(dtype=jnp.int32)
    return voxel_core.renewed(config, voxels, cell_V, jnp.maximum(old, new), dropped, outside)


def move(
    config: Memory,
    voxels: VoxelMap,
    box_23: Array,
    transform: Array,
    *,
    leave: bool = False,
) -> VoxelMap:
    """Move what is in a box: copy it, erase it, paste it elsewhere.

    Args:
        config: cell size, extent, capacity.
        voxels: the map.
        box_23: (2, 3) lower and upper corner in the world, metres.
        transform: (4, 4) rigid, from old to new positions, metres.
        leave: erase nothing: a copy.

    Raises:
        UserError: the box is not a box, or the transform not a rigid 4×4.
    """
    piece = copy(config, voxels, box_23)
    rest = voxels if leave else erase(config, voxels, box_23)
    return paste(config, rest, piece, transform)


def _within(config: Memory, voxels: VoxelMap, box_23: Array) -> Array:
    points, _, valid = voxel_core.to_points(config, voxels)
    return boxes.within(points, valid, box_23)


def _only(config: Memory, voxels: VoxelMap, keep_V: Array) -> VoxelMap:
    no_cell = voxel_cells.nowhere(config)
    cell_V = jnp.sort(jnp.where(keep_V, voxels.cell_of_slot_V, no_cell))
    rows = voxel_cells.relocate(voxels.cell_of_slot_V, voxels.features_VF, cell_V, no_cell)
    return voxel_core.renewed(config, voxels, cell_V, rows)


def _neighbours(config: Memory) -> np.ndarray:
    """Return (O, 3) offsets, metres, to all cells whose centre a rotated cell can cover."""
    half_diagonal = math.dist(config.cell_m, (0, 0, 0)) / 2
    reach = [int(half_diagonal / size + 0.5) for size in config.cell_m]
    steps = itertools.product(*(range(-n, n + 1) for n in reach))
    return np.asarray(list(steps), np.float32) * np.asarray(config.cell_m, np.float32)
