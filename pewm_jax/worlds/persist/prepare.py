"""The inputs of each stage of the world ``persist``, computed from a batch of clips.

They are computed with frozen weights, only once with ``data.prepared``, and stored in the clip's
extra ``prepared``. The voxels of a clip are cut into windows, as in a rollout.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.codecs import rgbd
from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import UserError
from pewm_jax.geometry.actions import camera_numbers
from pewm_jax.geometry.cameras import einsum
from pewm_jax.geometry.march import RayHits
from pewm_jax.memory.class_grid import UNKNOWN, ClassGrid
from pewm_jax.models.persist import voxel_renderer, voxel_vae
from pewm_jax.nn import placement
from pewm_jax.types import Array, Camera, Clip, Params
from pewm_jax.worlds.persist import corruption, voxel_frames
from pewm_jax.worlds.persist import state as grid_state
from pewm_jax.worlds.persist.config import PersistModel
from pewm_jax.worlds.persist.step import draw_latents, imagine_window, shown_cells


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
    wide = model.side
    at = last[..., None] + jnp.arange(0, wide, config.factor)  # (B, T, 3, latents)
    inside = (at >= start[..., None]) & (at < start[..., None] + wide)
    x, y, z = jnp.moveaxis(inside, 2, 0)
    own = x[..., :, None, None] & y[..., None, :, None] & z[..., None, None, :]
    known = own & recorded_too

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
    if model.backbone.world_frames.map_embed:
        made |= visible(model, clip, classes, corner[:, 0] + last[:, 0] * model.cell)
    return _prepared(clip, made)


VIEWS = 6
"""Further views from the first frame's camera, turned by equal angles, of the cells that may have
been observed before a clip."""


def visible(
    model: PersistModel, clip: Clip, classes_BTXYZ: Array, corner_B3: Array
) -> dict[str, Array]:
    """Return which cells of a clip's window, whose lowest corner is given in metres, are visible.

    ``seen`` is (B, X, Y, Z) uint8, the first frame of the clip that shows the cell, or T;
    ``before`` is uint8 with one bit for each of the ``VIEWS`` that shows it.
    """
    frames = clip.frames
    depth = as_signal(frames).depth_THW
    camera = jax.tree.map(jnp.asarray, frames.camera)
    count = depth.shape[1]

    def one(inputs: tuple[Array, Array, Array, Camera]) -> tuple[Array, Array]:
        classes, corner, depth, camera = inputs

        def shows(frame: tuple[Array, Camera]) -> Array:
            air, surface = voxel_frames.visible_cells(model, corner, *frame)
            return air | surface

        def turned(turn: Array) -> Array:
            view = Camera(camera.intrinsics_4[0], turn_pose(camera.world_from_camera[0], turn))
            return shown_cells(model, jnp.maximum(classes[0], 0), corner, view)

        by_frame = jax.lax.map(shows, (depth, camera))
        first = jnp.where(by_frame.any(0), by_frame.argmax(0), count)
        around = jax.lax.map(turned, jnp.arange(VIEWS) * np.float32(2 * np.pi / VIEWS))
        bits = around * (1 << jnp.arange(VIEWS))[:, None, None, None]
        return first.astype(jnp.uint8), bits.sum(0).astype(jnp.uint8)

    seen, before = jax.lax.map(one, (classes_BTXYZ, corner_B3, depth, camera))
    return {"seen": seen, "before": before}


def turn_pose(world_from_camera_44: Array, angle: Array) -> Array:
    """Return a pose turned about the vertical axis of the world through its position, radians."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    turn = jnp.eye(3).at[:2, :2].set(jnp.stack([jnp.stack([cos, -sin]), jnp.stack([sin, cos])]))
    return world_from_camera_44.at[:3, :3].set(
        einsum("ij,jk->ik", turn, world_from_camera_44[:3, :3])
    )


