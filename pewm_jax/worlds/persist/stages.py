"""The stages of PERSIST's training and the loss of each; ``prepare.py`` prepares their batches."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.config import TrainSettings
from pewm_jax.geometry.march import RayHits
from pewm_jax.models.persist import nets as persist_nets
from pewm_jax.models.persist import voxel_vae
from pewm_jax.types import Array, Clip, Params
from pewm_jax.worlds.persist import losses, prepare
from pewm_jax.worlds.persist.config import PersistModel, PersistTrainConfig
from pewm_jax.worlds.persist.step import reckoned_steps
from pewm_jax.worlds.stages import FREEZE, TRAIN, Stage

Measured = dict[str, Array]
STATISTICS = r"voxel_vae/latent_(mean|scale)_C"
SMALL = 1e-4
"""The least scale of a latent."""


def init(model: PersistModel, key: Array, networks: int = len(persist_nets.NETWORKS)) -> Params:
    """Return random parameters of the codec and of the first ``networks`` networks."""
    codec_key, key = jax.random.split(key)
    names = persist_nets.NETWORKS[:networks]
    made = {"codec": model.codec.init(codec_key)}
    return made | model.backbone.init(key, names)  # type: ignore[call-arg, arg-type]


def _prepared(
    prepare: Callable[..., Clip], model: PersistModel, params: Params, clip: Clip
) -> dict[str, Any]:
    """Return a stage's inputs, prepared now if they were not before."""
    if "prepared" not in clip.extras:
        clip = prepare(model, jax.lax.stop_gradient(params), clip)
    return clip.extras["prepared"]


def autoencode(
    model: PersistModel, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, Measured]:
    """Return the loss of stage ``voxel_vae``."""
    del train
    grids: Any = _prepared(prepare.grids, model, params, clip)
    grids = grids.astype(jnp.int32).reshape(-1, *grids.shape[2:])
    config, dtype = model.backbone.voxel_vae, jnp.dtype(model.dtype)
    return voxel_vae.loss(config, params["voxel_vae"], grids, key, dtype)


def distribute(
    model: PersistModel, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, Measured]:
    """Return the loss of stage ``voxel_statistics``: least at mean 0 and variance 1 of latents."""
    del train, key
    grids: Any = _prepared(prepare.grids, model, params, clip)
    config, weights = model.backbone.voxel_vae, params["voxel_vae"]
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
    model: PersistModel, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, Measured]:
    """Return the loss of stage ``world_frames``."""
    assert isinstance(train, PersistTrainConfig)
    made = _prepared(prepare.frames, model, params, clip)
    config = model.backbone.world_frames

    def compare(x0: Array, weight: Array, key: Array) -> tuple[Array, Array]:
        vae, cells = model.backbone.voxel_vae, made["classes"]
        frozen = params["voxel_vae"]
        error, right = losses.class_error(vae, frozen, x0, cells, weight, train.compared, key)
        return train.classes * error, right

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
        weight_BTxyz=1 + (train.occupied - 1) * made["occupied"],
        compare=compare if train.classes else None,
        dtype=jnp.dtype(model.dtype),
    )


def camera(
    model: PersistModel, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, Measured]:
    """Return the loss of stage ``camera``."""
    del train, key
    made = _prepared(prepare.cameras, model, params, clip)
    return losses.camera(
        model.backbone.camera_model,
        params["camera_model"],
        made["classes"].astype(jnp.int32),
        made["middle"],
        made["camera"],
        made["actions"],
        model.clip.width,
        reckoned_BT6=reckoned_steps(model, made["actions"]),
        dtype=jnp.dtype(model.dtype),
    )


def renderer(
    model: PersistModel, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, Measured]:
    """Return the loss of stage ``renderer``."""
    del train
    made = _prepared(prepare.layers, model, params, clip)
    config = model.backbone.renderer
    layers = RayHits(
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
        drawn_BThwC=made["drawn"].astype(jnp.float32) if config.drawn else None,
        dtype=jnp.dtype(model.dtype),
    )


def _stage(
    number: int, name: str, trained: str, networks: int, loss: Any, prepare: Any, **more: Any
) -> Stage:
    """Return a stage that trains the parameters of a pattern; all others are frozen."""
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
    _stage(1, "voxel_vae", _WEIGHTS, 1, autoencode, prepare.grids),
    _stage(2, "voxel_statistics", STATISTICS, 1, distribute, prepare.grids),
    _stage(3, "world_frames", r"voxel_dit/.*", 2, world_frames, prepare.frames),
    _stage(4, "camera", r"camera_model/.*", 3, camera, prepare.cameras),
    _stage(5, "renderer", r"renderer/.*", 4, renderer, prepare.layers),
)
"""The stages, in order. The codec of images comes from ``train.start``: the world ``codec`` trains
it."""
