"""Errors of voxel grids for training, as a rollout's voxels have: parts missing, moved, doubled.

The renderer learns to draw the true image of such voxels, and the world frames' transformer to
complete and revise a map that holds such guesses.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from pewm_jax.memory.class_grid import EMPTY
from pewm_jax.types import Array

CHANGES = 6
"""Boxes that are changed in one grid, on average half of them."""
LARGEST = 8
"""Largest side of such a box, cells."""
FARTHEST = 2
"""Largest distance by which the content of a box is moved or repeated, cells along an axis."""
SPECKS = 0.02
"""Largest share of single occupied cells that are missing in a grid."""
MISSING, MOVED, DOUBLED = 0, 1, 2
"""Kinds of changes."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Changes:
    """Changes of a grid: boxes of cells, and single cells that are missing.

    Attributes:
        low_N3: int32 first cells of the boxes.
        side_N3: their sides, cells.
        shift_N3: distances by which their content is moved or repeated, cells.
        kind_N: ``MISSING``, ``MOVED`` or ``DOUBLED``.
        made_N: bool, whether the change is made.
        specks_XYZ: bool, which single cells are missing.
    """

    low_N3: Array
    side_N3: Array
    shift_N3: Array
    kind_N: Array
    made_N: Array
    specks_XYZ: Array


def corrupt(classes_XYZ: Array, key: Array, *, changes: int = CHANGES) -> Array:
    """Return a grid in which parts are missing, moved or there twice; cells below 0 are kept."""
    drawn = draw_changes(classes_XYZ, key, changes=changes)
    return apply_changes(classes_XYZ, drawn, jnp.zeros(3, jnp.int32))


def draw_changes(classes_XYZ: Array, key: Array, *, changes: int = CHANGES) -> Changes:
    """Draw changes of a grid of integer class ids, in boxes around its occupied cells."""
    keys = jax.random.split(key, 7)
    full = (classes_XYZ > EMPTY).reshape(-1)
    # An occupied cell is drawn by its rank.
    rank = jnp.floor(jax.random.uniform(keys[0], (changes,)) * jnp.maximum(full.sum(), 1))
    cell = jnp.minimum(jnp.searchsorted(jnp.cumsum(full), rank + 1), full.size - 1)
    at = jnp.stack(jnp.unravel_index(cell, classes_XYZ.shape), -1).astype(jnp.int32)
    side = jax.random.randint(keys[1], (changes, 3), 1, LARGEST + 1)
    shift = jax.random.randint(keys[2], (changes, 3), -FARTHEST, FARTHEST + 1)
    kind = jax.random.randint(keys[3], (changes,), MISSING, DOUBLED + 1)
    share = SPECKS * jax.random.uniform(keys[4])
    return Changes(
        at - side // 2,
        side,
        jnp.where((kind == MISSING)[:, None], 0, shift),
        kind,
        jax.random.bernoulli(keys[5], shape=(changes,)),
        jax.random.bernoulli(keys[6], share, classes_XYZ.shape),
    )


def apply_changes(classes_XYZ: Array, changes: Changes, off_3: Array) -> Array:
    """Return a grid, whose first cell is cell ``off_3`` of the drawn one's, with these changes."""
    axes = [jnp.arange(size) for size in classes_XYZ.shape]

    def taken(values: Array, places: list[Array]) -> Array:
        for axis, index in enumerate(places):
            values = jnp.take(values, jnp.clip(index, 0, values.shape[axis] - 1), axis)
        return values

    specks = taken(changes.specks_XYZ, [axis + off_3[k] for k, axis in enumerate(axes)])
    grid = jnp.where(specks & (classes_XYZ > EMPTY), EMPTY, classes_XYZ)
    boxes = (
        changes.low_N3 - off_3,
        changes.side_N3,
        changes.shift_N3,
        changes.kind_N,
        changes.made_N,
    )

    def change(grid: Array, box: tuple[Array, ...]) -> tuple[Array, None]:
        low, side, shift, kind, made = box
        x, y, z = ((axis >= low[k]) & (axis < low[k] + side[k]) for k, axis in enumerate(axes))
        inside = x[:, None, None] & y[:, None] & z & (grid > EMPTY) & made
        kept = jnp.where(inside & (kind != DOUBLED), EMPTY, grid)
        source = [axis - shift[k] for k, axis in enumerate(axes)]
        there = taken(inside, source) & (kind != MISSING) & (grid >= EMPTY)
        return jnp.where(there, taken(grid, source), kept), None

    return jax.lax.scan(change, grid, boxes)[0]
