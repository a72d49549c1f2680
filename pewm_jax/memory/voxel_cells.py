"""Which cells a voxel map keeps: sorted cell numbers of static capacity, and nothing per grid cell.

A map is a sorted list of cell numbers, free slots last, and one row of features per slot. A cell
is found by binary search, so that neither time nor memory depends on the extent of the grid. The
layout is canonical: maps of equal cells and features are equal bit for bit, however they came
about.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from pewm_jax.config import MemorySettings
from pewm_jax.types import Array


def nowhere(config: MemorySettings) -> int:
    """Return the number that stands for no cell; it sorts after all cells."""
    return math.prod(config.cells)


def find(cell_V: Array, cell_P: Array) -> tuple[Array, Array]:
    """Look cells up.

    Args:
        cell_V: (V,) the cells of a map, sorted.
        cell_P: (P,) cells to find, in any order.

    Returns:
        ``(slot_P, found_P)``; the slot means nothing where the cell is not found.
    """
    slot = jnp.searchsorted(cell_V, cell_P, method="scan").astype(jnp.int32)
    slot = jnp.minimum(slot, cell_V.shape[0] - 1)
    return slot, cell_V[slot] == cell_P


def admit(cell_V: Array, cell_P: Array, none: int) -> tuple[Array, Array]:
    """Add cells to a map's list while there is room.

    The cells that are there stay; of the new ones the lowest numbers enter.

    Args:
        cell_V: (V,) the cells of a map, sorted, ``none`` where a slot is free.
        cell_P: (P,) cells seen, in any order and repeated, ``none`` where there is none.
        none: the number that stands for no cell.

    Returns:
        ``(cell_V, dropped)``: the new list, and how many distinct new cells did not fit.
    """
    capacity = cell_V.shape[0]
    ordered = jnp.sort(cell_P)
    before = jnp.concatenate([jnp.full((1,), -1, ordered.dtype), ordered[:-1]])
    new = (ordered != before) & (ordered < none) & ~find(cell_V, ordered)[1]
    rank = jnp.cumsum(new, dtype=jnp.int32)
    fits = new & (rank <= capacity - (cell_V < none).sum(dtype=jnp.int32))
    fresh = jnp.full((capacity,), none, cell_V.dtype)
    fresh = fresh.at[jnp.where(fits, rank - 1, capacity)].set(ordered, mode="drop")
    merged = jnp.sort(jnp.concatenate([cell_V, fresh]))[:capacity]
    return merged, (new & ~fits).sum(dtype=jnp.int32)


def relocate(old_V: Array, features_VF: Array, new_V: Array, none: int) -> Array:
    """Move rows of features to the slots of a new list of cells; −inf where a cell is new.

    Args:
        old_V: (V,) the cells the rows belong to, sorted.
        features_VF: (V, F) features.
        new_V: (V,) the new list, sorted.
        none: the number that stands for no cell.
    """
    slot, found = find(old_V, new_V)
    held = found & (new_V < none)
    lowest = jnp.asarray(-jnp.inf, features_VF.dtype)
    return jnp.where(held[:, None], features_VF[slot], lowest)


def maximum_over_blocks(
    features_VF: Array, count: Array, size: int, read: Callable[[Array, int], tuple[Array, Array]]
) -> Array:
    """Scatter-max ``count`` rows, block by block: no more than one block of rows exists at a time.

    Args:
        features_VF: (V, F) the rows so far.
        count: () how many there are to read, ≤ ``size``.
        size: how many there can be.
        read: ``(start, b)`` → ``(slot_b, rows_bF)`` of b rows from ``start`` on; slot V is
            dropped. Rows may be asked for twice, and rows beyond ``count`` may be asked for.

    Returns:
        (V, F) in the dtype of ``features_VF``. Maxima are taken in float32, which every narrower
        dtype fits into: rounding keeps order, so the result is that of the narrower dtype.
    """
    exact = jnp.promote_types(features_VF.dtype, jnp.float32)

    def run(block: int, rows_VF: Array, count: Array) -> Array:
        block = min(block, size)

        def body(i: Array, rows_VF: Array) -> Array:
            slot, rows = read(jnp.minimum(i * block, size - block), block)
            return rows_VF.at[slot].max(rows.astype(exact), mode="drop")

        return jax.lax.fori_loop(0, (count + block - 1) // block, body, rows_VF)

    # A processor wants a block in its cache, an accelerator few launches.
    result = jax.lax.platform_dependent(
        features_VF.astype(exact),
        largest_of_batch(count),
        cpu=lambda rows_VF, count: run(4096, rows_VF, count),
        default=lambda rows_VF, count: run(65536, rows_VF, count),
    )
    return result.astype(features_VF.dtype)


@jax.custom_batching.custom_vmap
def largest_of_batch(count: Array) -> Array:
    """Return a count as it is; under ``vmap`` the largest of the batch, the same for all.

    A loop bound that differs between the members of a batch makes ``vmap`` copy all that the loop
    carries in every turn, and a branch that differs makes it take both.
    """
    return count


@largest_of_batch.def_vmap
def _(_axis_size: int, _in_batched: list[bool], count: Array) -> tuple[Array, bool]:
    return largest_of_batch(count.max(0)), False
