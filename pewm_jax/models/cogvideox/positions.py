"""Positions of video tokens: rotary angles, fixed sinusoids, a learned table.

Angles and sinusoids are computed on the host while tracing, from the configuration and the token
grid. Reference: ``get_3d_rotary_pos_embed``, ``get_resize_crop_region_for_grid``,
``get_3d_sincos_pos_embed`` and ``CogVideoXPatchEmbed`` of diffusers.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.models.cogvideox.config import DiTConfig
from pewm_jax.types import Array

Grid = tuple[int, int, int]
"""Tokens along time, height and width."""


def token_grid(config: DiTConfig, shape: tuple[int, ...]) -> Grid:
    """Return the token grid of latents (B, t, h, w, C).

    Raises:
        UserError: the network cannot take latents of this size.
    """
    if len(shape) != 5:
        raise UserError(f"The latents have shape {tuple(shape)}: give (batch, t, h, w, channels).")
    frames, height, width = shape[1:4]
    patch, patch_t = config.patch, config.patch_t
    if min(shape[:4]) < 1:
        raise UserError(f"The latents have shape {tuple(shape)}: no size may be 0.")
    if height % patch or width % patch:
        raise UserError(
            f"Latents of {height}×{width} do not split into {patch}×{patch} patches: use a "
            f"height and width that are multiples of {patch} (in pixels, times the VAE's 8)."
        )
    if frames % patch_t:
        raise UserError(
            f"{frames} latent frames do not split into patches of {patch_t}: repeat the first "
            f"latent frame {-frames % patch_t} times in front, as CogVideoX 1.5's pipelines do "
            "(and drop as many from the result), or choose another number of frames."
        )
    rows, columns = config.sample_height, config.sample_width
    _require_table(config, frames, height, width)
    bounded = config.positions == "rope_integer" and rows > 0 and columns > 0
    if bounded and (height // patch > rows // patch or width // patch > columns // patch):
        raise UserError(
            f"Latents of {height}×{width} are larger than the {rows}×{columns} that this "
            "network's positions go to: use a smaller video."
        )
    return frames // patch_t, height // patch, width // patch


def _require_table(config: DiTConfig, frames: int, height: int, width: int) -> None:
    """Refuse latents that a learned table is not for, unless another choice was made."""
    if config.positions != "rope_learned" or config.learned in ("interpolate", "drop"):
        return
    table = (config.sample_latents, config.sample_height, config.sample_width)
    if (height, width) != table[1:] or (config.learned == "exact" and frames != table[0]):
        raise UserError(
            f"This network's learned positions are a table for latents of {_size(table)} (time, "
            f"rows, columns), not {_size((frames, height, width))}: use that size, or set "
            "backbone.learned to interpolate or drop (when importing: --positions)."
        )


def _size(sizes: tuple[int, ...]) -> str:
    return "×".join(map(str, sizes))


def sample_grid(config: DiTConfig) -> Grid:
    """Return the token grid of the sample size."""
    rows, columns = config.sample_height // config.patch, config.sample_width // config.patch
    return config.sample_latents // config.patch_t, rows, columns


def sample_tokens(config: DiTConfig) -> int:
    """Return the number of video tokens at the size that the network was trained for."""
    return math.prod(sample_grid(config))


def add(config: DiTConfig, tokens_BND: Array, table_ND: Array | None, grid: Grid) -> Array:
    """Add the positions that are not rotary to text and video tokens: a table or a sinusoid.

    ``table_ND`` is the learned table of the sample size, if there is one.
    """
    length, dtype = tokens_BND.shape[1] - math.prod(grid), tokens_BND.dtype
    if config.positions == "rope_learned" and config.learned != "drop":
        assert table_ND is not None, "rope_learned comes with a table"
        if config.learned != "reference" or _of_sample_frames(config, grid):
            return tokens_BND + resized(config, table_ND, grid).astype(dtype)
    elif config.positions != "sincos":
        return tokens_BND
    return tokens_BND.at[:, length:].add(sincos_table(config, grid).astype(dtype))


def _of_sample_frames(config: DiTConfig, grid: Grid) -> bool:
    """Tell whether the reference takes a token grid for one of the sample's frames."""
    return config.temporal * (grid[0] - 1) + 1 == config.sample_frames


