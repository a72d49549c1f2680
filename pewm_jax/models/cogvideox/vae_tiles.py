"""Process a video in overlapping spatial tiles, and blend them.

Tiles need less memory than whole frames. The result differs slightly, since norms and borders see
only a tile. Tiles of equal shape share one compiled body and run one after another. Reference:
``tiled_encode`` and ``tiled_decode`` of ``AutoencoderKLCogVideoX`` in diffusers.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import VAEConfig
from pewm_jax.types import Array

_log = logging.getLogger(__name__)


def in_tiles(
    whole: Callable[[Array], Array], x_BTHWC: Array, config: VAEConfig, *, shrink: bool
) -> Array:
    """Apply ``whole`` to the tiles of a video and blend, or to a video no larger than a tile.

    Args:
        whole: (B, T, H, W, C) → (B, T', H', W', C').
        x_BTHWC: the video, or the latents.
        config: the autoencoder; without ``config.tiling`` the video is not split.
        shrink: whether ``whole`` encodes (pixels in, latents out) or decodes.

    Returns:
        What ``whole`` would return, up to effects at tile borders. If tiles do not overlap by a
        whole number of latents, the size differs, as in the reference, and a warning is logged.
    """
    pixels = config.tile_pixels
    latents = tuple(size // config.spatial for size in pixels)
    tile, out = (pixels, latents) if shrink else (latents, pixels)
    size = x_BTHWC.shape[2:4]
    if not config.tiling or (size[0] <= tile[0] and size[1] <= tile[1]):
        return whole(x_BTHWC)
    overlap = (config.tile_overlap_height, config.tile_overlap_width)
    steps = [int(n * (1 - share)) for n, share in zip(tile, overlap, strict=True)]
    blend = [int(n * share) for n, share in zip(out, overlap, strict=True)]
    keep = [n - extent for n, extent in zip(out, blend, strict=True)]
    starts = [list(range(0, n, step)) for n, step in zip(size, steps, strict=True)]

    tiles = _run(whole, x_BTHWC, starts, tile)
    rows = []
    for i in range(len(starts[0])):
        row = []
        for j in range(len(starts[1])):
            if i > 0:
                tiles[i, j] = _fade(tiles[i - 1, j], tiles[i, j], blend[0], axis=2)
            if j > 0:
                tiles[i, j] = _fade(tiles[i, j - 1], tiles[i, j], blend[1], axis=3)
            row.append(tiles[i, j][:, :, : keep[0], : keep[1]])
        rows.append(jnp.concatenate(row, 3))
    joined = jnp.concatenate(rows, 2)
    side = config.spatial
    wanted = tuple(n // side if shrink else n * side for n in size)
    if joined.shape[2:4] != wanted:
        _log.warning(
            "tiles of %d×%d pixels that overlap by shares of %.3g and %.3g do not join on whole "
            "latents: the result is %d×%d, not %d×%d; choose tiles whose overlap is a whole number "
            "of %d pixels, as 240×360 with 1/6 and 1/5.",
            *(*pixels, *overlap, *joined.shape[2:4], *wanted, side),
        )
    return joined


def _run(
    whole: Callable[[Array], Array],
    x_BTHWC: Array,
    starts: list[list[int]],
    tile: tuple[int, ...],
) -> dict[tuple[int, int], Array]:
    """Apply ``whole`` to every tile, with one ``lax.map`` per shape of tile."""
    height, width = x_BTHWC.shape[2:4]
    shapes: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for i, top in enumerate(starts[0]):
        for j, left in enumerate(starts[1]):
            shape = (min(tile[0], height - top), min(tile[1], width - left))
            shapes.setdefault(shape, []).append((i, j))
    tiles = {}
    for shape, places in shapes.items():
        corners = np.array([(starts[0][i], starts[1][j]) for i, j in places])

        def process(corner: Array, shape: tuple[int, int] = shape) -> Array:
            cut = jax.lax.dynamic_slice_in_dim(x_BTHWC, corner[0], shape[0], 2)
            return whole(jax.lax.dynamic_slice_in_dim(cut, corner[1], shape[1], 3))

        tiles.update(zip(places, jax.lax.map(process, jnp.asarray(corners)), strict=True))
    return tiles


def _fade(before: Array, after: Array, extent: int, axis: int) -> Array:
    """Blend the end of one tile linearly into the start of the next."""
    extent = min(before.shape[axis], after.shape[axis], extent)
    if extent == 0:
        return after
    shape = [1] * after.ndim
    shape[axis] = extent
    share = jnp.asarray(np.arange(extent).reshape(shape) / extent, after.dtype)
    end = jax.lax.slice_in_dim(before, before.shape[axis] - extent, None, axis=axis)
    start = jax.lax.slice_in_dim(after, 0, extent, axis=axis)
    rest = jax.lax.slice_in_dim(after, extent, None, axis=axis)
    return jnp.concatenate([end * (1 - share) + start * share, rest], axis)
