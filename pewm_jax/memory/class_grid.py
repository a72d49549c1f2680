"""A grid of class ids: the state of the world ``persist`` as a memory that can be edited.

A cell holds −1 if it is unknown, 0 if it is empty, else a class. The networks of the world predict
the cells from observed frames (``worlds.persist``). A mask beside the classes states where a cell
comes from: it was observed in a real frame (or given, or edited), an imagined frame has shown it,
or neither: then it is a guess, or unknown.

A box is (2, 3), its lower and upper corner in the world, metres; a cell belongs to it if its centre
lies in it. A transform is a rigid 4×4 matrix from old to new positions. Erased cells are empty, not
unknown. Edited cells count as observed. All functions are pure and jittable with ``config`` static.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from pewm_jax.config import AssembledModel, Memory, Reader
from pewm_jax.data.voxels import VoxelsConfig, table_colours
from pewm_jax.errors import UserError, require
from pewm_jax.geometry import march
from pewm_jax.geometry.cameras import invert_rigid, transform_points
from pewm_jax.memory import cells
from pewm_jax.registry import part
from pewm_jax.types import Array, Camera, View

UNKNOWN = -1
"""The id of an unknown cell."""
EMPTY = 0
"""The id of an empty cell."""
GUESSED, SHOWN, OBSERVED = 0, 1, 2
"""Values of the mask: unknown or a guess, shown by an imagined frame, observed (given, edited)."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ClassGrid:
    """Class ids of all cells that were ever near the agent.

    Attributes:
        classes_XYZ: (X, Y, Z) int16 class ids; ``UNKNOWN`` where nothing is known.
        low_3: (3,) float32 world position of the lowest corner, metres.
        history: what the world's networks keep of earlier frames; None outside a world.
        mask_XYZ: (X, Y, Z) uint8 ``GUESSED``, ``SHOWN`` or ``OBSERVED``; None if it is not kept.
    """

    classes_XYZ: Array
    low_3: Array
    history: Any = None
    mask_XYZ: Array | None = None


def observed(grid: ClassGrid) -> Array:
    """Return (X, Y, Z) int8: 1 where a cell was observed free, 2 observed filled, 0 unknown.

    Raises:
        UserError: the grid has no mask.
    """
    if grid.mask_XYZ is None:
        raise UserError(
            "this grid has no mask of observed cells: use the map of a world's state, or "
            "GridConfig.empty."
        )
    filled = jnp.where(grid.classes_XYZ > EMPTY, jnp.int8(2), jnp.int8(1))
    return jnp.where(grid.mask_XYZ == OBSERVED, filled, jnp.int8(0))


def place(config: Memory, grid: ClassGrid, box_23: Array, number: int | Array) -> ClassGrid:
    """Fill a box with a class id; see ``number_of``.

    Raises:
        UserError: the box is invalid, or the id is not of the table.
    """
    if not isinstance(number, Tracer):
        given, table = np.asarray(number), VoxelsConfig(kinds=config.kinds, colours=config.colours)  # type: ignore[attr-defined]
        count = len(table.names)
        if np.any((given < EMPTY) | (given >= count)):
            raise UserError(
                f"place() got the class {number}: use an id of the table, 1 to {count - 1}, or 0 "
                "for nothing."
            )
    return _with(grid, _within(config, grid, box_23), jnp.asarray(number, jnp.int16))


def erase(config: Memory, grid: ClassGrid, box_23: Array) -> ClassGrid:
    """Empty a box.

    Raises:
        UserError: the box is invalid.
    """
    return place(config, grid, box_23, EMPTY)


def copy(config: Memory, grid: ClassGrid, box_23: Array) -> ClassGrid:
    """Return a grid of what is in a box; all other cells are unknown.

    Raises:
        UserError: the box is invalid.
    """
    inside = _within(config, grid, box_23) & (grid.classes_XYZ > EMPTY)
    kept = jnp.where(inside, grid.classes_XYZ, jnp.int16(UNKNOWN))
    return dataclasses.replace(grid, classes_XYZ=kept, history=None, mask_XYZ=None)