def resized(config: DiTConfig, table_ND: Array, grid: Grid) -> Array:
    """Return the learned table, its video part resized to a grid: (L + t·h·w, D).

    Linear in time, rows and columns, cell centres to cell centres (half a cell from the edges);
    for its own grid it is returned as it is.
    """
    own = sample_grid(config)
    if grid == own:
        return table_ND
    length, width = len(table_ND) - math.prod(own), table_ND.shape[1]
    video = table_ND[length:].reshape(*own, width)
    video = jax.image.resize(video, (*grid, width), "linear", antialias=False)
    return jnp.concatenate([table_ND[:length], video.reshape(-1, width)])


def crop_region(grid: tuple[int, int], base: tuple[int, int]) -> tuple[tuple[int, int], ...]:
    """Return (top, left), (bottom, right): the grid fitted into the middle of the base grid.

    Both are rows and columns of tokens; the network was trained for the base grid.
    """
    rows, columns = grid
    base_rows, base_columns = base
    if rows / columns > base_rows / base_columns:
        size = base_rows, round(base_rows / rows * columns)
    else:
        size = round(base_columns / columns * rows), base_columns
    top, left = (round((b - s) / 2) for b, s in zip(base, size, strict=True))
    return (top, left), (top + size[0], left + size[1])


def rope_places(config: DiTConfig, grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rotary positions along time, height and width."""
    if config.positions == "rope_integer":
        frames, rows, columns = (np.arange(n) for n in grid)
        return frames, rows, columns
    base = config.sample_height // config.patch, config.sample_width // config.patch
    start, stop = crop_region(grid[1:], base)
    rows, columns = (
        np.linspace(first, last * (n - 1) / n, n)
        for first, last, n in zip(start, stop, grid[1:], strict=True)
    )
    return np.arange(grid[0]), rows, columns


def rope_angles(
    frames: np.ndarray, rows: np.ndarray, columns: np.ndarray, head_dim: int
) -> np.ndarray:
    """Return (t·h·w, head_dim/2) rotary angles of the positions along time, height and width.

    Theta is 1e4; a head is split 1/4 time, 3/8 height, 3/8 width.
    """
    parts = (head_dim // 4, head_dim // 8 * 3, head_dim // 8 * 3)
    grid = np.meshgrid(frames, rows, columns, indexing="ij")
    angles = []
    for positions, channels in zip(grid, parts, strict=True):
        frequency = 1e4 ** (-np.arange(0, channels, 2) / channels)
        angles.append(positions.reshape(-1, 1) * frequency)
    return np.concatenate(angles, -1).astype(np.float32)


def joint_angles(config: DiTConfig, grid: Grid, length: int) -> np.ndarray | None:
    """Return (length + t·h·w, head_dim/2) rotary angles of text tokens (0) and video tokens.

    None if the network has no rotary embedding.
    """
    if config.positions == "sincos":
        return None
    angles = rope_angles(*rope_places(config, grid), config.head_dim)
    return np.concatenate([np.zeros((length, angles.shape[1]), np.float32), angles])


def sincos_table(config: DiTConfig, grid: Grid) -> np.ndarray:
    """Return (t·h·w, D): 1/4 of the channels encode the time, 3/8 the column, 3/8 the row."""
    frames, rows, columns = (np.arange(n) for n in grid)
    places = (
        frames / config.temporal_interpolation,
        columns / config.spatial_interpolation,
        rows / config.spatial_interpolation,
    )
    channels = (config.width // 4, config.width // 8 * 3, config.width // 8 * 3)
    along_t, along_w, along_h = (_wave(p, c) for p, c in zip(places, channels, strict=True))
    table = np.empty((*grid, config.width), np.float32)
    first, second = channels[0], channels[0] + channels[1]
    table[..., :first] = along_t[:, None, None]
    table[..., first:second] = along_w
    table[..., second:] = along_h[:, None]
    return table.reshape(-1, config.width)


def _wave(places: np.ndarray, channels: int) -> np.ndarray:
    """Return (n, channels): sines, then cosines."""
    half = channels // 2
    angle = places[:, None] * 1e4 ** (-np.arange(half) / half)
    return np.concatenate([np.sin(angle), np.cos(angle)], -1)
