"""The 3D voxel feature map: sparse, of static capacity, filled by scatter-max (the paper's memory).

The feature of a cell is the maximum over all points that ever fell into it. While everything fits,
maps of the same points are equal bit for bit, in any order or batching of the insertions. Cells are
initialized with −inf, so negative features survive. Only *occupied* cells take memory (``cells``).

Cells that do not fit are counted in ``dropped``, once per insertion that saw them, and points
outside the grid in ``outside``. Cells of earlier insertions stay; within one insertion lower cell
numbers have precedence.

All functions from maps to maps are pure and work under jit (``config``, with cell size, extent and
capacity, is static) and vmap. A box is (2, 3), its lower and upper corner in metres; a cell belongs
to it if its centre lies in it::

    voxels = empty(config, centre, channels)
    voxels = insert_frames(config, voxels, frames, patch_features)
    chair = copy(config, voxels, box)
    voxels = move(config, voxels, box, transform)
    export(config, voxels, "map.glb")
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import DTypeLike

from pewm_jax.config import AssembledModel, Memory, UserError
from pewm_jax.geometry.cameras import invert_rigid, transform_points
from pewm_jax.memory import cells, voxel_files, voxel_frames
from pewm_jax.types import Array, Camera, Frames, MapTokens, Params, VoxelMap

load, save = voxel_files.load, voxel_files.save


def empty(
    config: Memory, centre_3: Array, channels: int, dtype: DTypeLike = jnp.float32
) -> VoxelMap:
    """Return an empty map of F = ``channels`` features per cell, float32 or bfloat16.

    The grid is centred on a world position (3,), metres. Its corner is snapped to whole cells, so
    that maps of one world share their cells.
    """
    zero = jnp.zeros((), jnp.int32)
    return VoxelMap(
        cell_of_slot_V=jnp.full((config.capacity,), cells.nowhere(config), jnp.int32),
        features_VF=jnp.full((config.capacity, channels), -jnp.inf, dtype),
        origin_3=cells.origin(config, centre_3),
        occupied=zero,
        dropped=zero,
        outside=zero,
    )


def insert(
    config: Memory, voxels: VoxelMap, points_P3: Array, features_PF: Array, valid_P: Array
) -> VoxelMap:
    """Insert (P, 3) world points with (P, F) features by scatter-max, where ``valid_P`` is True.

    Points with NaN count as outside the grid. Features are rounded to the map's dtype.

    Raises:
        UserError: points, features, validity and the map's channels do not fit together.
    """
    points_P3, features_PF, valid_P = map(jnp.asarray, (points_P3, features_PF, valid_P))
    no_cell, size = cells.nowhere(config), len(points_P3)
    shapes = points_P3.shape, features_PF.shape, valid_P.shape
    wanted = (size, 3), (size, voxels.features_VF.shape[-1]), (size,)
    if shapes != wanted:
        raise UserError(
            "insert() got points, features and validity of shapes "
            f"{', '.join(map(str, shapes))}; this map takes {', '.join(map(str, wanted))}."
        )
    if size == 0:
        return voxels
    seen = cells.keys(config, voxels.origin_3, points_P3)
    beyond = (valid_P & (seen == no_cell)).sum(dtype=jnp.int32)
    seen = jnp.where(valid_P, seen, no_cell)
    cell_V, dropped = cells.admit(voxels.cell_of_slot_V, seen, no_cell)

    def read(start: Array, block: int) -> tuple[Array, Array]:
        cell, rows = (jax.lax.dynamic_slice_in_dim(x, start, block) for x in (seen, features_PF))
        slot, found = cells.find(cell_V, cell)
        return jnp.where(found & (cell < no_cell), slot, cell_V.shape[0]), rows

    rows = cells.relocate(voxels.cell_of_slot_V, voxels.features_VF, cell_V, no_cell)
    rows = cells.maximum_over_blocks(rows, jnp.asarray(size, jnp.int32), size, read)
    return renewed(config, voxels, cell_V, rows, dropped, beyond)


def insert_frames(
    config: Memory,
    voxels: VoxelMap,
    frames: Frames,
    features_ThwF: Array,
    valid_T: Array | None = None,
) -> VoxelMap:
    """Insert T posed depth frames: upsampling, unprojection and maximum in one pass.

    The result equals upsampling the features to all pixels and inserting every pixel's point, up to
    rounding of the interpolation. The upsampled features are never stored (see ``voxel_frames``).
    The (T, h, w, F) features are those of a grid of patches that covers each frame; they are
    upsampled bilinearly in float32, patch centres at half-integers.

    Raises:
        UserError: frames, features and the map's channels do not fit together.
    """
    depth_THW = jnp.asarray(frames.depth_THW)
    count, channels = len(depth_THW), voxels.features_VF.shape[-1]
    shape = jnp.shape(features_ThwF)
    if len(shape) != 4 or (shape[0], shape[-1]) != (count, channels):
        raise UserError(
            f"insert_frames() got features of shape {shape} for {count} frames and a map of "
            f"{channels} channels; give ({count}, rows, columns, {channels})."
        )
    camera = jax.tree.map(jnp.asarray, frames.camera)
    valid_T = jnp.ones(count, bool) if valid_T is None else jnp.asarray(valid_T)
    seen, beyond = voxel_frames.pixel_cells(config, voxels.origin_3, depth_THW, camera, valid_T)
    cell_V, rows, dropped = voxel_frames.insert(
        config, voxels.cell_of_slot_V, voxels.features_VF, seen, jnp.asarray(features_ThwF)
    )
    return renewed(config, voxels, cell_V, rows, dropped, beyond)


def merge(config: Memory, a: VoxelMap, b: VoxelMap) -> VoxelMap:
    """Return the union of two maps of one world: the maximum where both have a cell.

    While everything fits, merging equals inserting the points of both into one map. The grid of
    ``a`` is kept, and its cells have precedence where the capacity is full; cells of ``b`` outside
    it are counted as outside, once per cell. Counts of dropped cells and of points outside are
    added.

    Raises:
        UserError: the grids are not shifted by whole cells (not checked under jit).
    """
    shift_3 = (b.origin_3 - a.origin_3) / np.asarray(config.cell_m, np.float32)
    if not isinstance(shift_3, Tracer) and not np.allclose(shift_3, np.round(shift_3), atol=1e-2):
        raise UserError(
            f"merge() got grids shifted by {np.asarray(shift_3)} cells; only whole cells can be "
            "merged."
        )
    points, features, valid = to_points(config, b)
    both = insert(config, a, points, features, valid)
    return dataclasses.replace(
        both, dropped=both.dropped + b.dropped, outside=both.outside + b.outside
    )


def to_points(config: Memory, voxels: VoxelMap) -> tuple[Array, Array, Array]:
    """Return all slots as ``(points_world_V3, features_VF, valid_V)``; free slots are 0."""
    valid = voxels.cell_of_slot_V < cells.nowhere(config)
    points = cells.centres(config, voxels.origin_3, jnp.where(valid, voxels.cell_of_slot_V, 0))
    features = jnp.where(valid[:, None], voxels.features_VF, 0)
    return jnp.where(valid[:, None], points, 0), features, valid


def tokens(config: Memory, voxels: VoxelMap, camera: Camera, size: tuple[int, int]) -> MapTokens:
    """Choose the M = ``memory.tokens`` cells that condition one clip of (T,) cameras.

    Cells that the cameras can see come first (``cells.choose``); ties go to the lower cell number.
    With fewer than M occupied cells, the remaining tokens are masked. ``size`` is the image's
    height and width in pixels.
    """
    points, features, valid = to_points(config, voxels)
    order = cells.choose(config, points, valid, camera, size)
    return MapTokens(features[order], points[order], valid[order])


def renewed(
    config: Memory,
    voxels: VoxelMap,
    cell_V: Array,
    features_VF: Array,
    dropped: Array | int = 0,
    outside: Array | int = 0,
) -> VoxelMap:
    """Return a map with new cells and features, and increased counts of dropped and outside."""
    return dataclasses.replace(
        voxels,
        cell_of_slot_V=cell_V,
        features_VF=features_VF,
        occupied=(cell_V < cells.nowhere(config)).sum(dtype=jnp.int32),
        dropped=voxels.dropped + dropped,
        outside=voxels.outside + outside,
    )


def export(
    config: Memory,
    voxels: VoxelMap,
    path: Path,
    *,
    style: Literal["cubes", "points"] = "cubes",
    colours_V3: Array | None = None,
) -> None:
    """Write the occupied cells with their colours to a file, atomically; its folder is created.

    The suffix ``.ply`` or ``.glb`` is the format. Colours, (V, 3) in [−1, 1] of all slots, are by
    default ``Encoder.colours``: the true colours if features are colours, else three principal
    components.

    Raises:
        UserError: the suffix is unknown, or the map is empty.
    """
    voxel_files.write(config, *to_points(config, voxels), path, style, colours_V3)


def erase(config: Memory, voxels: VoxelMap, box_23: Array) -> VoxelMap:
    """Erase the cells in a box, as if nothing had ever been observed there.

    Raises:
        UserError: the box is invalid.
    """
    return _only(config, voxels, ~_within(config, voxels, box_23))


def copy(config: Memory, voxels: VoxelMap, box_23: Array) -> VoxelMap:
    """Return a map of only the cells in a box; its counts of dropped and outside are 0.

    Raises:
        UserError: the box is invalid.
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
    exact. Cells that do not fit are counted as dropped, and cells whose centre leaves the grid as
    outside. The piece may be any map of the same cell size; ``transform`` is rigid, (4, 4), metres.

    Raises:
        UserError: the transform is not a rigid 4×4.
    """
    transform = cells.rigid(transform, "paste")
    no_cell, back = cells.nowhere(config), invert_rigid(transform)

    def source(cell: Array) -> tuple[Array, Array]:
        """Return the piece's slot that each cell of the map takes, and whether there is one."""
        centres = cells.centres(config, voxels.origin_3, jnp.where(cell < no_cell, cell, 0))
        origin = cells.keys(config, piece.origin_3, transform_points(back, centres))
        slot, found = cells.find(piece.cell_of_slot_V, origin)
        return slot, found & (origin < no_cell) & (cell < no_cell)

    points, _, valid = to_points(config, piece)
    moved = transform_points(transform, points)
    target = cells.keys(config, voxels.origin_3, moved)
    around = moved + _neighbours(config)[:, None]
    near = cells.keys(config, voxels.origin_3, around.reshape(-1, 3))
    near = jnp.where(jnp.tile(valid, len(around)), near, no_cell)
    cell_V, dropped = cells.admit(
        voxels.cell_of_slot_V, jnp.where(source(near)[1], near, no_cell), no_cell
    )

    old = cells.relocate(voxels.cell_of_slot_V, voxels.features_VF, cell_V, no_cell)
    slot, taken = source(cell_V)
    lowest = jnp.asarray(-jnp.inf, old.dtype)
    new = jnp.where(taken[:, None], piece.features_VF[slot].astype(old.dtype), lowest)
    outside = (valid & (target == no_cell)).sum(dtype=jnp.int32)
    return renewed(config, voxels, cell_V, jnp.maximum(old, new), dropped, outside)


