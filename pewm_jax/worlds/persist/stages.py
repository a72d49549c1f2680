"""The stages of PERSIST's training and the loss of each (arXiv 2603.03482).

``voxel_vae`` reconstructs grids; ``world_frames`` and ``renderer`` learn the velocity of latents,
with a time for each frame; ``camera`` learns the steps between cameras. ``prepare.py`` prepares
their batches; all arrays have a leading axis B.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.config import TrainSettings
from pewm_jax.config.parts import Noise
from pewm_jax.geometry.actions import camera_numbers, camera_steps_between
from pewm_jax.geometry.march import RayHits
from pewm_jax.memory.class_grid import UNKNOWN
from pewm_jax.models.persist import camera_model, voxel_dit, voxel_renderer, voxel_vae
from pewm_jax.models.persist import nets as persist_nets
from pewm_jax.models.persist.config import VoxelVAEConfig
from pewm_jax.nn.tokens import patchify
from pewm_jax.types import Array, Clip, Params
from pewm_jax.worlds.persist import corruption, prepare, voxel_frames
from pewm_jax.worlds.persist import state as grid_state
from pewm_jax.worlds.persist.config import PersistModel, PersistTrainConfig
from pewm_jax.worlds.persist.prepare import previous_frames
from pewm_jax.worlds.persist.step import reckoned_steps
from pewm_jax.worlds.stages import FREEZE, TRAIN, Stage

Measured = dict[str, Array]
Compare = Callable[[Array, Array, Array], tuple[Array, Array]]
"""``(x0_BTxyzC, weight_BTxyz, key) -> (error, right)``: a further error of the prediction, () and
already weighted, and the share of correct classes; see ``class_error``."""
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
    """Return the loss of stage ``world_frames``: the squared error of the velocity of latents.

    A frame is conditioned on the image and the camera of the frame before. Unknown latents are
    noise at any time; later frames do not read them, and their error does not count. With
    ``world_frames.map_embed`` a frame is also conditioned on a map of the cells observed up to it,
    with or without guesses of the others (``drawn_map``); the error of latents with cells that the
    map does not hold, or guesses wrongly, weighs ``train.new`` times as much. With
    ``train.frames_per_clip`` only so many frames of each clip, drawn at random, are predicted.
    """
    assert isinstance(train, PersistTrainConfig)
    made = _prepared(prepare.frames, model, params, clip)
    config = model.backbone.world_frames
    velocity_key, shown_key = jax.random.split(key)
    at_BT = _drawn_frames(train, made["known"].shape[:2], jax.random.fold_in(key, 1))

    def drawn(x: Array) -> Array:
        return x if at_BT is None else jax.vmap(lambda x, at: x[at])(x, at_BT)

    known = drawn(made["known"])
    latents = drawn(made["latents"]).astype(jnp.float32)
    pixels = drawn(previous_frames(made["told"])).astype(jnp.float32)
    weight = 1 + (train.occupied - 1) * drawn(made["occupied"])
    read, given = known, None
    if config.map_embed:
        map_key, velocity_key = jax.random.split(velocity_key)
        given = drawn_map(model, train, made, map_key, at_BT)
        ids, states = given
        wrong = (states == voxel_dit.GUESS) & (ids != drawn(made["classes"]))
        new = prepare.any_in_latent(model, wrong | (states == voxel_dit.ABSENT))
        weight = weight * jnp.where(new, train.new, 1.0)
        read = known & grid_state.any_in_token(model, states == voxel_dit.SEEN)
    shown = jax.random.uniform(shown_key, made["known"].shape[:2]) >= train.blind
    shown = shown | (jnp.arange(shown.shape[1]) == 0)
    predict = functools.partial(
        voxel_dit.apply,
        config,
        params["voxel_dit"],
        actions_BTA=drawn(made["actions"]),
        pixels_BThwC=pixels,
        camera_BTN=drawn(previous_frames(made["camera"])) if config.camera_numbers else None,
        shown_BT=drawn(shown) if train.blind else None,
        known_BTxyz=read,
        map_BTXYZ=given,
    )

    def compare(x0: Array, weight: Array, key: Array) -> tuple[Array, Array]:
        vae, frozen = model.backbone.voxel_vae, params["voxel_vae"]
        classes = drawn(made["classes"])
        error, right = class_error(vae, frozen, x0, classes, weight, train.compared, key)
        return train.classes * error, right

    return _velocity(
        model.voxel_noise,
        lambda x, t: predict(x, t)[0],
        latents,
        velocity_key,
        jnp.dtype(model.dtype),
        known=known,
        counts=weight,
        compare=compare if train.classes else None,
    )


def _drawn_frames(train: PersistTrainConfig, shape: tuple[int, ...], key: Array) -> Array | None:
    """Return the numbers of the frames (B, T) that a step trains on; None for all."""
    batch, frames = shape
    count = min(train.frames_per_clip or frames, frames)
    if count == frames:
        return None
    keys = jax.random.split(key, batch)
    return jax.vmap(lambda key: jnp.sort(jax.random.permutation(key, frames)[:count]))(keys)


def drawn_map(
    model: PersistModel,
    train: PersistTrainConfig,
    made: dict[str, Array],
    key: Array,
    at_BT: Array | None = None,
) -> tuple[Array, Array]:
    """Return ids and states (B, T, X, Y, Z) of the maps that condition frames of clips.

    ``at_BT`` are the numbers of the frames in their clips; None for all of them.

    The frames up to a drawn one are real: what they show is observed, and so are the cells of some
    of the views before the clip. In some clips the other cells are guesses: the true cells with
    errors (``corruption``), or those of another clip; except, in some of these, at one side of the
    window.
    """
    classes, frames = made["classes"].astype(jnp.int32), made["classes"].shape[1]

    def one(
        classes: Array,
        other: Array,
        seen: Array,
        before: Array,
        known: Array,
        at: Array,
        key: Array,
    ) -> tuple[Array, Array]:
        keys = jax.random.split(key, 6)
        last = jax.random.randint(keys[0], (), 0, frames)
        number, known = jnp.minimum(at, last), known[at]
        share = jax.random.uniform(keys[1])
        views = jax.random.bernoulli(keys[2], share, (prepare.VIEWS,))
        bits = (views * (1 << jnp.arange(prepare.VIEWS))).sum().astype(jnp.uint8)
        observed = (seen <= number[:, None, None, None]) | ((before & bits) != 0)
        cells = classes[number]
        guess_key, side_key, colour_key = jax.random.split(keys[3], 3)
        guesses, entering = (
            jax.random.bernoulli(k, p)
            for k, p in zip(keys[4:], (train.guessed, train.entering), strict=True)
        )
        elsewhere = jax.random.bernoulli(jax.random.fold_in(guess_key, 1), train.elsewhere)
        wrong = corruption.corrupt(jnp.where(elsewhere, other, classes[0]), guess_key)
        wrong = jnp.where(guesses, wrong, UNKNOWN)
        absent = guesses & entering & _side(model, side_key)
        ids = jnp.where(observed, cells, wrong)
        ids = jnp.where(absent | (cells == UNKNOWN) | ~known, UNKNOWN, ids)
        states = jnp.where(observed, voxel_dit.SEEN, voxel_dit.GUESS)
        states = jnp.where(ids == UNKNOWN, voxel_dit.ABSENT, states)
        # The kinds of surfaces that are observed for the first time are not known.
        colours = voxel_frames.coloured_surface(model, (ids - 1) % model.memory.colours)
        fresh = (seen == number[:, None, None, None]) | jax.random.bernoulli(colour_key)
        coloured = fresh & (states == voxel_dit.SEEN) & (ids > 0)
        return jnp.where(coloured, colours, ids), states

    token = model.backbone.voxel_vae.factor
    known = made["known"]
    for axis in (-3, -2, -1):
        known = jnp.repeat(known, token, axis)
    keys = jax.random.split(key, len(classes))
    others = jnp.roll(classes[:, 0], 1, 0)
    if at_BT is None:
        at_BT = jnp.broadcast_to(jnp.arange(frames), classes.shape[:2])
    return jax.vmap(one)(classes, others, made["seen"], made["before"], known, at_BT, keys)


def _side(model: PersistModel, key: Array) -> Array:
    """Return (X, Y, Z) bool: one or two layers of tokens at one side of a window, drawn."""
    axis_key, far_key, count_key = jax.random.split(key, 3)
    token, side = model.backbone.token_cells, model.side
    width = jax.random.randint(count_key, (), 1, 3) * token
    at = jnp.where(jax.random.bernoulli(far_key), jnp.arange(side), side - 1 - jnp.arange(side))
    within = at < width
    by_x = jax.random.bernoulli(axis_key)
    chosen = jnp.where(by_x, within[:, None], within[None])
    return jnp.broadcast_to(chosen[..., None], (side,) * 3)


def camera(
    model: PersistModel, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, Measured]:
    """Return the loss of stage ``camera``: the squared error of steps, in the network's units.

    The position of a grid tells where the agent has gone. A camera's position is therefore relative
    to the middle of its own frame's grid, not of the grid that the step leads to. ``metres_off``
    and ``radians_off`` are mean lengths of the errors.
    """
    del train, key
    made = _prepared(prepare.cameras, model, params, clip)
    config, width = model.backbone.camera_model, model.clip.width
    classes, actions = made["classes"].astype(jnp.int32), made["actions"]
    reckoned = reckoned_steps(model, actions)
    before, after = (
        jax.tree.map(lambda x, c=c: x[:, c], made["camera"]) for c in (slice(-1), slice(1, None))
    )
    seen = camera_numbers(before, width, made["middle"][:, :-1])
    weights, dtype = params["camera_model"], jnp.dtype(model.dtype)
    steps, _ = camera_model.apply(
        config, weights, classes[:, 1:], seen, actions[:, 1:], dtype=dtype
    )
    off = steps + reckoned[:, 1:] - camera_steps_between(before, after, width)
    measured = {
        "metres_off": jnp.linalg.norm(off[..., :3], axis=-1).mean(),
        "radians_off": jnp.linalg.norm(off[..., 3:5], axis=-1).mean(),
    }
    return jnp.square(off / jnp.asarray(config.units)).mean(), measured


def renderer(
    model: PersistModel, train: TrainSettings, params: Params, clip: Clip, key: Array
) -> tuple[Array, Measured]:
    """Return the loss of stage ``renderer``: the squared error of the velocity of latents."""
    del train
    made = _prepared(prepare.layers, model, params, clip)
    config, weights = model.backbone.renderer, params["renderer"]
    layers = RayHits(
        made["ids"].astype(jnp.int32),
        made["distance"].astype(jnp.float32),
        made["side"].astype(jnp.int32),
    )
    latents, dtype = made["latents"].astype(jnp.float32), jnp.dtype(model.dtype)
    drawn = made["drawn"].astype(jnp.float32) if config.drawn else None
    actions = made["actions"] if config.actions else None
    seen = voxel_renderer.features(config, weights, layers, dtype, drawn_hwC=drawn)
    predict = functools.partial(
        voxel_renderer.apply, config, weights, features_BThwF=seen, actions_BTA=actions
    )
    return _velocity(model.noise, lambda x, t: predict(x, t)[0], latents, key, dtype)


def _velocity(
    noise: Any,
    predict: Callable[[Array, Array], Array],
    x0: Array,
    key: Array,
    dtype: Any,
    *,
    known: Array | None = None,
    counts: Array | None = None,
    compare: Compare | None = None,
) -> tuple[Array, Measured]:
    """Return the squared error of velocities and of x0, at times drawn for each frame."""
    time_key, noise_key = jax.random.split(key)
    times = noise.draw(time_key, *x0.shape[:2])
    times = jnp.broadcast_to(times if times.ndim == 2 else times[:, None], x0.shape[:2])
    drawn = jax.random.normal(noise_key, x0.shape)
    x_t = noise.corrupt(x0, drawn, times)
    if known is not None:
        x_t = jnp.where(known[..., None], x_t, drawn)
    inputs, network_times = noise.precondition(x_t, times)
    made = predict(inputs.astype(dtype), network_times).astype(jnp.float32)
    error = jnp.square(made - noise.prediction_target(x0, drawn, times))
    weight = Noise.expand(noise.weight(times), error.ndim)
    made_x0 = noise.to_x0(made, x_t, times)
    x0_error = jnp.square(made_x0 - x0)

    share = jnp.ones(x0.shape[:-1]) if known is None else known.astype(jnp.float32)

    def mean(x: Array, share: Array) -> Array:
        return (x * (share / jnp.maximum(share.mean(), 1e-6))[..., None]).mean()

    counted = share if counts is None else share * counts
    loss, measured = mean(error * weight, counted), {"x0_error": mean(x0_error, share)}
    if compare is None:
        return loss, measured
    compared, right = compare(made_x0, counted, jax.random.fold_in(key, 2))
    return loss + compared, measured | {"classes": compared, "classes_right": right}


def class_error(
    config: VoxelVAEConfig,
    params: Params,
    latents_BTxyzC: Array,
    classes_BTXYZ: Array,
    weight_BTxyz: Array,
    count: int,
    key: Array,
) -> tuple[Array, Array]:
    """Return the cross-entropy of the cells of ``count`` latents per frame, drawn by their weight.

    ``config`` is an autoencoder that ``PersistTrainConfig.classes`` accepts; latents are
    normalised; class ids are below 0 if unknown; latents of weight 0 are never drawn.

    Returns:
        ``(error, right)``: () nats per cell, () the share of cells whose class is the likeliest.
    """
    frames, side = latents_BTxyzC.shape[0] * latents_BTxyzC.shape[1], config.latent_side
    flat = latents_BTxyzC.reshape(frames, side**3, -1)
    weight = weight_BTxyz.reshape(frames, -1).astype(jnp.float32)
    cells = cells_of_latents(config, classes_BTXYZ.reshape(frames, *classes_BTXYZ.shape[2:]))
    drawn = voxel_vae.sample_cells(weight, count, key)[..., None]
    error, right = latent_class_error(
        config,
        params,
        jnp.take_along_axis(flat, drawn, 1).reshape(frames * count, -1),
        jnp.take_along_axis(cells, drawn, 1).reshape(frames * count, -1),
    )
    # Latents drawn from an unknown frame do not count.
    counts = jnp.repeat((weight.sum(1) > 0).astype(jnp.float32), count)
    share = counts / jnp.maximum(counts.sum(), 1)
    return (error * share).sum(), (right * share).sum()


def cells_of_latents(config: VoxelVAEConfig, classes_BXYZ: Array) -> Array:
    """Return (B, latents, cells of one), a latent's cells in the order X, Y, Z."""
    return patchify(classes_BXYZ[..., None], config.factor, config.factor)