def occupied(model: PersistModel, classes_BTXYZ: Array) -> Array:
    """Return (B, T, x, y, z) bool: whether a known cell of a latent is occupied."""
    return any_in_latent(model, classes_BTXYZ > 0)


def any_in_latent(model: PersistModel, cells_BTXYZ: Array) -> Array:
    """Return (B, T, x, y, z) bool: the latents with such a cell."""
    *front, wide, _, _ = cells_BTXYZ.shape
    factor = model.backbone.voxel_vae.factor
    count = wide // factor
    cut = cells_BTXYZ.reshape(*front, count, factor, count, factor, count, factor)
    return cut.any((-5, -3, -1))


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
    """Return latents of the images, and the hits of their rays in the true voxels.

    In shares of the clips (``renderer.corrupted``, ``renderer.imagined``) the rays are cast through
    voxels with errors instead; the images stay the true ones.
    """
    recorded, start = lattice(model, clip)
    classes = jnp.maximum(cut_windows(model, clip, start, recorded), 0)
    size = model.cell
    if model.backbone.renderer.corrupted or model.backbone.renderer.imagined:
        classes = with_errors(model, params, clip, classes, start, recorded)
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


def with_errors(
    model: PersistModel,
    params: Params,
    clip: Clip,
    classes_BTXYZ: Array,
    start_BT3: Array,
    recorded_BT3: Array,
) -> Array:
    """Return windows of which some clips' are corrupted, or imagined from the first image.

    Which clips depends on their contents. All frames of a clip have the same errors. The imagined
    voxels are those of the window of the clip's last frame.
    """
    config, size = model.backbone.renderer, model.cell
    low = jnp.asarray(clip.extras["origin_T3"]) - recorded_BT3 * size
    frames = as_signal(clip.frames)
    first = jax.tree.map(lambda x: jnp.asarray(x)[:, 0], frames)
    last = start_BT3[:, -1]
    can_imagine = "voxel_dit" in params

    def one(inputs: tuple[Any, ...]) -> Array:
        windows, starts, begin, corner, frame, key = inputs
        share_key, change_key = jax.random.split(key)
        drawn = jax.random.uniform(share_key)

        def shared(grid: Array, at: Array) -> Array:
            """Return a grid at cell ``at`` of the lattice as the windows of all frames."""
            cut = jax.vmap(lambda start: grid_state.cut_box(grid, start - at, model.side))(starts)
            return jnp.maximum(cut, 0).astype(windows.dtype)

        def corrupted() -> Array:
            changes = corruption.draw_changes(windows[0], change_key)
            change = functools.partial(corruption.apply_changes, changes=changes)
            return jax.vmap(lambda grid, off: change(grid, off_3=off))(windows, starts - starts[0])

        def imagined() -> Array:
            grid = ClassGrid(jnp.full((model.side,) * 3, UNKNOWN, jnp.int16), corner + begin * size)
            made = imagine_window(model, params, grid, frame, change_key)
            return shared(made, begin)

        kind = jnp.where(drawn < config.corrupted, 1, 0)
        if not can_imagine:
            return jax.lax.cond(kind == 1, corrupted, lambda: windows)
        within = (drawn >= config.corrupted) & (drawn < config.corrupted + config.imagined)
        kind = jnp.where(within, 2, kind)
        return jax.lax.switch(kind, (lambda: windows, corrupted, imagined))

    keys = clip_keys(clip)
    return jax.lax.map(one, (classes_BTXYZ, start_BT3, last, low[:, 0], first, keys))


def clip_keys(clip: Clip) -> Array:
    """Return (B,) keys that depend on the first cameras of clips."""
    poses = jnp.asarray(clip.frames.camera.world_from_camera, jnp.float32)[:, 0, :3]
    words = jax.lax.bitcast_convert_type(poses.reshape(len(poses), -1), jnp.uint32)

    def key(words_N: Array) -> Array:
        made = jax.random.key(0)
        for word in words_N:
            made = jax.random.fold_in(made, word)
        return made

    return jax.vmap(key)(words)


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
