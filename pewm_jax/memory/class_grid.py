"""The state of the world ``persist`` as a memory: a grid of class ids, which can be edited.

A cell holds −1 where nothing is known, 0 where nothing is, else a class. Real frames do not enter
by ``remember``: the world's networks make the cells of them (``worlds.persist``).
"""

from __future__ import annotations

import dataclasses
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import GridConfig, ModelConfig, UserError
from pewm_jax.data.voxels import VoxelsConfig, table_colours
from pewm_jax.geometry import march
from pewm_jax.memory import class_edit
from pewm_jax.types import Array, Camera, Frames, View

UNKNOWN = class_edit.UNKNOWN


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ClassGrid:
    """Class ids of all cells that were ever near the agent.

    Attributes:
        classes_XYZ: (X, Y, Z) int16 class ids; ``UNKNOWN`` where nothing is known.
        low_3: (3,) float32 world position of the lowest corner, metres.
        history: what the world's networks keep of the frames before; None in a grid by itself.
    """

    classes_XYZ: Array
    low_3: Array
    history: Any = None


def names(config: GridConfig) -> tuple[str, ...]:
    """Return the table of classes; class k is ``names(config)[k]``, and class 0 is empty."""
    return VoxelsConfig(kinds=config.kinds, colours=config.colours).names


def number_of(config: GridConfig, name: str) -> int:
    """Return the id of a class by its name, such as ``furniture/red``.

    Raises:
        UserError: there is none.
    """
    table = names(config)
    if name not in table:
        raise UserError(f"there is no class {name!r} in this world; there is {', '.join(table)}.")
    return table.index(name)


def empty(model: ModelConfig, centre_3: Array) -> ClassGrid:
    """Return a grid of which nothing is known.

    Args:
        model: the model.
        centre_3: (3,) camera around which it lies, metres; the floor, ``memory.eye_m`` below it,
            is a border between cells, and across the ground whole multiples of a cell are.
    """
    config = model.memory
    assert isinstance(config, GridConfig)
    cell, centre = config.cell_m[0], jnp.asarray(centre_3, jnp.float32)
    below = np.floor(config.eye_m / cell - (config.cells[2] - 1) / 2 + 1e-4)
    low_z = centre[2] - config.eye_m + below * cell
    middle = jnp.round(centre[:2] / cell) * cell  # on the lattice of recorded grids
    low_xy = middle - np.asarray(config.cells[:2]) // 2 * cell
    cells = jnp.full(config.cells, UNKNOWN, jnp.int16)
    return ClassGrid(cells, jnp.concatenate([low_xy, low_z[None]]))


def to_points(model: ModelConfig, grid: ClassGrid) -> tuple[Array, Array, Array]:
    """Return centres, colours in [−1, 1] and whether anything is there, of all cells."""
    assert isinstance(model.memory, GridConfig)
    points = class_edit.centres(model.memory, grid).reshape(-1, 3)
    ids = grid.classes_XYZ.reshape(-1).astype(jnp.int32)
    return points, _colours(model.memory)[jnp.maximum(ids, 0)], ids > 0


def render(model: ModelConfig, grid: ClassGrid, camera: Camera, height: int, width: int) -> View:
    """Return what cameras see of the cells in the colours of their classes, by rays.

    Args:
        model: the model.
        grid: the grid.
        camera: (T,) cameras, whose intrinsics are for images of ``height`` × ``width``.
        height: of the images, pixels.
        width: of the images, pixels.
    """
    assert isinstance(model.memory, GridConfig)
    ids = jnp.maximum(grid.classes_XYZ, 0).astype(jnp.int32)
    cell = model.memory.cell_m[0]
    seen = march.through_pixels(ids, grid.low_3, cell, camera, height, width, 1)
    there = seen.ids_L[..., 0] > 0
    colours = jnp.where(there[..., None], _colours(model.memory)[seen.ids_L[..., 0]], 0)
    return View(colours, seen.distance_L[..., 0], there)


def _colours(config: GridConfig) -> Array:
    """Return the colours (classes, 3) of the table, in [−1, 1]."""
    return jnp.asarray(table_colours(names(config)).astype(np.float32) / 127.5 - 1)


def erase(model: ModelConfig, grid: ClassGrid, box_23: Array) -> ClassGrid:
    """Leave nothing in a box; see ``class_edit.erase``."""
    return class_edit.erase(model.memory, grid, box_23)


def move(
    model: ModelConfig, grid: ClassGrid, box_23: Array, transform: Array, *, leave: bool = False
) -> ClassGrid:
    """Move or copy what is in a box; see ``class_edit.move``."""
    return class_edit.move(model.memory, grid, box_23, transform, leave=leave)


def remember(
    model: ModelConfig, grid: ClassGrid, frames: Frames, features: Array, valid_T: Any = None
) -> NoReturn:
    """Refuse: cells are made by networks.

    Raises:
        UserError: always.
    """
    del model, grid, frames, features, valid_T
    raise UserError(
        "a grid of classes takes in no pictures by itself: use pewm_jax.start and pewm_jax.observe."
    )


def tokens(model: ModelConfig, grid: ClassGrid, camera: Camera) -> NoReturn:
    """Refuse: nothing attends to the cells.

    Raises:
        UserError: always.
    """
    del model, grid, camera
    raise UserError("a grid of classes has no tokens: the world persist renders it by rays.")