def move(
    config: Memory,
    voxels: VoxelMap,
    box_23: Array,
    transform: Array,
    *,
    leave: bool = False,
) -> VoxelMap:
    """Move what is in a box by a rigid (4, 4) transform: copy, erase, paste.

    With ``leave`` the content also stays in place.

    Raises:
        UserError: the box is invalid, or the transform is not a rigid 4×4.
    """
    piece = copy(config, voxels, box_23)
    rest = voxels if leave else erase(config, voxels, box_23)
    return paste(config, rest, piece, transform)


def _within(config: Memory, voxels: VoxelMap, box_23: Array) -> Array:
    points, _, valid = to_points(config, voxels)
    return cells.within(points, valid, box_23)


def _only(config: Memory, voxels: VoxelMap, keep_V: Array) -> VoxelMap:
    no_cell = cells.nowhere(config)
    cell_V = jnp.sort(jnp.where(keep_V, voxels.cell_of_slot_V, no_cell))
    rows = cells.relocate(voxels.cell_of_slot_V, voxels.features_VF, cell_V, no_cell)
    return renewed(config, voxels, cell_V, rows)


def _neighbours(config: Memory) -> np.ndarray:
    """Return (O, 3) offsets, metres, to all cells whose centre a rotated cell can cover."""
    half_diagonal = math.dist(config.cell_m, (0, 0, 0)) / 2
    reach = [int(half_diagonal / size + 0.5) for size in config.cell_m]
    steps = itertools.product(*(range(-n, n + 1) for n in reach))
    return np.asarray(list(steps), np.float32) * np.asarray(config.cell_m, np.float32)


