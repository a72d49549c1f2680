"""Editing surfels: erase, move and copy parts; ``memories.erase`` and ``memories.move`` call these.

A surfel that is moved keeps what it is the mean of, and whether it was observed. Where it arrives
it takes the place of what was there. Surfels that arrive in one cell become one.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import jax.numpy as jnp

from pewm_jax.config import SurfelConfig
from pewm_jax.geometry.cameras import matmul, transform_points
from pewm_jax.memory import cells, voxel_cells
from pewm_jax.types import Array

if TYPE_CHECKING:
    from pewm_jax.memory.surfels import Surfels

COUNT, PLACE, COLOUR, NORMAL = slice(0, 1), slice(1, 4), slice(4, 7), slice(7, 10)
"""Columns of ``sums_VC``; features come after them."""


def erase(config: SurfelConfig, surfels: Surfels, taken_V: Array) -> Surfels:
    """Return the surfels without those that are taken.

    Args:
        config: cell size, extent, capacity.
        surfels: those so far.
        taken_V: (V,) bool.
    """
    no_cell = voxel_cells.nowhere(config)
    cell_V = jnp.sort(jnp.where(taken_V, no_cell, surfels.cell_V))
    return _rearranged(config, surfels, cell_V)


def move(
    config: SurfelConfig,
    surfels: Surfels,
    points_V3: Array,
    taken_V: Array,
    transform: Array,
    *,
    leave: bool = False,
) -> Surfels:
    """Return the surfels after those that are taken were moved, or copied.

    Args:
        config: cell size, extent, capacity.
        surfels: those so far.
        points_V3: (V, 3) where they are, metres.
        taken_V: (V,) bool, those to move.
        transform: (4, 4) rigid, from old to new positions.
        leave: leave them where they are, too.

    Returns:
        The surfels. Cells that do not fit are counted as dropped, surfels that leave the grid as
        outside.
    """
    no_cell, capacity = voxel_cells.nowhere(config), surfels.cell_V.shape[0]
    there = transform_points(transform, points_V3)
    target = cells.keys(config, surfels.origin_3, there)
    outside = (taken_V & (target == no_cell)).sum(dtype=jnp.int32)
    target = jnp.where(taken_V, target, no_cell)

    rest = surfels if leave else erase(config, surfels, taken_V)
    cell_V, dropped = voxel_cells.admit(rest.cell_V, target, no_cell)
    after = _rearranged(config, rest, cell_V)
    slot, found = voxel_cells.find(cell_V, target)
    arrives = found & (target < no_cell)
    slot = jnp.where(arrives, slot, capacity)
    covered = jnp.zeros((capacity,), bool).at[slot].set(True, mode="drop")

    count, turn = surfels.sums_VC[:, COUNT], transform[:3, :3]
    corner = cells.corners(config, surfels.origin_3, jnp.where(arrives, target, 0))
    rows = surfels.sums_VC.at[:, PLACE].set((there - corner) * count)
    rows = rows.at[:, NORMAL].set(matmul(surfels.sums_VC[:, NORMAL], turn.T))
    rows = jnp.where(arrives[:, None], rows, 0)
    size = jnp.where(covered, jnp.inf, after.size_V).at[slot].min(surfels.size_V, mode="drop")
    observed = jnp.where(covered, False, after.observed_V)
    return dataclasses.replace(
        after,
        sums_VC=jnp.where(covered[:, None], 0, after.sums_VC).at[slot].add(rows, mode="drop"),
        size_V=size,
        observed_V=observed.at[slot].max(surfels.observed_V, mode="drop"),
        dropped=surfels.dropped + dropped,
        outside=surfels.outside + outside,
    )


def _rearranged(config: SurfelConfig, surfels: Surfels, cell_V: Array) -> Surfels:
    """Return the surfels in the slots of a new list of cells; those of new cells are empty."""
    no_cell = voxel_cells.nowhere(config)
    before, known = voxel_cells.find(surfels.cell_V, cell_V)
    known = known & (cell_V < no_cell)
    return dataclasses.replace(
        surfels,
        cell_V=cell_V,
        sums_VC=jnp.where(known[:, None], surfels.sums_VC[before], 0),
        size_V=jnp.where(known, surfels.size_V[before], 0),
        observed_V=known & surfels.observed_V[before],
        occupied=(cell_V < no_cell).sum(dtype=jnp.int32),
    )
