"""Frames into a voxel map in one fused pass that never holds upsampled features.

Two facts make it fast:

* Only places are computed for every pixel: its cell, straight from depth and camera.
* Between four neighbouring patch centres the upsampled features are bilinear: along a row or a
  column of pixels they rise or fall steadily. So within one such square the maximum over the
  pixels of a cell is taken at a pixel that ends both its row and its column of pixels of that cell
  (from any other one can walk on without falling). Only these *corner* pixels are interpolated:
  of 14 × 14 pixels on one wall, four.

Both hold for any depth image; on noise every pixel is a corner, and all are interpolated.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import MemorySettings
from pewm_jax.memory import voxel_cells
from pewm_jax.types import Array, Camera

WORTH_A_BRANCH = 8192
"""Pixels from which on few corner pixels are sorted by a program of their own."""


def pixel_cells(config: MemorySettings, origin_3: Array, depth_THW: Array, camera: Camera) -> Array:
    """Return (T, H, W) int32, the cell each pixel's surface lies in, as ``cells.keys`` numbers it.

    The same as unprojecting to points first, but one pass over the pixels without them.

    Args:
        config: cell size and extent.
        origin_3: (3,) lower corner of the grid, metres.
        depth_THW: (T, H, W) depth, metres.
        camera: (T,) cameras.
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
        here = (place >= 0) & (place < count)
        inside = inside & here
        cell = cell * count + jnp.where(here, place, 0).astype(jnp.int32)
    return jnp.where(inside, cell, voxel_cells.nowhere(config))


def corners(cell_THW: Array, square_H: np.ndarray, square_W: np.ndarray) -> Array:
    """Return (T, H, W) bool: pixels that end both their row and their column.

    Args:
        cell_THW: (T, H, W) cell of each pixel.
        square_H: (H,) between which rows of patch centres a row of pixels lies.
        square_W: (W,) between which columns of patch centres a column of pixels lies.
    """
    down = (cell_THW[:, 1:] == cell_THW[:, :-1]) & (square_H[1:] == square_H[:-1])[:, None]
    right = (cell_THW[:, :, 1:] == cell_THW[:, :, :-1]) & (square_W[1:] == square_W[:-1])
    down = jnp.pad(down, ((0, 0), (1, 1), (0, 0)))
    right = jnp.pad(right, ((0, 0), (0, 0), (1, 1)))
    inside_column, inside_row = down[:, 1:] & down[:, :-1], right[:, :, 1:] & right[:, :, :-1]
    return ~inside_column & ~inside_row


def between(pixels: int, patches: int) -> tuple[np.ndarray, np.ndarray]:
    """Place pixel centres between patch centres along one side of an image.

    Returns:
        ``(square, share)``: the patch centre at or before each pixel centre, from −1 (before the
        first one) to patches − 1, and how far the pixel is on the way to the next one, [0, 1).
    """
    place = (np.arange(pixels) + 0.5) * patches / pixels - 0.5
    square = np.floor(place)
    return square.astype(np.int32), (place - square).astype(np.float32)


def compact(mask_THW: Array) -> tuple[Array, Array]:
    """List the True pixels.

    Returns:
        ``(index_P, count)``: linear pixel indices, the True ones first, P after them; and how many.
    """
    frames, _, width = mask_THW.shape
    size = mask_THW.size
    # Down the columns, all of them at once: on a processor far cheaper than along the rows.
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
    """Return (T, H, W) int32: how many are True down to here in each column."""
    frames, _, width = mask_THW.shape

    def add(above_TW: Array, row_TW: Array) -> tuple[Array, Array]:
        below_TW = above_TW + row_TW
        return below_TW, below_TW

    start = jnp.zeros((frames, width), jnp.int32)
    return jnp.moveaxis(jax.lax.scan(add, start, jnp.moveaxis(mask_THW, 1, 0))[1], 0, 1)


def insert(
    config: MemorySettings,
    cell_V: Array,
    features_VF: Array,
    cell_THW: Array,
    features_ThwF: Array,
) -> tuple[Array, Array, Array]:
    """Insert the upsampled features of pixels into sorted cells.

    Args:
        config: gives the number that stands for no cell.
        cell_V: (V,) the cells of the map.
        features_VF: (V, F) their features.
        cell_THW: (T, H, W) the cell of each pixel, ``nowhere`` where it counts for nothing.
        features_ThwF: (T, h, w, F) patch features.

    Returns:
        ``(cell_V, features_VF, dropped)``.
    """
    none = voxel_cells.nowhere(config)
    _, height, width = cell_THW.shape
    _, rows, columns, channels = features_ThwF.shape
    (square_H, down_H), (square_W, right_W) = between(height, rows), between(width, columns)
    index, count = compact(corners(cell_THW, square_H, square_W) & (cell_THW < none))
    flat = cell_THW.reshape(-1)

    def admitted(most: int) -> tuple[Array, Array]:
        seen = flat.at[index[:most]].get(mode="fill", fill_value=none)
        return voxel_cells.admit(cell_V, seen, none)

    few = flat.shape[0] // 8
    if few < WORTH_A_BRANCH:
        new_V, dropped = admitted(flat.shape[0])
    else:
        new_V, dropped = jax.lax.cond(
            voxel_cells.largest_of_batch(count) <= few,
            lambda: admitted(few),
            lambda: admitted(flat.shape[0]),
        )
    patches = features_ThwF.reshape(-1, channels).astype(jnp.float32)
    square_H, square_W, down_H, right_W = map(jnp.asarray, (square_H, square_W, down_H, right_W))

    def read(start: Array, block: int) -> tuple[Array, Array]:
        listed = jax.lax.dynamic_slice_in_dim(index, start, block)
        pixel = jnp.minimum(listed, flat.shape[0] - 1)
        slot, found = voxel_cells.find(new_V, flat[pixel])
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
        # Computed once per pixel, not again for each of its features.
        slot, places, weights = jax.lax.optimization_barrier((slot, places, weights))
        return slot, sum(
            patches.at[place].get(mode="promise_in_bounds") * weight[:, None]
            for place, weight in zip(places, weights, strict=True)
        )

    moved = voxel_cells.relocate(cell_V, features_VF, new_V, none)
    rows_VF = voxel_cells.maximum_over_blocks(moved, count, flat.shape[0], read)
    return new_V, rows_VF, dropped
