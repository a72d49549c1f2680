"""The sparse list of cells of a voxel map: sorted cell numbers with static capacity.

A map is a sorted list of cell numbers, free slots last, with one row of features per slot. Cells
are found by binary search, so neither time nor memory depends on the extent of the grid. The layout
is canonical: maps with equal cells and features are equal bit for bit, however they were made.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from pewm_jax.config import Memory
from pewm_jax.types import Array


def nowhere(config: Memory) -> int:
    """Return the number that stands for no cell; it sorts after all cells."""
    return math.prod(config.cells)


def find(cell_V: Array, cell_P: Array) -> tuple[Array, Array]:
    """Look cells up.

    Args:
        cell_V: (V,) the cells of a map, sorted.
        cell_P: (P,) cells to find, in any order.

    Returns:
        ``(slot_P, found_P)``; the slot is meaningless if the cell is not found.
    """
    slot = jnp.searchsorted(cell_V, cell_P, method="scan").astype(jnp.int32)
    slot = jnp.minimum(slot, cell_V.shape[0] - 1)
    return slot, cell_V[slot] == cell_P


def admit(cell_V: Array, cell_P: Array, no_cell: int) -> tuple[Array, Array]:
    """Add cells to a map's list while there is room.

    Cells already in the map stay. New cells are admitted in the order of their numbers.

    Args:
        cell_V: (V,) the cells of a map, sorted, ``no_cell`` where a slot is free.
        cell_P: (P,) cells seen, in any order, with repetitions, ``no_cell`` for points to ignore.
        no_cell: the number that stands for no cell.

    Returns:
        ``(cell_V, dropped)``: the new list, and the number of distinct new cells that did not fit.
    """
    capacity = cell_V.shape[0]
    ordered = jnp.sort(cell_P)
    before = jnp.concatenate([jnp.full((1,), -1, ordered.dtype), ordered[:-1]])
    new = (ordered != before) & (ordered < no_cell) & ~find(cell_V, ordered)[1]
    rank = jnp.cumsum(new, dtype=jnp.int32)
    fits = new & (rank <= capacity - (cell_V < no_cell).sum(dtype=jnp.int32))
    fresh = jnp.full((capacity,), no_cell, cell_V.dtype)
    fresh = fresh.at[jnp.where(fits, rank - 1, capacity)].set(ordered, mode="drop")
    merged = jnp.sort(jnp.concatenate([cell_V, fresh]))[:capacity]
    return merged, (new & ~fits).sum(dtype=jnp.int32)


def relocate(old_V: Array, features_VF: Array, new_V: Array, no_cell: int) -> Array:
    """Move rows of features to the slots of a new list of cells; −inf where a cell is new.

    Args:
        old_V: (V,) the cells the rows belong to, sorted.
        features_VF: (V, F) features.
        new_V: (V,) the new list, sorted.
        no_cell: the number that stands for no cell.
    """
    slot, found = find(old_V, new_V)
    held = found & (new_V < no_cell)
    lowest = jnp.asarray(-jnp.inf, features_VF.dtype)
    return jnp.where(held[:, None], features_VF[slot], lowest)


def maximum_over_blocks(
    features_VF: Array, count: Array, size: int, read: Callable[[Array, int], tuple[Array, Array]]
) -> Array:
    """Scatter-max ``count`` rows, block by block, so that only one block of rows exists at a time.

    Args:
        features_VF: (V, F) the rows so far.
        count: () number of rows to read, ≤ ``size``.
        size: the largest number of rows.
        read: ``(start, b)`` → ``(slot_b, rows_bF)``, b rows from ``start`` on; rows with slot V are
            ignored. A row may be requested twice, and so may rows beyond ``count``.

    Returns:
        (V, F) in the dtype of ``features_VF``. Maxima are computed in float32. Rounding preserves
        order, so the result is the same as in the narrower dtype.
    """
    exact = jnp.promote_types(features_VF.dtype, jnp.float32)

    def run(block: int, rows_VF: Array, count: Array) -> Array:
        block = min(block, size)

        def body(i: Array, rows_VF: Array) -> Array:
            slot, rows = read(jnp.minimum(i * block, size - block), block)
            return rows_VF.at[slot].max(rows.astype(exact), mode="drop")

        return jax.lax.fori_loop(0, (count + block - 1) // block, body, rows_VF)

    # On a CPU a block should fit into the cache; on an accelerator there should be few launches.
    result = jax.lax.platform_dependent(
        features_VF.astype(exact),
        largest_of_batch(count),
        cpu=lambda rows_VF, count: run(4096, rows_VF, count),
        default=lambda rows_VF, count: run(65536, rows_VF, count),
    )
    return result.astype(features_VF.dtype)


@jax.custom_batching.custom_vmap
def largest_of_batch(count: Array) -> Array:
    """Return a count unchanged; under ``vmap``, the largest count of the batch.

    With a loop bound that differs within a batch, ``vmap`` copies the whole carry in every
    iteration; with a condition that differs, it computes both branches.
    """
    return count


@largest_of_batch.def_vmap
def _(_axis_size: int, _in_batched: list[bool], count: Array) -> tuple[Array, bool]:
    return largest_of_batch(count.max(0)), False
