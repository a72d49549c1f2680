"""Inserting frames into a voxel map in one fused pass, without storing upsampled features.

Two facts make it fast:

* Only a pixel's cell has to be computed for every pixel, directly from depth and camera.
* Between four neighbouring patch centres the upsampled features are bilinear, hence monotonic along
  each row and each column of pixels. Within such a square, the maximum over the pixels of a cell is
  therefore reached at a pixel that is the end of both its horizontal and its vertical run of pixels
  of that cell. Only these *corner* pixels are interpolated: four of 14 × 14 pixels on one wall.

Both hold for any depth image. On noise every pixel is a corner, and all are interpolated.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import Memory
from pewm_jax.memory import cells
from pewm_jax.types import Array, Camera

WORTH_A_BRANCH = 8192
"""Number of corner pixels from which a separate branch, with a shorter sort, pays off."""


def pixel_cells(config: Memory, origin_3: Array, depth_THW: Array, camera: Camera) -> Array:
    """Return (T, H, W) int32, the cell of each pixel's surface point (see ``cells.keys``).

    The result equals unprojecting depth (metres) to points first, but takes one pass and stores no
    points.
    """
    _, height, width = depth_THW.shape
    fx, fy, cx, cy = (camera.intrinsics_4[:, i, None, None] for i in range(4))
    x = (np.arange(width, dtype=np.float32) + 0.5 - cx) / fx * depth_THW
    y = (np.arange(height, dtype=np.float32)[:, None] + 0.5 - cy) / fy * depth_THW
    pose = camera.world_from_camera[:, :3, :, None, None]
    cell = jnp.zeros(depth_THW.shape, jnp.int32)
    inside = jnp.ones(depth_THW.shape, bool)
    for axis, (size, count) in enumerate(zip(config.cell_m, config.cells, strict=True)):
        row = pose[:, axis]
        world = row[:, 0] * x + row[:, 1] * y + row[:, 2] * depth_THW + row[:, 3]
        place = jnp.floor((world - origin_3[axis]) / np.float32(size))
        within = (place >= 0) & (place < count)
        inside = inside & within
        cell = cell * count + jnp.where(within, place, 0).astype(jnp.int32)
    return jnp.where(inside, cell, cells.nowhere(config))


def corners(cell_THW: Array, square_H: np.ndarray, square_W: np.ndarray) -> Array:
    """Return (T, H, W) bool: pixels that end both their horizontal and their vertical run.

    A run is a sequence of neighbouring pixels of the same cell and the same square: ``square_H``
    and ``square_W`` are the indices of the patch centres before each row and column of pixels.
    """
    down = (cell_THW[:, 1:] == cell_THW[:, :-1]) & (square_H[1:] == square_H[:-1])[:, None]
    right = (cell_THW[:, :, 1:] == cell_THW[:, :, :-1]) & (square_W[1:] == square_W[:-1])
    down = jnp.pad(down, ((0, 0), (1, 1), (0, 0)))
    right = jnp.pad(right, ((0, 0), (0, 0), (1, 1)))
    inside_column, inside_row = down[:, 1:] & down[:, :-1], right[:, :, 1:] & right[:, :, :-1]
    return ~inside_column & ~inside_row


def between(pixels: int, patches: int) -> tuple[np.ndarray, np.ndarray]:
    """Locate pixel centres between patch centres along one side of an image.

    Returns:
        ``(square, share)``: the index of the patch centre at or before each pixel centre, from −1
        to patches − 1; and the distance from it, as a share [0, 1) of the distance to the next one.
    """
    place = (np.arange(pixels) + 0.5) * patches / pixels - 0.5
    square = np.floor(place)
    return square.astype(np.int32), (place - square).astype(np.float32)


def compact(mask_THW: Array) -> tuple[Array, Array]:
    """Return the linear indices of the True pixels, padded with P, and their number."""
    frames, _, width = mask_THW.shape
    size = mask_THW.size
    # Sums run down all columns at once, which is much faster on a CPU than along rows.
    rank = jax.lax.platform_dependent(
        mask_THW, cpu=_running_sum, default=lambda mask: jnp.cumsum(mask, 1, dtype=jnp.int32)
    )
    total = rank[:, -1].reshape(-1)
    until = jnp.cumsum(total)
    place = (until - total).reshape(frames, 1, width) + rank - 1
    place = jnp.where(mask_THW, place, size).reshape(-1)
    index = jnp.full((size,), size, jnp.int32)
    index = index.at[place].set(jnp.arange(size, dtype=jnp.int32), mode="drop")
    return index, until[-1]


def _running_sum(mask_THW: Array) -> Array:
    """Return (T, H, W) int32: the cumulative number of True pixels down each column."""
    frames, _, width = mask_THW.shape

    def add(above_TW: Array, row_TW: Array) -> tuple[Array, Array]:
        below_TW = above_TW + row_TW
        return below_TW, below_TW

    start = jnp.zeros((frames, width), jnp.int32)
    return jnp.moveaxis(jax.lax.scan(add, start, jnp.moveaxis(mask_THW, 1, 0))[1], 0, 1)


def insert(
    config: Memory,
    cell_V: Array,
    features_VF: Array,
    cell_THW: Array,
    features_ThwF: Array,
) -> tuple[Array, Array, Array]:
    """Insert the upsampled features of pixels, whose cells are ``cell_THW``, into sorted cells.

    Pixels with the cell ``nowhere`` are ignored.

    Returns:
        ``(cell_V, features_VF, dropped)``.
    """
    no_cell = cells.nowhere(config)
    _, height, width = cell_THW.shape
    _, rows, columns, channels = features_ThwF.shape
    (square_H, down_H), (square_W, right_W) = between(height, rows), between(width, columns)
    index, count = compact(corners(cell_THW, square_H, square_W) & (cell_THW < no_cell))
    flat = cell_THW.reshape(-1)

    def admitted(most: int) -> tuple[Array, Array]:
        seen = flat.at[index[:most]].get(mode="fill", fill_value=no_cell)
        return cells.admit(cell_V, seen, no_cell)

    few = flat.shape[0] // 8
    if few < WORTH_A_BRANCH:
        new_V, dropped = admitted(flat.shape[0])
    else:
        new_V, dropped = jax.lax.cond(
            cells.largest_of_batch(count) <= few,
            lambda: admitted(few),
            lambda: admitted(flat.shape[0]),
        )
    patches = features_ThwF.reshape(-1, channels).astype(jnp.float32)
    square_H, square_W, down_H, right_W = map(jnp.asarray, (square_H, square_W, down_H, right_W))

    def read(start: Array, block: int) -> tuple[Array, Array]:
        listed = jax.lax.dynamic_slice_in_dim(index, start, block)
        pixel = jnp.minimum(listed, flat.shape[0] - 1)
        slot, found = cells.find(new_V, flat[pixel])
        slot = jnp.where(found & (listed < flat.shape[0]), slot, new_V.shape[0])
        frame, v, u = pixel // (height * width), pixel // width % height, pixel % width
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
    rows_VF = cells.maximum_over_blocks(moved, count, flat.shape[0], read)
    return new_V, rows_VF, dropped