def paste(
    config: Memory, grid: ClassGrid, piece: ClassGrid, transform: Array | None = None
) -> ClassGrid:
    """Insert a piece into a grid; its occupied cells replace those of the grid.

    Each cell takes the cell of the piece that its centre comes from (inverse warping), so a rotated
    piece has no holes. Quarter turns and shifts by whole cells are exact. The piece may be any grid
    of the same cell size; ``transform`` is rigid, (4, 4), metres.

    Raises:
        UserError: the transform is not a rigid 4×4.
    """
    back = invert_rigid(cells.rigid(transform, "paste"))
    points = centres(config, grid).reshape(-1, 3)
    at = (transform_points(back, points) - piece.low_3) / config.cell_m[0]
    cell_N3 = jnp.floor(at + 1e-4).astype(jnp.int32)
    shape = jnp.asarray(piece.classes_XYZ.shape)
    inside = ((cell_N3 >= 0) & (cell_N3 < shape)).all(-1)
    x, y, z = jnp.where(inside[:, None], cell_N3, 0).T
    found = jnp.where(inside, piece.classes_XYZ[x, y, z], jnp.int16(UNKNOWN))
    found = found.reshape(grid.classes_XYZ.shape)
    return _with(grid, found > EMPTY, found)


def move(
    config: Memory,
    grid: ClassGrid,
    box_23: Array,
    transform: Array,
    *,
    leave: bool = False,
) -> ClassGrid:
    """Move what is in a box by a rigid (4, 4) transform: copy, erase, paste.

    With ``leave`` the content also stays in place.

    Raises:
        UserError: the box is invalid, or the transform is not a rigid 4×4.
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
    return cells.within(points, jnp.ones(points.shape[:3], bool), box_23)


def _with(grid: ClassGrid, changed_XYZ: Array, classes: Array) -> ClassGrid:
    """Return a grid with other classes in some cells, which count as observed: an edit stays."""
    cells_XYZ, mask = jnp.where(changed_XYZ, classes, grid.classes_XYZ), grid.mask_XYZ
    if mask is not None:
        mask = jnp.where(changed_XYZ, jnp.uint8(OBSERVED), mask)
    return dataclasses.replace(grid, classes_XYZ=cells_XYZ, mask_XYZ=mask)


def names(config: GridConfig) -> tuple[str, ...]:
    """Return the table of classes; class k is ``names(config)[k]``, and class 0 is empty."""
    return VoxelsConfig(kinds=config.kinds, colours=config.colours).names


def number_of(config: GridConfig, name: str) -> int:
    """Return the id of a class by its name, such as ``furniture/red``.

    Raises:
        UserError: there is no such class.
    """
    table = names(config)
    if name not in table:
        known = ", ".join(table)
        raise UserError(f"there is no class {name!r} in this world; the classes are {known}.")
    return table.index(name)


def _colours(config: GridConfig) -> Array:
    """Return the colours (classes, 3) of the table, in [−1, 1]."""
    return jnp.asarray(table_colours(names(config)).astype(np.float32) / 127.5 - 1)


@dataclasses.dataclass(frozen=True)
class GridConfig(Memory):
    """The state of the world: class ids of all cells that were ever near the agent.

    A frame's voxels are a window of it around the agent; cells outside the window are kept.
    """

    KEEPS_FEATURES: ClassVar[bool] = False
    READ_BY_BLOCKS: ClassVar[bool] = False
    CLASSES: ClassVar[bool] = True
    EDITABLE: ClassVar[bool] = True

    cell_m: tuple[float, float, float] = (0.2, 0.2, 0.2)
    """Side of a cell, three times the same, metres."""
    cells: tuple[int, int, int] = (192, 192, 48)
    """Cells that are kept along x, y, z; along z as many as a window has."""
    recorded: int = 64
    """Cells along each side of the grids in the data: those of a window, and those by which the
    window may be off the agent."""
    kinds: Literal["all", "groups"] = "all"
    """Which classes there are, as the data were collected (`--voxels.kinds`)."""
    colours: int = 16
    """Colours of each kind, as the data were collected (`--voxels.colours`)."""
    pictures: Literal["surfaces", "cells"] = "surfaces"
    """Content of the data's images, as they were collected (`--voxels.pictures`)."""
    eye_m: float = 1.25
    """Height of the camera above the floor, metres: if a world begins without a known grid, the
    floor is a border between cells."""
    reader: Reader = part("reader", "render")
    """Not used: only the networks of the world read it."""

    @property
    def room(self) -> int:
        """How many cells it holds."""
        return math.prod(self.cells)

    def check(self, model: Any) -> None:
        """Refuse a grid that does not fit the networks."""
        require(
            hasattr(model, "voxel_noise"),
            "memory.kind grid is the state of the world persist: use model.kind persist.",
        )
        side, token = model.backbone.voxel_vae.side, model.backbone.token_cells
        require(
            len(set(self.cell_m)) == 1,
            f"memory.cell_m is {self.cell_m}: cells are cubes, name the same side three times.",
        )
        x, y, z = self.cells
        require(
            min(x, y) >= side and z == side and x % token == 0 and y % token == 0,
            f"memory.cells is {self.cells}: use multiples of {token} from {side} on along x and "
            f"y, and {side} along z, as a window has (backbone.voxel_vae.side).",
        )
        require(
            self.recorded >= side + token and (self.recorded - side) % 2 == 0,
            f"memory.recorded is {self.recorded}: use {side + token} or more (a window and its "
            "distance from the agent), by an even number more than the window.",
        )

    def empty(self, model: AssembledModel, centre_3: Array) -> ClassGrid:
        """Return a grid of unknown cells around a camera at ``centre_3``.

        The floor, ``eye_m`` below the camera, is a border between cells; horizontally cells lie at
        multiples of their side.
        """
        del model
        cell, centre = self.cell_m[0], jnp.asarray(centre_3, jnp.float32)
        below = np.floor(self.eye_m / cell - (self.cells[2] - 1) / 2 + 1e-4)
        low_z = centre[2] - self.eye_m + below * cell
        middle = jnp.round(centre[:2] / cell) * cell  # on the lattice of recorded grids
        low_xy = middle - np.asarray(self.cells[:2]) // 2 * cell
        unknown = jnp.full(self.cells, UNKNOWN, jnp.int16)
        mask = jnp.full(self.cells, GUESSED, jnp.uint8)
        return ClassGrid(unknown, jnp.concatenate([low_xy, low_z[None]]), mask_XYZ=mask)

    def to_points(self, model: AssembledModel, memory: ClassGrid) -> tuple[Array, Array, Array]:
        """Return centres, colours in [−1, 1] and occupancy of all cells."""
        del model
        points = centres(self, memory).reshape(-1, 3)
        ids = memory.classes_XYZ.reshape(-1).astype(jnp.int32)
        return points, _colours(self)[jnp.maximum(ids, 0)], ids > 0

    def render(
        self, model: AssembledModel, memory: ClassGrid, camera: Camera, height: int, width: int
    ) -> View:
        """Render the cells in the colours of their classes, by ray marching."""
        del model
        ids = jnp.maximum(memory.classes_XYZ, 0).astype(jnp.int32)
        cell = self.cell_m[0]
        seen = march.through_pixels(ids, memory.low_3, cell, camera, height, width, 1)
        there = seen.ids_L[..., 0] > 0
        colours = jnp.where(there[..., None], _colours(self)[seen.ids_L[..., 0]], 0)
        return View(colours, seen.distance_L[..., 0], there)

    def erase(self, model: AssembledModel, memory: ClassGrid, box_23: Array) -> ClassGrid:
        """Empty a box; see ``erase``."""
        del model
        return erase(self, memory, box_23)

    def move(
        self,
        model: AssembledModel,
        memory: ClassGrid,
        box_23: Array,
        transform: Array,
        *,
        leave: bool = False,
    ) -> ClassGrid:
        """Move or copy the content of a box; see ``move``."""
        del model
        return move(self, memory, box_23, transform, leave=leave)

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require(self.eye_m > 0, f"memory.eye_m is {self.eye_m}: use a height above 0 metres.")
