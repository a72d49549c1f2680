"""Editing a voxel map, in metres and world coordinates: erase, copy, paste, move.

The world model imagines what the map says, so moving a piece of the map moves that piece of the
world. A box is (2, 3), its lower and its upper corner; a cell belongs to the box its centre lies
in, the lower faces included, the upper ones not. A transform is a rigid 4×4 matrix that takes
places of the piece to where they shall be.

All functions are pure and jittable with ``config`` static; capacities stay.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from pewm_jax.config import MemorySettings, UserError
from pewm_jax.geometry.cameras import invert_rigid, transform_points
from pewm_jax.memory import cells, voxel_cells, voxel_core
from pewm_jax.types import Array, VoxelMap


def erase(config: MemorySettings, voxels: VoxelMap, box_23: Array) -> VoxelMap:
    """Forget the cells in a box, as if nothing had ever been seen there.

    Args:
        config: cell size, extent, capacity.
        voxels: the map.
        box_23: (2, 3) lower and upper corner in the world, metres.

    Raises:
        UserError: the box is not a box.
    """
    return _only(config, voxels, ~_within(config, voxels, box_23))


def copy(config: MemorySettings, voxels: VoxelMap, box_23: Array) -> VoxelMap:
    """Return a map of the cells in a box alone; nothing counts as dropped or outside in it.

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
    config: MemorySettings, voxels: VoxelMap, piece: VoxelMap, transform: Array | None = None
) -> VoxelMap:
    """Put a piece into a map; where both have a cell, the maximum counts.

    Each cell of the map takes the piece's cell that its centre comes from, so that a turned piece
    has no holes and is no thicker; whole quarter turns and moves by whole cells are exact.

    Args:
        config: cell size, extent, capacity of both.
        voxels: the map; its cells have precedence where the capacity is full.
        piece: from ``copy``, or any map of the same cell size.
        transform: (4, 4) rigid, metres; nothing is moved without.

    Returns:
        The map. Cells that do not fit count as dropped, cells of the piece whose centre would lie
        beyond the extent as outside.

    Raises:
        UserError: the transform is not a rigid 4×4.
    """
    transform = jnp.eye(4) if transform is None else jnp.asarray(transform, jnp.float32)
    if transform.shape != (4, 4):
        raise UserError(f"paste() got a transform of shape {transform.shape}; give a rigid 4×4.")
    if not isinstance(transform, Tracer) and not _is_rigid(np.asarray(transform)):
        raise UserError("paste() got a transform that is not rigid; give a rotation and a shift.")
    none, back = voxel_cells.nowhere(config), invert_rigid(transform)

    def source(cell: Array) -> tuple[Array, Array]:
        """Return the piece's slot that each cell of the map takes, and whether there is one."""
        centres = voxel_core.cell_centres(config, voxels.origin_3, jnp.where(cell < none, cell, 0))
        there = cells.keys(config, piece.origin_3, transform_points(back, centres))
        slot, found = voxel_cells.find(piece.cell_of_slot_V, there)
        return slot, found & (there < none) & (cell < none)

    points, _, valid = voxel_core.to_points(config, piece)
    moved = transform_points(transform, points)
    here = cells.keys(config, voxels.origin_3, moved)
    around = moved + _neighbours(config)[:, None]
    near = cells.keys(config, voxels.origin_3, around.reshape(-1, 3))
    near = jnp.where(jnp.tile(valid, len(around)), near, none)
    cell_V, dropped = voxel_cells.admit(
        voxels.cell_of_slot_V, jnp.where(source(near)[1], near, none), none
    )

    old = voxel_cells.relocate(voxels.cell_of_slot_V, voxels.features_VF, cell_V, none)
    slot, taken = source(cell_V)
    lowest = jnp.asarray(-jnp.inf, old.dtype)
    new = jnp.where(taken[:, None], piece.features_VF[slot].astype(old.dtype), lowest)
    outside = (valid & (here == none)).sum(dtype=jnp.int32)
    return voxel_core.renewed(config, voxels, cell_V, jnp.maximum(old, new), dropped, outside)


def move(config: MemorySettings, voxels: VoxelMap, box_23: Array, transform: Array) -> VoxelMap:
    """Move what is in a box: copy it, erase it, paste it elsewhere.

    Args:
        config: cell size, extent, capacity.
        voxels: the map.
        box_23: (2, 3) lower and upper corner in the world, metres.
        transform: (4, 4) rigid, from where things are to where they shall be, metres.

    Raises:
        UserError: the box is not a box, or the transform not a rigid 4×4.
    """
    piece = copy(config, voxels, box_23)
    return paste(config, erase(config, voxels, box_23), piece, transform)


def _is_rigid(transform: np.ndarray) -> bool:
    turn = transform[:3, :3]
    turns = np.allclose(turn @ turn.T, np.eye(3), atol=1e-4) and np.linalg.det(turn) > 0
    return bool(turns and (transform[3] == (0, 0, 0, 1)).all() and np.isfinite(transform).all())


def _within(config: MemorySettings, voxels: VoxelMap, box_23: Array) -> Array:
    box_23 = jnp.asarray(box_23, jnp.float32)
    if box_23.shape != (2, 3):
        raise UserError(
            f"a box is its lower and its upper corner, shape (2, 3), in metres; got {box_23.shape}."
        )
    if not isinstance(box_23, Tracer) and not np.all(box_23[0] <= box_23[1]):
        raise UserError(
            f"the box's lower corner {box_23[0]} is not below its upper corner {box_23[1]}; give "
            "the lower one first."
        )
    points, _, valid = voxel_core.to_points(config, voxels)
    return valid & ((points >= box_23[0]) & (points < box_23[1])).all(-1)


def _only(config: MemorySettings, voxels: VoxelMap, keep_V: Array) -> VoxelMap:
    none = voxel_cells.nowhere(config)
    cell_V = jnp.sort(jnp.where(keep_V, voxels.cell_of_slot_V, none))
    rows = voxel_cells.relocate(voxels.cell_of_slot_V, voxels.features_VF, cell_V, none)
    return voxel_core.renewed(config, voxels, cell_V, rows)


def _neighbours(config: MemorySettings) -> np.ndarray:
    """Return (O, 3) steps to all cells whose centre a turned cell can cover, metres."""
    half_diagonal = math.dist(config.cell_m, (0, 0, 0)) / 2
    reach = [int(half_diagonal / size + 0.5) for size in config.cell_m]
    steps = itertools.product(*(range(-n, n + 1) for n in reach))
    return np.asarray(list(steps), np.float32) * np.asarray(config.cell_m, np.float32)
