"""Grid cells shared by the memories: cell numbers, sorted lists of cells, boxes, choice of tokens.

A sparse map is a sorted list of cell numbers, free slots last, with one row of features per slot.
Cells are found by binary search, so time and memory use are independent of the grid's extent. Maps
with equal cells and features are equal bit for bit, whatever their history.

A box is (2, 3), its lower and upper corner in the world, metres; lower faces belong to it, upper
faces do not. A transform is a rigid (4, 4) matrix from old to new positions.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from pewm_jax.config import Memory, UserError
from pewm_jax.geometry.cameras import project, unproject
from pewm_jax.geometry.zbuffer import visible_first
from pewm_jax.types import Array, Camera, Frames

FAR_M = 1e4
"""Added to the distance of points that no camera sees, so that they come after all others."""


def origin(config: Memory, centre_3: Array) -> Array:
    """Return (3,) the lower corner of a grid around a world position, snapped to whole cells."""
    cell = np.asarray(config.cell_m, np.float32)
    half = np.asarray(config.cells, np.float32) * cell / 2
    return (jnp.round((jnp.asarray(centre_3) - half) / cell) * cell).astype(jnp.float32)


def keys(config: Memory, origin_3: Array, points_3: Array) -> Array:
    """Return (...,) int32: the cell number of each point (..., 3).

    Points outside the grid, and points with NaN, get the number of cells, which is no cell.
    """
    place = jnp.floor((points_3 - origin_3) / np.asarray(config.cell_m, np.float32))
    inside = jnp.all((place >= 0) & (place < np.asarray(config.cells, np.float32)), -1)
    x, y, z = (jnp.where(inside, place[..., i], 0).astype(jnp.int32) for i in range(3))
    _, ny, nz = config.cells
    return jnp.where(inside, (x * ny + y) * nz + z, math.prod(config.cells))


def corners(config: Memory, origin_3: Array, cell_P: Array) -> Array:
    """Return (P, 3) the lower corners of cells by their numbers, metres."""
    _, ny, nz = config.cells
    place = jnp.stack([cell_P // (ny * nz), cell_P // nz % ny, cell_P % nz], -1)
    return origin_3 + place.astype(jnp.float32) * np.asarray(config.cell_m, np.float32)


def centres(config: Memory, origin_3: Array, cell_V: Array) -> Array:
    """Return (V, 3) world centres of cell numbers (see ``keys``)."""
    _, ny, nz = config.cells
    grid = jnp.stack([cell_V // (ny * nz), cell_V // nz % ny, cell_V % nz], -1)
    return origin_3 + (grid + 0.5) * np.asarray(config.cell_m, np.float32)


def grid_of(height: int, width: int, most: int) -> tuple[int, int]:
    """Return rows and columns of an even grid over an image with at most ``most`` fields."""
    rows = min(max(int(math.sqrt(most * height / width)), 1), height, most)
    return rows, max(min(most // rows, round(rows * width / height), width), 1)


def sample(
    frames: Frames, rows: int, columns: int, valid_T: Array | None = None
) -> tuple[Array, Array, Array]:
    """Sample the pixels at the centres of an even grid over each of T frames.

    Returns:
        ``(points_TP3, rgb_TPC, valid_TP)``, P = rows × columns; pixels without depth, and those of
        frames where ``valid_T`` is False, are invalid.
    """
    count, height, width = frames.depth_THW.shape
    row = ((np.arange(rows) + 0.5) * height / rows).astype(int)
    column = ((np.arange(columns) + 0.5) * width / columns).astype(int)

    def take(image: Array) -> Array:
        picked = image[:, row][:, :, column]
        return picked.reshape(count, rows * columns, *image.shape[3:])

    depth = take(frames.depth_THW)
    valid = (depth > 0) & jnp.isfinite(depth)
    if valid_T is not None:
        valid = valid & valid_T[:, None]
    return take(unproject(frames.depth_THW, frames.camera)), take(frames.rgb_THWC), valid


def choose(
    config: Memory,
    points_V3: Array,
    valid_V: Array,
    camera: Camera,
    size: tuple[int, int],
    wide_V: Array | None = None,
) -> Array:
    """Return (≤ ``memory.tokens``,) indices of the (V, 3) points that condition one clip.

    By ``memory.choose``: points that the (T,) cameras can see first (``geometry.zbuffer``), or
    points in view by their distance (``in_view_first``). ``size`` is the images' height and width
    in pixels; ``wide_V`` are widths of the points, metres, by default those of a cell.
    """
    if config.choose == "nearest":
        return in_view_first(points_V3, valid_V, camera, size, config.tokens)
    wide = jnp.float32(max(config.cell_m[:2])) if wide_V is None else wide_V
    tall = jnp.float32(config.cell_m[2]) if wide_V is None else wide_V
    return visible_first(points_V3, wide, tall, valid_V, camera, size, config.tokens)


def in_view_first(
    points_P3: Array, valid_P: Array, camera: Camera, size: tuple[int, int], count: int
) -> Array:
    """Return (≤ count,) indices of points: first those in view of any camera, nearest first.

    The nearest is the one with the smallest depth in any camera. The others follow, by distance to
    the nearest camera; invalid points are last. Ties go to the lower index. Arguments as for
    ``choose``.
    """
    uv, z = project(points_P3[None], camera)
    seen = jnp.all((uv >= 0) & (uv <= np.array([size[1], size[0]], np.float32)), -1) & (z > 0)
    depth = jnp.where(seen, z, jnp.inf).min(0)
    centres = camera.world_from_camera[:, None, :3, 3]
    distance = jnp.linalg.norm(points_P3[None] - centres, axis=-1).min(0)
    score = jnp.where(jnp.isfinite(depth), depth, FAR_M + distance)
    score = jnp.where(valid_P, score, jnp.inf)
    return jax.lax.top_k(-score, min(count, points_P3.shape[0]))[1]


def nowhere(config: Memory) -> int:
    """Return the number that stands for no cell; it sorts after all cells."""
    return math.prod(config.cells)


def find(cell_V: Array, cell_P: Array) -> tuple[Array, Array]:
    """Look cells ``cell_P`` up in a sorted list ``cell_V``.

    Returns:
        ``(slot_P, found_P)``. If a cell is not found, its slot is where it would be inserted, or
        the last one.
    """
    slot = jnp.searchsorted(cell_V, cell_P, method="scan").astype(jnp.int32)
    slot = jnp.minimum(slot, cell_V.shape[0] - 1)
    return slot, cell_V[slot] == cell_P


def admit(cell_V: Array, cell_P: Array, no_cell: int) -> tuple[Array, Array]:
    """Add cells to a map's sorted list while there is room, in the order of their numbers.

    ``cell_P`` are cells in any order, with repetitions; ``no_cell`` marks free slots and no cell.

    Returns:
        ``(cell_V, dropped)``: the new list, and the number of distinct new cells that did not fit.
    """
    capacity = cell_V.shape[0]
    ordered = jnp.sort(cell_P)
    before = jnp.concatenate([jnp.full((1,), -1, ordered.dtype), ordered[:-1]])
    older, found = find(cell_V, ordered)
    new = (ordered != before) & (ordered < no_cell) & ~found
    rank = jnp.cumsum(new, dtype=jnp.int32)
    fits = new & (rank <= capacity - (cell_V < no_cell).sum(dtype=jnp.int32))
    # A new cell comes after all older and all new ones with lower numbers; older cells move up.
    place = jnp.where(fits, older + rank - 1, capacity)
    fresh = jnp.full((capacity,), -1, cell_V.dtype).at[place].set(ordered, mode="drop")
    moved = jnp.arange(capacity) - jnp.cumsum(fresh >= 0, dtype=jnp.int32)
    merged = jnp.where(fresh >= 0, fresh, cell_V[jnp.maximum(moved, 0)])
    return merged, (new & ~fits).sum(dtype=jnp.int32)


def relocate(old_V: Array, features_VF: Array, new_V: Array, no_cell: int) -> Array:
    """Move rows of features to the slots of a new sorted list; −inf where a cell is new."""
    slot, found = find(old_V, new_V)
    held = found & (new_V < no_cell)
    lowest = jnp.asarray(-jnp.inf, features_VF.dtype)
    return jnp.where(held[:, None], features_VF[slot], lowest)


def maximum_over_blocks(
    features_VF: Array, count: Array, size: int, read: Callable[[Array, int], tuple[Array, Array]]
) -> Array:
    """Scatter-max ``count`` ≤ ``size`` rows, block by block, so that only one block of rows exists.

    ``read(start, b)`` returns ``(slot_b, rows_bF)``, b rows from ``start`` on; rows with slot V are
    ignored. A row may be requested twice, and so may rows beyond ``count``. Maxima are computed in
    float32; rounding preserves order, so the result is that of the narrower dtype.
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
        cpu=lambda rows_VF, count: run(1024, rows_VF, count),
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


