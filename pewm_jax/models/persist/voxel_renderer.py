"""The renderer of PERSIST: it predicts images of voxels for given cameras.

A ray is cast through the centre of each latent of the image and hits occupied voxels in order
(``geometry.march``). Each hit has a learned vector of its class and sinusoids of its depth. A
convolution along the ray folds these hits into channels at the positions of the image's latents.
Concatenated to the noisy latents, they are the input of a transformer with attention in and between
frames, whose blocks are those of ``voxel_dit`` without attention to images (arXiv 2603.03482).

Parameters: ``classes, fold, patch_embed, time_embed, blocks (stacked over layers), modulate_out,
proj_out``, and ``faces`` and ``action`` where a variant has them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.geometry import march
from pewm_jax.geometry.cameras import resize_intrinsics
from pewm_jax.geometry.march import RayHits
from pewm_jax.models.persist import blocks as frame_blocks
from pewm_jax.models.persist.blocks import FrameCache
from pewm_jax.models.persist.config import VoxelRendererConfig
from pewm_jax.nn.layers import linear
from pewm_jax.nn.parameters import Leaf
from pewm_jax.nn.parameters import linear as linear_leaves
from pewm_jax.nn.tokens import patchify, unpatchify
from pewm_jax.types import Array, Camera, Params

PARTS = ("space", "time")
SHARDING = frame_blocks.rules("renderer")
"""Rules over the paths of its parameters under ``renderer``."""
FACES = 4
"""Axes along which a ray can enter a voxel: three, or none."""


def ends(config: VoxelRendererConfig) -> Iterator[Leaf]:
    """Yield path and shape of the parameters around the blocks."""
    width, cells = config.blocks.width, config.patch**2
    inputs = (config.latent_channels + config.features) * cells
    yield "classes/kernel", (config.classes, config.embed)
    yield from linear_leaves("fold", config.kernel * config.embed, config.fold)
    yield from linear_leaves("patch_embed", inputs, width)
    yield from frame_blocks.end_shapes(width, config.latent_channels * cells)
    if config.sides:
        yield "faces/kernel", (FACES, config.embed)
    if config.actions:
        yield from frame_blocks.mlp_shapes("action", config.actions, width)


def init(config: VoxelRendererConfig, key: Array) -> Params:
    """Return random parameters, float32; the prediction is 0 at initialization."""
    params = frame_blocks.init(config.blocks, PARTS, ends(config), key)
    for name, rows in (("classes", config.classes), ("faces", FACES)):
        if name in params:  # only one row is looked up
            params[name]["kernel"] *= rows**0.5
    return params


def empty_cache(config: VoxelRendererConfig, batch: int, dtype: Any = jnp.float32) -> FrameCache:
    """Return the cache before the first frame."""
    return frame_blocks.empty_cache(config.blocks, batch, config.tokens, dtype)


def cast_rays(
    config: VoxelRendererConfig,
    classes_TXYZ: Array,
    low_T3: Array,
    cell_m: float,
    camera: Camera,
    size: tuple[int, int],
) -> RayHits:
    """Return the hits (T, h·r, w·r, L) of the rays of T cameras in T grids; distances are depths.

    r is ``config.rays``. ``low_T3`` is the corner of each grid with the smallest coordinates and
    ``cell_m`` the side of a voxel, metres; the cameras' intrinsics are for images of this height
    and width.
    """
    height, width = config.height * config.rays, config.width * config.rays
    shrink = width / size[1], height / size[0]
    intrinsics = resize_intrinsics(camera.intrinsics_4, shrink[0], shrink[1])

    def one(frame: tuple[Array, ...]) -> RayHits:
        ids, low, intrinsics_4, pose = frame
        seen = Camera(intrinsics_4[None], pose[None])
        found = march.through_pixels(ids, low, cell_m, seen, height, width, config.layers)
        return jax.tree.map(lambda x: x[0], found)

    # One frame at a time: a march ends when all its rays have left the grid.
    frames = classes_TXYZ, low_T3, intrinsics, camera.world_from_camera
    return jax.lax.map(one, tuple(jnp.asarray(x) for x in frames))


def features(
    config: VoxelRendererConfig,
    params: Params,
    layers: RayHits,
    dtype: Any = jnp.float32,
    *,
    drawn_hwC: Array | None = None,
) -> Array:
    """Fold layers (..., h, w, L) into channels (..., h, w, F): first all of the nearest.

    With several rays per latent, first all of the first ray. ``drawn_hwC`` are latents of the
    voxels drawn in the colours of their classes, where the network takes them (``config.drawn``);
    they are the last channels.

    Raises:
        UserError: drawn voxels where the network takes none, or none where it does.
    """
    given = 0 if drawn_hwC is None else drawn_hwC.shape[-1]
    if given != config.drawn:
        raise UserError(
            f"The drawn voxels have {given} channels: the renderer takes {config.drawn} "
            "(renderer.drawn)."
        )
    folded = _folded(config, params, layers, dtype)
    if drawn_hwC is None:
        return folded
    return jnp.concatenate([folded, drawn_hwC.astype(dtype)], -1)


def _folded(config: VoxelRendererConfig, params: Params, layers: RayHits, dtype: Any) -> Array:
    x = params["classes"]["kernel"].astype(dtype)[layers.ids_L]
    if config.sides:
        x = x + params["faces"]["kernel"].astype(dtype)[layers.side_L]  # −1 is the last row
    x = x + depth_waves(config, layers.distance_L).astype(dtype)
    last = config.stride * (config.places - 1) + 1
    taps = [x[..., tap : tap + last : config.stride, :] for tap in range(config.kernel)]
    folded = linear(params["fold"], jnp.concatenate(taps, -1))
    if config.rays == 1:
        return folded.reshape(*folded.shape[:-2], config.folded)
    *front, rows, columns, places, channels = folded.shape
    rays = config.rays
    cut = folded.reshape(*front, rows // rays, rays, columns // rays, rays, places * channels)
    cut = jnp.moveaxis(cut, -4, -3)
    return cut.reshape(*cut.shape[:-3], config.folded)


def depth_waves(config: VoxelRendererConfig, depth: Array) -> Array:
    """Return (..., embed) sines then cosines of depth, wavelengths from shortest to longest."""
    share = np.linspace(0, 1, config.embed // 2)
    wavelengths = config.shortest_m * (config.longest_m / config.shortest_m) ** share
    angle = depth[..., None] * np.asarray(2 * np.pi / wavelengths, np.float32)
    return jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], -1)


def apply(
    config: VoxelRendererConfig,
    params: Params,
    latents_BThwC: Array,
    times_BT: Array,
    features_BThwF: Array,
    *,
    actions_BTA: Array | None = None,
    cache: FrameCache | None = None,
) -> tuple[Array, FrameCache | None]:
    """Predict the target of the noise from noisy latents of images, with the cache of these frames.

    ``features_BThwF`` are the voxels as each frame's camera sees them, from ``features``;
    ``actions_BTA`` lead to each frame, where the network takes actions. The dtype of the latents is
    that of the computation.

    Raises:
        UserError: an argument of another shape.
    """
    place = (config.height, config.width)
    for name, value, channels in (
        ("pictures' latents", latents_BThwC, config.latent_channels),
        ("voxels' features", features_BThwF, config.features),
    ):
        if value.ndim != 5 or value.shape[2:] != (*place, channels):
            raise UserError(
                f"The {name} have shape {value.shape}: the renderer takes (batch, frames, "
                f"{config.height}, {config.width}, {channels})."
            )
    if (actions_BTA is not None) != bool(config.actions):
        raise UserError(
            f"The renderer takes actions of {config.actions} numbers (renderer.actions): give them "
            "if that is above 0, and none if it is 0."
        )
    (batch, frames), dtype = latents_BThwC.shape[:2], latents_BThwC.dtype
    joined = jnp.concatenate([latents_BThwC, features_BThwF.astype(dtype)], -1)
    patches = patchify(joined, config.patch).reshape(batch, frames, config.tokens, -1)
    sides = (config.height // config.patch, config.width // config.patch)
    table = frame_blocks.positions(sides, config.blocks.width)
    x = linear(params["patch_embed"], patches) + jnp.asarray(table, dtype)
    condition = frame_blocks.embed_times(params, times_BT, dtype)
    if actions_BTA is not None:
        condition = condition + frame_blocks.mlp(params["action"], actions_BTA.astype(dtype))
    x, cache = frame_blocks.run(
        config.blocks, PARTS, params, x, condition, cache=cache, sides=sides
    )
    out = frame_blocks.project(params, x, condition).reshape(batch, frames * config.tokens, -1)
    return unpatchify(out, frames, *place, config.patch), cache
