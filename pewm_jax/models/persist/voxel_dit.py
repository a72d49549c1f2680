"""The world-frame transformer of PERSIST: it predicts a voxel frame from those before it.

A frame is a cube of latents of ``voxel_vae``. Each of its tokens attends to the others of the
frame, to the same position in earlier frames, and to patches of an image's latents. Each frame has
its own time (diffusion forcing), an action, and optionally the camera of its image; together they
modulate the frame's tokens (arXiv 2603.03482).

The grid is aligned with the world's axes and moves with the agent, so a grid position is not a
world position: the network has to shift its memory.

With ``map_embed`` the cells that the map holds are a further input, with a mask beside them:
unknown, guessed or observed. This is not published; the network then completes what was observed,
and may revise guesses.

Parameters: ``patch_embed, pixel_embed, no_pixels, time_embed, action, camera, blocks (stacked over
layers), modulate_out, proj_out``; ``map_ids``, ``map_mask`` and ``map_fold`` with ``map_embed``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp

from pewm_jax.errors import UserError
from pewm_jax.models.persist import blocks as frame_blocks
from pewm_jax.models.persist.blocks import FrameCache
from pewm_jax.models.persist.config import VoxelDiTConfig
from pewm_jax.nn.layers import linear
from pewm_jax.nn.parameters import Leaf
from pewm_jax.nn.parameters import linear as linear_leaves
from pewm_jax.nn.tokens import patchify, unpatchify
from pewm_jax.types import Array, Params

PARTS = ("space", "time", "cross")
SHARDING = frame_blocks.rules("voxel_dit")
"""Rules over the paths of its parameters under ``voxel_dit``."""
ABSENT, GUESS, SEEN = 0, 1, 2
"""States of a cell in the mask beside the map: unknown, guessed, observed."""
STATES = 3


def ends(config: VoxelDiTConfig) -> Iterator[Leaf]:
    """Yield path and shape of the parameters around the blocks."""
    width, latents = config.blocks.width, math.prod(config.patches)
    cells = config.latent_channels * latents
    yield from linear_leaves("patch_embed", cells, width)
    yield from linear_leaves("pixel_embed", config.pixel_channels * config.pixel_patch**2, width)
    yield "no_pixels/bias", (width,)
    yield from frame_blocks.mlp_shapes("action", config.actions, width)
    yield from frame_blocks.end_shapes(width, cells)
    if config.camera_numbers:
        yield from frame_blocks.mlp_shapes("camera", config.camera_numbers, width)
    if config.map_embed:
        folded = latents * config.map_cells**3 * config.map_embed
        yield "map_ids/kernel", (config.map_ids, config.map_embed)
        yield "map_mask/kernel", (STATES, config.map_embed)
        yield from linear_leaves("map_fold", folded, width)


def init(config: VoxelDiTConfig, key: Array) -> Params:
    """Return random parameters, float32; the prediction is 0 at initialization."""
    params = frame_blocks.init(config.blocks, PARTS, ends(config), key)
    for name, rows in (("map_ids", config.map_ids), ("map_mask", STATES)):
        if name in params:  # only one row is looked up
            params[name]["kernel"] *= rows**0.5
    return params


def empty_cache(config: VoxelDiTConfig, batch: int, dtype: Any = jnp.float32) -> FrameCache:
    """Return the cache before the first frame."""
    return frame_blocks.empty_cache(config.blocks, batch, config.tokens, dtype)


def apply(
    config: VoxelDiTConfig,
    params: Params,
    latents_BTxyzC: Array,
    times_BT: Array,
    actions_BTA: Array,
    pixels_BThwC: Array,
    *,
    camera_BTN: Array | None = None,
    shown_BT: Array | None = None,
    known_BTxyz: Array | None = None,
    map_BTXYZ: tuple[Array, Array] | None = None,
    cache: FrameCache | None = None,
) -> tuple[Array, FrameCache | None]:
    """Predict the target of the noise from noisy frames, with the cache that has these frames.

    All denoising steps of a frame use the cache from before it; the cache for the next frame is
    computed from the denoised frame. The dtype of the latents is that of the computation.

    Args:
        times_BT: each frame's time, in the network's units.
        actions_BTA: the action that leads *to* each frame; zeros for the first frame of an episode.
        pixels_BThwC: latents of each frame's image: of the frame before it, or for the first frame
            of an episode its own. Further channels, such as rays, may be appended.
        camera_BTN: numbers of that image's camera; see ``geometry.actions.camera_numbers``.
        shown_BT: bool, whether a frame has its image; None means all have.
        known_BTxyz: bool, which latents are known; tokens of others are not read by later frames.
            None means all are.
        map_BTXYZ: ids (B, T, X, Y, Z) of the cells that the map holds, below 0 if unknown, and the
            mask beside them: ``ABSENT``, ``GUESS`` or ``SEEN``; with ``config.map_embed``.

    Returns:
        The prediction, 0 outside of ``config.storey``, and the cache.

    Raises:
        UserError: an argument of another shape, or cameras or a map where the network takes none.
    """
    _require(config, latents_BTxyzC, actions_BTA, pixels_BThwC, camera_BTN)
    _require_map(config, latents_BTxyzC, map_BTXYZ)
    (batch, frames), dtype = latents_BTxyzC.shape[:2], latents_BTxyzC.dtype
    width = config.blocks.width
    patches = _fold(config, _storey(config, latents_BTxyzC))
    x = linear(params["patch_embed"], patches.reshape(batch, frames, config.tokens, -1))
    x = x + jnp.asarray(frame_blocks.positions(config.token_sides, width), dtype)
    if map_BTXYZ is not None:
        x = x + _embed_map(config, params, *map_BTXYZ, dtype)

    given = linear(params["pixel_embed"], patchify(pixels_BThwC.astype(dtype), config.pixel_patch))
    rows, columns = (n // config.pixel_patch for n in pixels_BThwC.shape[2:4])
    given = given.reshape(batch, frames, rows * columns, width)
    given = given + jnp.asarray(frame_blocks.positions((rows, columns), width), dtype)
    if shown_BT is not None:
        nothing = params["no_pixels"]["bias"].astype(dtype)
        given = jnp.where(jnp.asarray(shown_BT)[..., None, None], given, nothing)

    condition = frame_blocks.embed_times(params, times_BT, dtype)
    condition = condition + frame_blocks.mlp(params["action"], actions_BTA.astype(dtype))
    if camera_BTN is not None:
        seen = frame_blocks.mlp(params["camera"], camera_BTN.astype(dtype))
        if shown_BT is not None:
            seen = jnp.where(jnp.asarray(shown_BT)[..., None], seen, 0)
        condition = condition + seen
    if known_BTxyz is not None:
        patches = _fold(config, _storey(config, known_BTxyz[..., None]))
        known_BTxyz = patches.all(-1).reshape(x.shape[:3])
    x, cache = frame_blocks.run(
        config.blocks,
        PARTS,
        params,
        x,
        condition,
        context_BTMD=given,
        known_BTN=known_BTxyz,
        cache=cache,
        sides=config.token_sides,
    )
    out = frame_blocks.project(params, x, condition).reshape(batch * frames, config.tokens, -1)
    (low, high), (along_x, along_y, along_z) = config.levels, config.patches
    sides = config.latent_side, config.latent_side, high - low
    out = unpatchify(out, *sides, (along_y, along_z), along_x)
    out = out.reshape(batch, frames, *out.shape[1:])
    beside = [(0, 0)] * 4 + [(low, config.latent_side - high), (0, 0)]
    return jnp.pad(out, beside), cache


def _storey(config: VoxelDiTConfig, grid_BTxyzC: Array, cells: int = 1) -> Array:
    """Return the predicted levels of grids of ``cells`` cells per latent, (B · T, x, y, z, C)."""
    low, high = (at * cells for at in config.levels)
    cut = grid_BTxyzC[..., low:high, :]
    return cut.reshape(-1, *cut.shape[2:])


def _fold(config: VoxelDiTConfig, grid_NxyzC: Array, cells: int = 1) -> Array:
    """Return the tokens of grids of ``cells`` cells per latent, (N, tokens, channels)."""
    along_x, along_y, along_z = (count * cells for count in config.patches)
    return patchify(grid_NxyzC, (along_y, along_z), along_x)


def _embed_map(
    config: VoxelDiTConfig, params: Params, ids_BTXYZ: Array, mask_BTXYZ: Array, dtype: Any
) -> Array:
    """Return tokens (B, T, N, D) of the cells that the map holds and of the mask beside them."""
    both = jnp.stack([ids_BTXYZ.astype(jnp.int32), mask_BTXYZ.astype(jnp.int32)], -1)
    cells = config.map_cells
    ids, mask = jnp.moveaxis(_storey(config, both, cells), -1, 0)
    table = params["map_ids"]["kernel"].astype(dtype)
    seen = jnp.where((ids >= 0)[..., None], table[jnp.maximum(ids, 0)], 0)
    seen = seen + params["map_mask"]["kernel"].astype(dtype)[mask]
    folded = _fold(config, seen, cells)
    return linear(params["map_fold"], folded.reshape(*ids_BTXYZ.shape[:2], config.tokens, -1))


def _require_map(
    config: VoxelDiTConfig, latents: Array, map_BTXYZ: tuple[Array, Array] | None
) -> None:
    """Refuse a map of another shape, one that the network does not take, or none if it does."""
    wanted = (*latents.shape[:2], *(config.latent_side * config.map_cells,) * 3)
    shapes = [x.shape for x in map_BTXYZ or ()]
    if shapes != ([wanted, wanted] if config.map_embed else []):
        raise UserError(
            f"The map's cells and mask have shapes {shapes}: this network takes two of {wanted}, "
            "and none where voxel_dit.map_embed is 0."
        )


def _require(
    config: VoxelDiTConfig, latents: Array, actions: Array, pixels: Array, camera: Array | None
) -> None:
    """Refuse arrays of other shapes."""
    wanted = (*(config.latent_side,) * 3, config.latent_channels)
    if latents.ndim != 6 or latents.shape[2:] != wanted:
        raise UserError(
            f"The voxel frames' latents have shape {latents.shape}: this network takes (batch, "
            f"frames, {', '.join(map(str, wanted))})."
        )
    front, patch = latents.shape[:2], config.pixel_patch
    if actions.shape != (*front, config.actions):
        raise UserError(
            f"The actions have shape {actions.shape}: give one of {config.actions} numbers for "
            f"each frame, {(*front, config.actions)}, the one that leads to it."
        )
    sizes = pixels.shape[2:4]
    if (
        pixels.ndim != 5
        or pixels.shape[:2] != front
        or pixels.shape[4] != config.pixel_channels
        or any(size % patch for size in sizes)
    ):
        raise UserError(
            f"The pictures' latents have shape {pixels.shape}: give {front} of them with "
            f"{config.pixel_channels} channels, rows and columns multiples of {patch}."
        )
    numbers = (*front, config.camera_numbers)
    if camera is not None and (not config.camera_numbers or camera.shape != numbers):
        raise UserError(
            f"The cameras have shape {camera.shape}: this network takes {numbers}, and none where "
            "the last is 0 (voxel_dit.camera_numbers)."
        )
