"""The losses of PERSIST's networks, one for each stage (arXiv 2603.03482).

``world_frames`` and ``renderer`` learn the velocity of latents,
with a time for each frame; ``camera`` learns the steps between cameras. All are functions of arrays
with a leading axis B. In ``actions_BTA`` row t is the action that leads to frame t, zeros for the
first; ``leading_actions`` computes them from recorded ones, which lead away.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.config.parts import Noise
from pewm_jax.diffusion.flow import FrameFlowConfig
from pewm_jax.geometry.actions import camera_numbers, camera_steps_between
from pewm_jax.geometry.march import RayHits
from pewm_jax.models.persist import camera_model, voxel_dit, voxel_renderer
from pewm_jax.models.persist import voxel_vae as voxel_vae_model
from pewm_jax.models.persist.config import (
    CameraModelConfig,
    VoxelDiTConfig,
    VoxelRendererConfig,
    VoxelVAEConfig,
)
from pewm_jax.nn.tokens import patchify
from pewm_jax.types import Array, Camera, Params

Measured = dict[str, Array]
Compare = Callable[[Array, Array, Array], tuple[Array, Array]]
"""``(x0_BTxyzC, weight_BTxyz, key) -> (error, right)``: a further error of the prediction, () and
already weighted, and the share of correct classes; see ``losses.compared``."""


def leading_actions(actions_BTA: Array) -> Array:
    """Turn (B, T − 1, A) actions that lead away from frames into (B, T, A) that lead to them."""
    return jnp.pad(jnp.asarray(actions_BTA), ((0, 0), (1, 0), (0, 0)))


def previous_frames(frames: Any) -> Any:
    """Return for each frame of (B, T, …) arrays the value of the frame before.

    The first frame keeps its own, from which a world can begin (w₀ from o₀).
    """
    return jax.tree.map(lambda x: jnp.concatenate([x[:, :1], x[:, :-1]], 1), frames)


def world_frames(
    config: VoxelDiTConfig,
    noise: FrameFlowConfig,
    params: Params,
    latents_BTxyzC: Array,
    actions_BTA: Array,
    pixels_BThwC: Array,
    key: Array,
    *,
    camera_BTN: Array | None = None,
    blind: float = 0.0,
    known_BTxyz: Array | None = None,
    weight_BTxyz: Array | None = None,
    compare: Compare | None = None,
    dtype: Any = jnp.float32,
) -> tuple[Array, Measured]:
    """Return the squared error of the velocity of voxel frames.

    ``latents_BTxyzC`` are normalised; ``actions_BTA`` lead to each frame; ``pixels_BThwC`` and
    ``camera_BTN`` are latents of the image and numbers of the camera at each frame (see
    ``previous_frames``). A share ``blind`` of the frames after the first is not conditioned on an
    image. Latents that ``known_BTxyz`` excludes are noise at any time; later frames do not read
    them, and their error does not count. ``weight_BTxyz`` weights each latent's error; ``compare``
    adds one of the predicted x0.
    """
    velocity_key, shown_key = jax.random.split(key)
    front = latents_BTxyzC.shape[:2]
    shown = jax.random.uniform(shown_key, front) >= blind
    predict = functools.partial(
        voxel_dit.apply,
        config,
        params,
        actions_BTA=actions_BTA,
        pixels_BThwC=previous_frames(pixels_BThwC),
        camera_BTN=None if camera_BTN is None else previous_frames(camera_BTN),
        shown_BT=shown | (jnp.arange(front[1]) == 0) if blind else None,
        known_BTxyz=known_BTxyz,
    )
    return _velocity(
        noise,
        lambda x, t: predict(x, t)[0],
        latents_BTxyzC,
        velocity_key,
        dtype,
        known=known_BTxyz,
        counts=weight_BTxyz,
        compare=compare,
    )


def camera(
    config: CameraModelConfig,
    params: Params,
    classes_BTXYZ: Array,
    middle_BT3: Array,
    cameras: Camera,
    actions_BTA: Array,
    width: int,
    *,
    reckoned_BT6: Array | None = None,
    dtype: Any = jnp.float32,
) -> tuple[Array, Measured]:
    """Return the mean squared error of the steps between (B, T) cameras, in ``config.units``.

    The position of a grid tells where the agent has gone. A camera's position is therefore relative
    to the middle of its own frame's grid, ``middle_BT3`` in metres, not of the grid that the step
    leads to. ``actions_BTA`` and the steps ``reckoned_BT6``, to which the network's output is
    added, lead to each frame. ``width`` is that of the images, pixels.

    Returns:
        ``(loss, {"metres_off", "radians_off"})``: mean lengths of the errors.
    """
    before, after = (
        jax.tree.map(lambda x, c=c: x[:, c], cameras) for c in (slice(-1), slice(1, None))
    )
    seen = camera_numbers(before, width, middle_BT3[:, :-1])
    made, _ = camera_model.apply(
        config, params, classes_BTXYZ[:, 1:], seen, actions_BTA[:, 1:], dtype=dtype
    )
    if reckoned_BT6 is not None:
        made = made + reckoned_BT6[:, 1:]
    off = made - camera_steps_between(before, after, width)
    measured = {
        "metres_off": jnp.linalg.norm(off[..., :3], axis=-1).mean(),
        "radians_off": jnp.linalg.norm(off[..., 3:5], axis=-1).mean(),
    }
    return jnp.square(off / jnp.asarray(config.units)).mean(), measured


def renderer(
    config: VoxelRendererConfig,
    noise: FrameFlowConfig,
    params: Params,
    latents_BThwC: Array,
    layers: RayHits,
    key: Array,
    *,
    actions_BTA: Array | None = None,
    drawn_BThwC: Array | None = None,
    dtype: Any = jnp.float32,
) -> tuple[Array, Measured]:
    """Return the squared error of the velocity of the images' latents.

    ``layers`` are the (B, T, h, w, L) hits of their rays, from ``voxel_renderer.cast_rays``. The
    actions that lead to each frame and the latents of the drawn voxels are for networks that take
    them.
    """
    seen = voxel_renderer.features(config, params, layers, dtype, drawn_hwC=drawn_BThwC)
    predict = functools.partial(
        voxel_renderer.apply, config, params, features_BThwF=seen, actions_BTA=actions_BTA
    )
    return _velocity(noise, lambda x, t: predict(x, t)[0], latents_BThwC, key, dtype)


def _velocity(
    noise: FrameFlowConfig,
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
    drawn = voxel_vae_model.sample_cells(weight, count, key)[..., None]
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
    scores = voxel_vae_model.logits(alone, params, latents_NC[:, None, None, None])
    scores = scores.reshape(*classes_NK.shape, -1).astype(jnp.float32)
    ids = jnp.maximum(classes_NK, 0).astype(jnp.int32)
    chosen = jnp.take_along_axis(scores, ids[..., None], -1)[..., 0]
    known = (classes_NK >= 0).astype(jnp.float32)
    share = known / jnp.maximum(known.sum(1, keepdims=True), 1)
    missed, right = jax.nn.logsumexp(scores, -1) - chosen, chosen >= scores.max(-1)
    return (missed * share).sum(1), (right * share).sum(1)