@dataclasses.dataclass(frozen=True)
class VoxelConfig(Memory):
    """The 3D feature map: the maximum of the features per cell (the paper)."""

    EDITABLE: ClassVar[bool] = True

    def empty(self, model: AssembledModel, centre_3: Array) -> VoxelMap:
        """Return an empty map."""
        del model
        return empty(self, centre_3, self.encoder.channels)

    def insert(
        self,
        model: AssembledModel,
        params: Params,
        memory: VoxelMap,
        frames: Frames,
        features_ThwF: Array,
        valid_T: Array | None = None,
        *,
        observed: bool = True,
    ) -> VoxelMap:
        """Insert the pixels of frames; see ``insert_frames``."""
        del model, params, observed
        return insert_frames(self.grid, memory, frames, features_ThwF, valid_T)

    def read(self, model: AssembledModel, memory: VoxelMap, camera: Camera) -> MapTokens:
        """Choose the cells that condition one clip; see ``tokens``."""
        return tokens(self.grid, memory, camera, (model.clip.height, model.clip.width))

    def to_points(self, model: AssembledModel, memory: VoxelMap) -> tuple[Array, Array, Array]:
        """Return centre, features and validity of all slots."""
        del model
        return to_points(self.grid, memory)

    def erase(self, model: AssembledModel, memory: VoxelMap, box_23: Array) -> VoxelMap:
        """Erase a box; see ``erase``."""
        del model
        return erase(self, memory, box_23)

    def move(
        self,
        model: AssembledModel,
        memory: VoxelMap,
        box_23: Array,
        transform: Array,
        *,
        leave: bool = False,
    ) -> VoxelMap:
        """Move or copy the content of a box; see ``move``."""
        del model
        return move(self, memory, box_23, transform, leave=leave)


@dataclasses.dataclass(frozen=True)
class Map2DConfig(VoxelConfig):
    """The feature map seen from above: a cell reaches from the floor to the ceiling.

    The baseline "2D map" of the paper's Table 1: a voxel map with one layer. Its tokens are at the
    height of the grid's centre.
    """

    EDITABLE: ClassVar[bool] = False
    erase = Memory.erase
    move = Memory.move

    @property
    def grid(self) -> Map2DConfig:
        """The settings of the voxel map with one layer."""
        (x, y, z), (nx, ny, nz) = self.cell_m, self.cells
        return dataclasses.replace(self, cell_m=(x, y, z * nz), cells=(nx, ny, 1))

    def empty(self, model: AssembledModel, centre_3: Array) -> VoxelMap:
        """Return an empty map whose layer is centred exactly on the given height.

        Snapped to multiples of the cell's height, the layer could miss the room.
        """
        del model
        voxels = empty(self.grid, centre_3, self.encoder.channels)
        bottom = jnp.asarray(centre_3, jnp.float32)[2] - self.grid.cell_m[2] / 2
        return dataclasses.replace(voxels, origin_3=voxels.origin_3.at[2].set(bottom))
