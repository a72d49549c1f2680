"""Inserting frames into a voxel map in one fused pass, without storing upsampled features.

Three facts make it fast:

* Only a pixel's cell has to be computed for every pixel, directly from depth and camera.
* Between four neighbouring patch centres the upsampled features are bilinear, hence monotonic along
  each row and each column of pixels. Within such a square, the maximum over the pixels of a cell is
  therefore reached at a pixel that is the end of both its horizontal and its vertical run of pixels
  of that cell. Only these *corner* pixels are interpolated: four of 14 × 14 pixels on one wall.
* The cells of a frame are those of its *first* pixels, corners whose left and upper neighbours are
  of other cells: the leftmost pixel in a cell's uppermost row is one. Only their cells are sorted.

All hold for any depth image. On noise every pixel is a corner, and all are interpolated.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import Memory
from pewm_jax.memory import cells
from pewm_jax.types import Array, Camera

BLOCK = 32
"""Number of elements that one product with a triangular matrix sums up (``running_sum``)."""
SHORT = (8, 64)
"""The shares of pixels, 1 / n, that may be corners and first pixels for shorter lists to sort."""
WORTH_A_BRANCH = 1024
"""Number of first pixels from which shorter lists pay off."""


def pixel_cells(
    config: Memory, origin_3: Array, depth_THW: Array, camera: Camera, valid_T: Array
) -> tuple[Array, Array]:
    """Return (T, H + 2, W + 2) int32, the cells of pixels within a border of −1; how many outside.

    Pixels without depth and those of invalid frames have the cell ``nowhere``, as have points
    outside the grid (see ``cells.keys``); only the latter are counted. The result equals
    unprojecting depth (metres) to points first, but takes one pass and stores no points.
    """
    frames, height, width = depth_THW.shape
    pixel_W = np.arange(width, dtype=np.float32) + 0.5
    pixel_H = np.arange(height, dtype=np.float32)[:, None] + 0.5

    def add(frame: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
        cells_THW, outside = found
        depth_HW = depth_THW[frame]
        fx, fy, cx, cy = camera.intrinsics_4[frame]
        x, y = (pixel_W - cx) / fx * depth_HW, (pixel_H - cy) / fy * depth_HW
        cell_HW = jnp.zeros((height, width), jnp.int32)
        inside = jnp.ones((height, width), bool)
        for axis, (size, count) in enumerate(zip(config.cell_m, config.cells, strict=True)):
            row = camera.world_from_camera[frame, axis]
            world = row[0] * x + row[1] * y + row[2] * depth_HW + row[3]
            place = jnp.floor((world - origin_3[axis]) / np.float32(size))
            within = (place >= 0) & (place < count)
            inside = inside & within
            cell_HW = cell_HW * count + jnp.where(within, place, 0).astype(jnp.int32)
        valid = (depth_HW > 0) & valid_T[frame]
        cell_HW = jnp.where(valid & inside, cell_HW, cells.nowhere(config))
        cells_THW = jax.lax.dynamic_update_slice(cells_THW, cell_HW[None], (frame, 1, 1))
        return cells_THW, outside + (valid & ~inside).sum(dtype=jnp.int32)

    # One frame at a time: XLA's CPU backend computes elementwise functions again in everything that
    # reads them, but stores what a loop carries; and one frame fits into the cache.
    border = jnp.full((frames, height + 2, width + 2), -1, jnp.int32)
    return jax.lax.fori_loop(0, frames, add, (border, jnp.zeros((), jnp.int32)))


def corners(cell_THW: Array, square_H: np.ndarray, square_W: np.ndarray, no_cell: int) -> Array:
    """Return (T, H, W) int32: 2 at first pixels, 1 at the other corner pixels, 0 elsewhere.

    A corner pixel ends both its horizontal and its vertical run, and a first pixel is one whose
    left and upper neighbours have other cells. A run is a sequence of neighbouring pixels of the
    same cell and the same square: ``square_H`` and ``square_W`` are the indices of the patch
    centres before each row and column of pixels. Pixels of ``no_cell`` are 0. ``cell_THW`` has a
    border of one pixel (see ``pixel_cells``).
    """
    same_H, same_W = square_H[1:] == square_H[:-1], square_W[1:] == square_W[:-1]
    inner_H = (np.append(False, same_H) & np.append(same_H, False))[:, None]
    inner_W = np.append(False, same_W) & np.append(same_W, False)

    def add(frame: Array, found_THW: Array) -> Array:
        cell_HW = cell_THW[frame]
        cell = cell_HW[1:-1, 1:-1]
        above, below = cell == cell_HW[:-2, 1:-1], cell == cell_HW[2:, 1:-1]
        left, right = cell == cell_HW[1:-1, :-2], cell == cell_HW[1:-1, 2:]
        inside = (above & below & inner_H) | (left & right & inner_W)
        kind = jnp.where(inside, 0, jnp.where(above | left, 1, 2))
        kind = jnp.where(cell < no_cell, kind, 0).astype(jnp.int32)
        return jax.lax.dynamic_update_slice(found_THW, kind[None], (frame, 0, 0))

    frames, height, width = cell_THW.shape
    found_THW = jnp.zeros((frames, height - 2, width - 2), jnp.int32)
    return jax.lax.fori_loop(0, frames, add, found_THW)


def between(pixels: int, patches: int) -> tuple[np.ndarray, np.ndarray]:
    """Locate pixel centres between patch centres along one side of an image.

    Returns:
        ``(square, share)``: the index of the patch centre at or before each pixel centre, from −1
        to patches − 1; and the distance from it, as a share [0, 1) of the distance to the next one.
    """
    place = (np.arange(pixels) + 0.5) * patches / pixels - 0.5
    square = np.floor(place)
    return square.astype(np.int32), (place - square).astype(np.float32)


def running_sum(x_N: Array) -> Array:
    """Return (N,) float32, the cumulative sum of small integers, exact up to 2²⁴.

    Blocks are summed up by products with a triangular matrix, which is faster on a CPU than XLA's
    own cumulative sum.
    """
    size = x_N.shape[0]
    x_NB = jnp.pad(x_N.astype(jnp.float32), (0, -size % BLOCK)).reshape(-1, BLOCK)
    upper_BB = np.triu(np.ones((BLOCK, BLOCK), np.float32))
    sums_NB = jnp.matmul(x_NB, upper_BB, precision=jax.lax.Precision.HIGHEST)
    if len(sums_NB) > 1:
        total_N = sums_NB[:, -1]
        sums_NB += (running_sum(total_N) - total_N)[:, None]
    return sums_NB.reshape(-1)[:size]


def compact(mask_N: Array, values_N: Array, room: int, fill: int) -> tuple[Array, Array]:
    """Return the values where a mask is True, in ``room`` places padded with ``fill``; how many."""
    rank = running_sum(mask_N).astype(jnp.int32)
    place = jnp.where(mask_N, rank - 1, room)
    return jnp.full((room,), fill, jnp.int32).at[place].set(values_N, mode="drop"), rank[-1]


def insert(
    config: Memory,
    cell_V: Array,
    features_VF: Array,
    cell_THW: Array,
    features_ThwF: Array,
) -> tuple[Array, Array, Array]:
    """Insert the upsampled features of pixels, whose cells are ``cell_THW``, into sorted cells.

    ``cell_THW`` are those of ``pixel_cells``; pixels with the cell ``nowhere`` are ignored.

    Returns:
        ``(cell_V, features_VF, dropped)``.
    """
    no_cell = cells.nowhere(config)
    frames, height, width = cell_THW.shape[0], cell_THW.shape[1] - 2, cell_THW.shape[2] - 2
    _, rows, columns, channels = features_ThwF.shape
    (square_H, down_H), (square_W, right_W) = between(height, rows), between(width, columns)
    each = height * width
    size = frames * each
    kind_TP = corners(cell_THW, square_H, square_W, no_cell).reshape(frames, each)

    def list_corners(frame: Array, found: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        """Append the linear indices of a frame's corners; of its first pixels, the complement."""
        index_P, count, firsts = found
        kind_P = kind_TP[frame]
        pixel = frame * each + jnp.arange(each, dtype=jnp.int32)
        listed, more = compact(kind_P > 0, jnp.where(kind_P > 1, ~pixel, pixel), each, size)
        index_P = jax.lax.dynamic_update_slice(index_P, listed, (count,))
        return index_P, count + more, firsts + (kind_P > 1).sum(dtype=jnp.int32)

    zero = jnp.zeros((), jnp.int32)
    start = jnp.full((size,), size, jnp.int32), zero, zero
    index_P, count, firsts = jax.lax.fori_loop(0, frames, list_corners, start)

    def place_of(pixel: Array) -> tuple[Array, Array, Array]:
        return pixel // each, pixel // width % height, pixel % width

    def cells_of(pixel: Array) -> Array:
        frame, v, u = place_of(pixel)
        return cell_THW[frame, v + 1, u + 1]

    def admitted(listed: Array) -> tuple[Array, Array]:
        """Add the cells of first pixels, which are negative in the list."""
        seen = jnp.where(listed < 0, cells_of(~listed), no_cell)
        return cells.admit(cell_V, seen, no_cell)

    corner_room, first_room = (size // share for share in SHORT)
    if first_room < WORTH_A_BRANCH:
        new_V, dropped = admitted(index_P)
    else:
        few = index_P[:corner_room]
        longer = jnp.where(firsts <= first_room, 0, 1)
        new_V, dropped = jax.lax.switch(
            cells.largest_of_batch(jnp.where(count <= corner_room, longer, 2)),
            (
                lambda: admitted(compact(few < 0, few, first_room, size)[0]),
                lambda: admitted(few),
                lambda: admitted(index_P),
            ),
        )
    patches = features_ThwF.reshape(-1, channels).astype(jnp.float32)
    square_H, square_W, down_H, right_W = map(jnp.asarray, (square_H, square_W, down_H, right_W))

    def read(start: Array, block: int) -> tuple[Array, Array]:
        listed = jax.lax.dynamic_slice_in_dim(index_P, start, block)
        pixel = jnp.minimum(jnp.where(listed < 0, ~listed, listed), size - 1)
        slot, found = cells.find(new_V, cells_of(pixel))
        slot = jnp.where(found & (listed < size), slot, new_V.shape[0])
        frame, v, u = place_of(pixel)
        down, right = down_H[v], right_W[u]
        above, left = square_H[v], square_W[u]
        weights = [(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right]
        places = [
            (frame * rows + jnp.clip(above + i, 0, rows - 1)) * columns
            + jnp.clip(left + j, 0, columns - 1)
            for i in (0, 1)
            for j in (0, 1)
        ]
        # The barrier keeps XLA from recomputing these for every feature of a pixel.
        slot, places, weights = jax.lax.optimization_barrier((slot, places, weights))
        return slot, sum(
            patches.at[place].get(mode="promise_in_bounds") * weight[:, None]
            for place, weight in zip(places, weights, strict=True)
        )

    moved = cells.relocate(cell_V, features_VF, new_V, no_cell)
    rows_VF = cells.maximum_over_blocks(moved, count, size, read)
    return new_V, rows_VF, dropped
