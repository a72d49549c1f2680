"""The inputs of each stage of the world ``persist``, computed from a batch of clips.

They are computed with frozen weights, only once with ``data.prepared``, and stored in the clip's
extra ``prepared``. The voxels of a clip are cut into windows, as in a rollout.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.codecs import rgbd
from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import UserError
from pewm_jax.geometry.actions import camera_numbers
from pewm_jax.geometry.march import RayHits
from pewm_jax.models.persist import voxel_renderer, voxel_vae
from pewm_jax.nn import placement
from pewm_jax.types import Array, Camera, Clip, Params
from pewm_jax.worlds.persist import state as grid_state
from pewm_jax.worlds.persist.config import PersistModel
from pewm_jax.worlds.persist.step import draw_latents


def leading_actions(actions_BTA: Array) -> Array:
    """Turn (B, T − 1, A) actions that lead away from frames into (B, T, A) that lead to them."""
    return jnp.pad(jnp.asarray(actions_BTA), ((0, 0), (1, 0), (0, 0)))


def previous_frames(frames: Any) -> Any:
    """Return for each frame of (B, T, …) arrays the value of the frame before.

    The first frame keeps its own, from which a world can begin (w₀ from o₀).
    """
    return jax.tree.map(lambda x: jnp.concatenate([x[:, :1], x[:, :-1]], 1), frames)


def lattice(model: PersistModel, clip: Clip) -> tuple[Array, Array]:
    """Return int32 first cells of the recorded grids, and of the windows of their frames.

    They are relative to one corner for all frames of a clip. Windows begin at whole tokens of a
    lattice. A rollout's lattice begins at its first frame; here each clip gets its own, which
    depends on the cell where it begins.
    """
    require_recorded(model, clip)
    size = model.cell
    origin = jnp.asarray(clip.extras["origin_T3"])
    first = jnp.floor(origin[:, :1] / size + 1e-3).astype(jnp.int32)
    recorded = first + jnp.round((origin - origin[:, :1]) / size).astype(jnp.int32)
    place = jnp.asarray(clip.frames.camera.world_from_camera)[..., :3, 3]
    agent = recorded + jnp.floor((place - origin) / size).astype(jnp.int32)
    wide, token = model.side, model.backbone.token_cells
    shift = _hash_cell(agent[:, :1]) % token
    recorded, agent = recorded + shift, agent + shift
    start = grid_state.snap(agent - wide // 2, token)
    beside = (model.memory.recorded - wide) // 2
    return recorded, start.at[..., 2].set(recorded[..., 2] + beside)


def _hash_cell(cell_BT3: Array) -> Array:
    """Return two pseudo-random numbers, which depend on a cell, and 0."""
    x, y, _ = jnp.moveaxis(cell_BT3.astype(jnp.uint32), -1, 0)
    mixed = (x * jnp.uint32(0x9E3779B1)) ^ (y * jnp.uint32(0x85EBCA6B))
    mixed = (mixed ^ (mixed >> 15)) * jnp.uint32(0xC2B2AE35)
    both = jnp.stack([mixed >> 8, mixed >> 20, jnp.zeros_like(mixed)], -1) & 0xFF
    return both.astype(jnp.int32)


def cut_windows(model: PersistModel, clip: Clip, start_BT3: Array, recorded_BT3: Array) -> Array:
    """Return (B, T, X, Y, Z) int16 windows of the recorded grids; cells outside are unknown."""
    classes = jnp.asarray(clip.extras["classes_TXYZ"]).astype(jnp.int16)
    one = functools.partial(grid_state.cut_box, count=model.side)
    return jax.vmap(jax.vmap(one))(classes, start_BT3 - recorded_BT3)


def pictures(
    model: PersistModel, params: Params, clip: Clip
) -> tuple[Array, grid_state.ShownPicture]:
    """Return (B, T, h, w, C) latents of the frames, and as the conditioning of voxel frames."""
    frames = as_signal(clip.frames)
    latents = rgbd.encode_rgbd(model, params, frames.rgb_THWC, frames.depth_THW)
    latents = latents[..., : model.picture_channels]
    camera = jax.tree.map(jnp.asarray, frames.camera)
    return latents, grid_state.shown_picture(latents, jnp.asarray(frames.depth_THW), camera)


def grids(model: PersistModel, params: Params, clip: Clip) -> Clip:
    """Return the windows of the first and of the last frame, for the autoencoder."""
    del params
    recorded, start = lattice(model, clip)
    ends = jnp.array([0, -1])
    some = clip.with_extras(classes_TXYZ=jnp.asarray(clip.extras["classes_TXYZ"])[:, ends])
    return _prepared(
        clip, jnp.maximum(cut_windows(model, some, start[:, ends], recorded[:, ends]), 0)
    )


def frames(model: PersistModel, params: Params, clip: Clip) -> Clip:
    """Return latents of voxel frames, all in the window of the last one, and their conditioning."""
    recorded, start = lattice(model, clip)
    last = jnp.broadcast_to(start[:, -1:], start.shape)
    classes = cut_windows(model, clip, last, recorded)
    shape = classes.shape[:2]
    flat = classes.reshape(-1, *classes.shape[2:])
    config, dtype = model.backbone.voxel_vae, jnp.dtype(model.dtype)

    def encode(weights: Params, flat: Array) -> Array:
        def one(grid: Array) -> Array:
            ids = jnp.maximum(grid, 0)[None].astype(int)
            return voxel_vae.encode(config, weights, ids, dtype)[0]

        return jax.lax.map(one, flat)

    latents = placement.by_batch(encode, params["voxel_vae"], flat)
    latents = latents.reshape(*shape, *latents.shape[1:])
    recorded_too = jax.vmap(jax.vmap(functools.partial(grid_state.known_latents, model)))(classes)
    token, wide = model.backbone.token_cells, model.side
    at = last[..., None] + jnp.arange(0, wide, token)  # (B, T, 3, tokens)
    inside = (at >= start[..., None]) & (at < start[..., None] + wide)
    x, y, z = jnp.moveaxis(inside, 2, 0)
    own = x[..., :, None, None] & y[..., None, :, None] & z[..., None, None, :]
    patch = model.backbone.world_frames.patch
    known = grid_state.repeat_tokens(own, patch) & recorded_too

    corner = jnp.asarray(clip.extras["origin_T3"]) - recorded * model.cell
    middle = grid_state.middle(model, corner, last)
    _, shown = pictures(model, params, clip)
    channels = grid_state.picture_channels(model, shown, middle)
    camera = camera_numbers(shown.camera, model.clip.width, middle)
    made = {
        "latents": latents.astype(jnp.float16),
        "told": channels.astype(jnp.float16),
        "camera": camera,
        "actions": leading_actions(clip.actions_TA),
        "known": known,
        "occupied": occupied(model, classes),
        "classes": classes,
    }
    return _prepared(clip, made)


def occupied(model: PersistModel, classes_BTXYZ: Array) -> Array:
    """Return (B, T, x, y, z) bool: whether a known cell of a latent is occupied."""
    *front, wide, _, _ = classes_BTXYZ.shape
    factor = model.backbone.voxel_vae.factor
    count = wide // factor
    cells = (classes_BTXYZ > 0).reshape(*front, count, factor, count, factor, count, factor)
    return cells.any((-5, -3, -1))


def cameras(model: PersistModel, params: Params, clip: Clip) -> Clip:
    """Return the voxels around the previous camera of each frame, and the cameras."""
    del params
    recorded, _ = lattice(model, clip)
    size, config = model.cell, model.backbone.camera_model
    camera = jax.tree.map(jnp.asarray, clip.frames.camera)
    place, origin = camera.world_from_camera[..., :3, 3], jnp.asarray(clip.extras["origin_T3"])
    cell = jnp.floor((place - origin) / size).astype(jnp.int32)
    before = previous_frames(recorded + cell)
    one = functools.partial(grid_state.cut_box, count=config.inner)
    classes = jnp.asarray(clip.extras["classes_TXYZ"]).astype(jnp.int16)
    inner = jax.vmap(jax.vmap(one))(classes, before - config.inner // 2 - recorded)
    made = {
        "classes": jnp.maximum(inner, 0),
        "middle": origin + cell * size,
        "camera": camera,
        "actions": leading_actions(clip.actions_TA),
    }
    return _prepared(clip, made)


def layers(model: PersistModel, params: Params, clip: Clip) -> Clip:
    """Return latents of the images, and the hits of their rays in the true voxels."""
    recorded, start = lattice(model, clip)
    classes = jnp.maximum(cut_windows(model, clip, start, recorded), 0)
    size = model.cell
    corner = jnp.asarray(clip.extras["origin_T3"]) + (start - recorded) * size
    camera = jax.tree.map(jnp.asarray, clip.frames.camera)
    pixels = (model.clip.height, model.clip.width)

    def look(_: Params, *clips: Any) -> RayHits:
        def one(clip: tuple[Array, Array, Camera]) -> RayHits:
            grid, low, seen = clip
            return voxel_renderer.cast_rays(model.backbone.renderer, grid, low, size, seen, pixels)

        return jax.lax.map(one, clips)

    layers = placement.by_batch(look, {}, classes, corner, camera)
    made = {
        "latents": pictures(model, params, clip)[0].astype(jnp.float16),
        "ids": layers.ids_L.astype(jnp.int16),
        "distance": layers.distance_L.astype(jnp.float16),
        "side": layers.side_L.astype(jnp.int8),
        "actions": leading_actions(clip.actions_TA),
    }
    if model.backbone.renderer.drawn:

        def draw(weights: Params, *clips: Any) -> Array:
            def one(clip: tuple[Array, Array, Camera]) -> Array:
                return jax.lax.map(lambda frame: draw_latents(model, weights, *frame), clip)

            return jax.lax.map(one, clips)

        weights = {"codec": params.get("codec", {})}
        drawn = placement.by_batch(draw, weights, classes, corner, camera)
        made["drawn"] = drawn.astype(jnp.float16)
    return _prepared(clip, made)


def require_recorded(model: PersistModel, clip: Clip) -> None:
    """Refuse data without voxels or actions, or with grids of another size."""
    memory, classes = model.memory, clip.extras.get("classes_TXYZ")
    groups = f"--voxels.kinds {memory.kinds} --voxels.colours {memory.colours}"
    command = (
        f"pewm-jax data collect DATA --moving --voxels --voxels.cell {model.cell:g} "
        f"--voxels.side {memory.recorded} {groups} --voxels.pictures {memory.pictures}"
    )
    if classes is None or clip.actions_TA is None:
        raise UserError(f"the data lack voxels or actions, which this world needs: run {command}.")
    if classes.shape[-1] != memory.recorded:
        raise UserError(
            f"the recorded grids have {classes.shape[-1]} cells along each axis, and memory."
            f"recorded is {memory.recorded}: run {command}."
        )


def _prepared(clip: Clip, made: Any) -> Clip:
    """Return a clip with these values as ``prepared``; arrays that are no longer used are empty."""

    def none(x: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf[:, :0], x)

    return Clip(
        none(clip.frames),
        none(clip.context),
        clip.context_valid_S[:, :0],
        extras={"prepared": made},
    )