def latent_class_error(
    config: VoxelVAEConfig, params: Params, latents_NC: Array, classes_NK: Array
) -> tuple[Array, Array]:
    """Return the cross-entropy of the cells of normalised latents, each decoded alone.

    Returns:
        ``(error_N, right_N)``: the mean over the known cells of a latent (ids ≥ 0), in nats, and
        the share of them whose class is the likeliest.
    """
    alone = dataclasses.replace(config, side=config.factor, cube=0, slab=0)
    scores = voxel_vae.logits(alone, params, latents_NC[:, None, None, None])
    scores = scores.reshape(*classes_NK.shape, -1).astype(jnp.float32)
    ids = jnp.maximum(classes_NK, 0).astype(jnp.int32)
    chosen = jnp.take_along_axis(scores, ids[..., None], -1)[..., 0]
    known = (classes_NK >= 0).astype(jnp.float32)
    share = known / jnp.maximum(known.sum(1, keepdims=True), 1)
    missed, right = jax.nn.logsumexp(scores, -1) - chosen, chosen >= scores.max(-1)
    return (missed * share).sum(1), (right * share).sum(1)


def _stage(
    number: int, name: str, trained: str, networks: int, loss: Any, prepare: Any, *reads: str
) -> Stage:
    """Return a stage that trains the parameters of a pattern; all others are frozen.

    To prepare its clips it ``reads`` parameters besides those of the two autoencoders. The name of
    ``prepare`` keeps clips on disk apart from those of other stages.
    """
    return Stage(
        name=name,
        number=number,
        rules=((trained, TRAIN), (r".*", FREEZE)),
        init=functools.partial(init, networks=networks),
        loss=loss,
        prepare=prepare,
        prepares_by=("backbone", "codec", "voxel_vae", *reads, f"prepare.{prepare.__name__}"),
    )


_WEIGHTS = r"voxel_vae/(encoder|decoder)/.*"
STAGES = (
    _stage(1, "voxel_vae", _WEIGHTS, 1, autoencode, prepare.grids),
    _stage(2, "voxel_statistics", STATISTICS, 1, distribute, prepare.grids),
    _stage(3, "world_frames", r"voxel_dit/.*", 2, world_frames, prepare.frames),
    _stage(4, "camera", r"camera_model/.*", 3, camera, prepare.cameras),
    _stage(5, "renderer", r"renderer/.*", 4, renderer, prepare.layers, "voxel_dit"),
)
"""The stages, in order. The codec of images comes from ``train.start``: the world ``codec`` trains
it."""