def within(points_V3: Array, valid_V: Array, box_23: Array) -> Array:
    """Return (V,) bool: which valid points (V, 3), metres, lie in a box.

    Raises:
        UserError: the box is invalid.
    """
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
    return valid_V & ((points_V3 >= box_23[0]) & (points_V3 < box_23[1])).all(-1)


def rigid(transform: Array | None, who: str) -> Array:
    """Return a rigid (4, 4) float32 transform; None is the identity. ``who`` is named in errors.

    Raises:
        UserError: it is not a rigid 4×4 (under jit only its shape is checked).
    """
    found = jnp.eye(4) if transform is None else jnp.asarray(transform, jnp.float32)
    if found.shape != (4, 4):
        raise UserError(f"{who}() got a transform of shape {found.shape}; give a rigid 4×4.")
    if not isinstance(found, Tracer) and not _is_rigid(np.asarray(found)):
        raise UserError(f"{who}() got a transform that is not rigid; give a rotation and a shift.")
    return found


def _is_rigid(transform: np.ndarray) -> bool:
    turn = transform[:3, :3]
    turns = np.allclose(turn @ turn.T, np.eye(3), atol=1e-4) and np.linalg.det(turn) > 0
    return bool(turns and (transform[3] == (0, 0, 0, 1)).all() and np.isfinite(transform).all())
