"""How the world ``persist`` learns: what each stage is given of a batch of clips, and its loss.

What a stage computes with frozen weights is done by its ``prepare``, once where ``data.prepared``
asks for it; ``Clip.prepared`` holds it. The voxels of a clip are seen in windows, as in a rollout.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.config import Config, PersistConfig, PersistTrainConfig, TrainSettings, UserError
from pewm_jax.config import functions as functions_of
from pewm_jax.geometry import camera_steps
from pewm_jax.geometry.march import Layers
from pewm_jax.models import (
    camera_model,
    codecs,
    persist_nets,
    voxel_dit,
    voxel_renderer,
    voxel_vae,
)
from pewm_jax.models.costs import Costs, Share
from pewm_jax.models.signals import as_signal
from pewm_jax.models.voxel_vae_shapes import costs as vae_costs
from pewm_jax.types import Array, Camera, Clip, Params
from pewm_jax.worlds import persist_losses as losses
from pewm_jax.worlds import persist_windows as windows
from pewm_jax.worlds.persist_step import reckoning
from pewm_jax.worlds.stages import FREEZE, TRAIN, Stage

Measured = dict[str, Array]
GRIDS = 2
"""Grids of a clip from which the autoencoder learns: of its first and of its last frame."""
STATISTICS = r"voxel_vae/latent_(mean|scale)_C"
SMALL = 1e-4
"""The least scale of a latent."""


def init(model: PersistConfig, key: Array, networks: int = len(persist_nets.NETWORKS)) -> Params:
    """Return random parameters of the codec and of the first so many networks."""
    codec_key, key = jax.random.split(key)
    names = persist_nets.NETWORKS[:networks]
    made = {"codec": functions_of(model.codec).init(model.codec, codec_key)}
    return made | persist_nets.init(model.backbone, key, names)  # type: ignore[arg-type]


def lattice(model: PersistConfig, clip: Clip) -> tuple[Array, Array]:
    """Return where the recorded grids begin, and the windows of their frames, in whole cells.

    Returns:
        ``(recorded_BT3, start_BT3)``: int32 cells, counted from a corner that a clip's frames have
        in common.

    Raises:
        UserError: the data have no voxels, no actions, or grids of another size.
    """
    require_recorded(model, clip)
    size = windows.cell_m(model)
    origin = jnp.asarray(clip.origin_T3)
    first = jnp.floor(origin[:, :1] / size + 1e-3).astype(jnp.int32)
    recorded = first + jnp.round((origin - origin[:, :1]) / size).astype(jnp.int32)
    place = jnp.asarray(clip.frames.camera.world_from_camera)[..., :3, 3]
    agent = recorded + jnp.floor((place - origin) / size).astype(jnp.int32)
    wide, token = windows.side(model), model.backbone.token_cells  # type: ignore[attr-defined]
    start = windows.snapped(agent - wide // 2, token)
    beside = (model.memory.recorded - wide) // 2  # type: ignore[attr-defined]
    return recorded, start.at[..., 2].set(recorded[..., 2] + beside)


def cut(model: PersistConfig, clip: Clip, start_BT3: Array, recorded_BT3: Array) -> Array:
    """Return (B, T, X, Y, Z) int16 windows of the recorded grids, unknown where they reach out."""
    classes = jnp.asarray(clip.classes_TXYZ).astype(jnp.int16)
    one = functools.partial(windows.cut, count=windows.side(model))
    return jax.vmap(jax.vmap(one))(classes, start_BT3 - recorded_BT3)


def pictures(model: PersistConfig, params: Params, clip: Clip) -> tuple[Array, windows.Shown]:
    """Return (B, T, h, w, C) latents of the frames, and the same as voxel frames are shown them."""
    frames = as_signal(clip.frames)
    latents = codecs.encode_rgbd(model, params, frames.rgb_THWC, frames.depth_THW)
    latents = latents[..., : model.picture_channels]
    camera = jax.tree.map(jnp.asarray, frames.camera)
    return latents, windows.shown_of(latents, jnp.asarray(frames.depth_THW), camera)


def _prepared(clip: Clip, made: Any) -> Clip:
    """Return a clip of what was made of it alone; arrays that are not used any more are empty."""

    def none(x: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf[:, :0], x)

    return Clip(none(clip.frames), none(clip.context), clip.context_valid_S[:, :0], prepared=made)


def prepare_grids(model: PersistConfig, params: Params, clip: Clip) -> Clip:
    """Return the windows of the first and of the last frame, for the autoencoder."""
    del params
    recorded, start = lattice(model, clip)
    ends = jnp.array([0, -1])
    some = dataclasses.replace(clip, classes_TXYZ=jnp.asarray(clip.classes_TXYZ)[:, ends])
    return _prepared(clip, jnp.maximum(cut(model, some, start[:, ends], recorded[:, ends]), 0))


def prepare_frames(model: PersistConfig, params: Params, clip: Clip) -> Clip:
    """Return latents of voxel frames, all in the window of the last one, and their conditions."""
    recorded, start = lattice(model, clip)
    last = jnp.broadcast_to(start[:, -1:], start.shape)
    classes = cut(model, clip, last, recorded)
    shape = classes.shape[:2]
    flat = classes.reshape(-1, *classes.shape[2:])
    config, weights = model.backbone.voxel_vae, params["voxel_vae"]  # type: ignore[attr-defined]
    dtype = jnp.dtype(model.dtype)

    def encode(grid: Array) -> Array:
        return voxel_vae.encode(config, weights, jnp.maximum(grid, 0)[None].astype(int), dtype)[0]

    latents = jax.lax.map(encode, flat)
    latents = latents.reshape(*shape, *latents.shape[1:])
    counted = jax.vmap(jax.vmap(functools.partial(windows.known_latents, model)))(classes)
    token, wide = model.backbone.token_cells, windows.side(model)  # type: ignore[attr-defined]
    at = last[..., None] + jnp.arange(0, wide, token)  # (B, T, 3, tokens)
    inside = (at >= start[..., None]) & (at < start[..., None] + wide)
    x, y, z = jnp.moveaxis(inside, 2, 0)
    own = x[..., :, None, None] & y[..., None, :, None] & z[..., None, None, :]
    patch = model.backbone.world_frames.patch  # type: ignore[attr-defined]
    known = windows.spread(own, patch) & counted

    corner = jnp.asarray(clip.origin_T3) - recorded * windows.cell_m(model)
    middle = windows.middle(model, corner, last)
    _, shown = pictures(model, params, clip)
    told = windows.told(model, shown, middle)
    camera = camera_steps.numbers(shown.camera, model.clip.width, middle)
    made = {
        "latents": latents.astype(jnp.float16),
        "told": told.astype(jnp.float16),
        "camera": camera,
        "actions": losses.led_to(clip.actions_TA),
        "known": known,
        "counted": counted,
    }
    return _prepared(clip, made)


def prepare_cameras(model: PersistConfig, params: Params, clip: Clip) -> Clip:
    """Return the voxels around where the camera was before each frame, and the cameras."""
    del params
    recorded, _ = lattice(model, clip)
    size, config = windows.cell_m(model), model.backbone.camera_model  # type: ignore[attr-defined]
    camera = jax.tree.map(jnp.asarray, clip.frames.camera)
    place, origin = camera.world_from_camera[..., :3, 3], jnp.asarray(clip.origin_T3)
    cell = jnp.floor((place - origin) / size).astype(jnp.int32)
    before = losses.previous(recorded + cell)
    one = functools.partial(windows.cut, count=config.inner)
    classes = jnp.asarray(clip.classes_TXYZ).astype(jnp.int16)
    inner = jax.vmap(jax.vmap(one))(classes, before - config.inner // 2 - recorded)
    made = {
        "classes": jnp.maximum(inner, 0),
        "middle": origin + cell * size,
        "camera": camera,
        "actions": losses.led_to(clip.actions_TA),
    }
    return _prepared(clip, made)


def prepare_layers(model: PersistConfig, params: Params, clip: Clip) -> Clip:
    """Return latents of the pictures, and what their rays meet in the true voxels."""
    recorded, start = lattice(model, clip)
    classes = jnp.maximum(cut(model, clip, start, recorded), 0)
    size = windows.cell_m(model)
    corner = jnp.asarray(clip.origin_T3) + (start - recorded) * size
    camera = jax.tree.map(jnp.asarray, clip.frames.camera)
    pixels = (model.clip.height, model.clip.width)

    def look(one: tuple[Array, Array, Camera]) -> Layers:
        grid, low, seen = one
        return voxel_renderer.look(model.backbone.renderer, grid, low, size, seen, pixels)  # type: ignore[attr-defined]

    layers = jax.lax.map(look, (classes, corner, camera))
    made = {
        "latents": pictures(model, params, clip)[0].astype(jnp.float16),
        "ids": layers.ids_L.astype(jnp.int16),
        "distance": layers.distance_L.astype(jnp.float16),
        "side": layers.side_L.astype(jnp.int8),
        "actions": losses.led_to(clip.actions_TA),
    }
    return _prepared(clip, made)


def _of(
    prepare: Callable[..., Clip], model: PersistConfig, params: Params, clip: Clip
) -> dict[str, Any]:
    """Return what a stage is given of a batch, prepared now if it was not before."""
    if clip.prepared is not None:
        return clip.prepared
    made = prepare(model, jax.lax.stop_gradient(params), clip).prepared
    assert made is not None
    return made


def autoencode(
    model: PersistConfig, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, Measured]:
    """Return the loss of stage ``voxel_vae``."""
    del train
    grids: Any = _of(prepare_grids, model, params, clip)
    config = model.backbone.voxel_vae  # type: ignore[attr-defined]
    dtype = jnp.dtype(model.dtype)
    return losses.voxel_vae(config, params["voxel_vae"], grids.astype(jnp.int32), key, dtype)


def distribute(
    model: PersistConfig, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, Measured]:
    """Return the loss of stage ``voxel_statistics``: least at mean 0 and variance 1 of latents."""
    del train, key
    grids: Any = _of(prepare_grids, model, params, clip)
    config, weights = model.backbone.voxel_vae, params["voxel_vae"]  # type: ignore[attr-defined]
    grids = grids.reshape(-1, *grids.shape[2:]).astype(jnp.int32)
    mean, _ = voxel_vae.moments(config, weights, grids, jnp.dtype(model.dtype))
    scale = jnp.abs(weights["latent_scale_C"]) + SMALL
    latents = (jax.lax.stop_gradient(mean) - weights["latent_mean_C"]) / scale
    places = tuple(range(latents.ndim - 1))
    return (jnp.square(latents) / 2).mean() + jnp.log(scale).mean(), {
        "latent_mean": jnp.abs(latents.mean(places)).max(),
        "latent_variance": latents.var(places).mean(),
    }


def world_frames(
    model: PersistConfig, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, Measured]:
    """Return the loss of stage ``world_frames``."""
    assert isinstance(train, PersistTrainConfig)
    made = _of(prepare_frames, model, params, clip)
    config = model.backbone.world_frames  # type: ignore[attr-defined]
    return losses.world_frames(
        config,
        model.voxel_noise,  # type: ignore[arg-type]
        params["voxel_dit"],
        made["latents"].astype(jnp.float32),
        made["actions"],
        made["told"].astype(jnp.float32),
        key,
        camera_BTN=made["camera"] if config.camera_numbers else None,
        blind=train.blind,
        known_BTxyz=made["known"],
        counted_BTxyz=made["counted"],
        dtype=jnp.dtype(model.dtype),
    )


def camera(
    model: PersistConfig, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, Measured]:
    """Return the loss of stage ``camera``."""
    del train, key
    made = _of(prepare_cameras, model, params, clip)
    return losses.camera(
        model.backbone.camera_model,  # type: ignore[attr-defined]
        params["camera_model"],
        made["classes"].astype(jnp.int32),
        made["middle"],
        made["camera"],
        made["actions"],
        model.clip.width,
        reckoned_BT6=reckoning(model, made["actions"]),
        dtype=jnp.dtype(model.dtype),
    )


def renderer(
    model: PersistConfig, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, Measured]:
    """Return the loss of stage ``renderer``."""
    del train
    made = _of(prepare_layers, model, params, clip)
    config = model.backbone.renderer  # type: ignore[attr-defined]
    layers = Layers(
        made["ids"].astype(jnp.int32),
        made["distance"].astype(jnp.float32),
        made["side"].astype(jnp.int32),
    )
    return losses.renderer(
        config,
        model.noise,  # type: ignore[arg-type]
        params["renderer"],
        made["latents"].astype(jnp.float32),
        layers,
        key,
        actions_BTA=made["actions"] if config.actions else None,
        dtype=jnp.dtype(model.dtype),
    )


def _stage(
    number: int, name: str, trained: str, networks: int, loss: Any, prepare: Any, **more: Any
) -> Stage:
    """Return a stage that trains what a pattern names, all else frozen."""
    return Stage(
        name=name,
        number=number,
        rules=((trained, TRAIN), (r".*", FREEZE)),
        init=functools.partial(init, networks=networks),
        loss=loss,
        prepare=prepare,
        prepares_by=("backbone", "codec", "voxel_vae"),
        **more,
    )


_WEIGHTS = r"voxel_vae/(encoder|decoder)/.*"
STAGES = (
    _stage(1, "voxel_vae", _WEIGHTS, 1, autoencode, prepare_grids),
    _stage(2, "voxel_statistics", STATISTICS, 1, distribute, prepare_grids),
    _stage(3, "world_frames", r"voxel_dit/.*", 2, world_frames, prepare_frames),
    _stage(4, "camera", r"camera_model/.*", 3, camera, prepare_cameras),
    _stage(5, "renderer", r"renderer/.*", 4, renderer, prepare_layers),
)
"""The stages, in order. The codec of pictures is given (``train.start``): the world ``codec``
trains it."""


def costs(config: Config, stage: Stage, share: Share) -> dict[str, Costs]:
    """Return the costs of one device by network."""
    model = config.model
    nets, frames = model.backbone, model.clip.frames
    if stage.number <= 2:
        made = vae_costs(nets.voxel_vae, share, GRIDS, trained=stage.number == 1)
        return {"voxel_vae": made}
    if stage.name == "camera":
        return {"camera_model": camera_model.costs(nets.camera_model, share, frames, trained=True)}
    found = {"codec": functions_of(model.codec).costs(model, share)}
    if stage.name == "renderer":
        made = voxel_renderer.costs(nets.renderer, share, frames, trained=True)
        return found | {"renderer": made}
    pixels = nets.renderer.height * nets.renderer.width
    return found | {
        "voxel_vae": vae_costs(nets.voxel_vae, share, frames, trained=False),
        "voxel_dit": voxel_dit.costs(nets.world_frames, share, frames, pixels, trained=True),
    }


def require_recorded(model: PersistConfig, clip: Clip) -> None:
    """Refuse data without what this world learns from.

    Raises:
        UserError: no voxels, no actions, or grids of another size.
    """
    memory, classes = model.memory, clip.classes_TXYZ
    groups = f"--voxels.kinds {memory.kinds} --voxels.colours {memory.colours}"  # type: ignore[attr-defined]
    command = (
        f"pewm-jax data collect DATA --moving --voxels --voxels.cell {windows.cell_m(model):g} "
        f"--voxels.side {memory.recorded} {groups}"  # type: ignore[attr-defined]
    )
    if classes is None or clip.actions_TA is None:
        raise UserError(
            f"the data have no voxels or no actions, from which this world learns: {command}."
        )
    if classes.shape[-1] != memory.recorded:  # type: ignore[attr-defined]
        raise UserError(
            f"the recorded grids have {classes.shape[-1]} cells along each axis, and memory."
            f"recorded is {memory.recorded}: {command}."  # type: ignore[attr-defined]
        )
