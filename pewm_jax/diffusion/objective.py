"""The training loss of both stages (paper, Eqs. 3 and 4; see ``schedule`` for the targets)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pewm_jax.config import Config
from pewm_jax.diffusion import schedule
from pewm_jax.memory import features as image_features
from pewm_jax.memory import memories
from pewm_jax.models import codec, placement, world_model
from pewm_jax.types import Array, Camera, Clip, Frames, MapTokens, Params


def as_signal(frames: Frames) -> Frames:
    """Return frames with colours as floats in [−1, 1]."""
    return Frames(codec.signal_from_rgb(frames.rgb_THWC), frames.depth_THW, frames.camera)


def remember(
    config: Config,
    params: Params,
    context: Frames,
    valid_S: Array,
    features_ShwF: Array | None = None,
) -> memories.Memory:
    """Build the memory of one world from its context frames.

    The grid is centred on the last valid context frame's camera.

    Args:
        config: the experiment.
        params: the world model's parameters; those of the image encoder are used.
        context: S frames of one world, colours in [−1, 1].
        valid_S: (S,) bool, False frames are ignored.
        features_ShwF: (S, h, w, F) what the encoder makes of the context, if it is known already.
    """
    last = jnp.argmax(jnp.where(valid_S, jnp.arange(valid_S.shape[0]), -1))
    centre = context.camera.world_from_camera[last, :3, 3]
    memory = memories.empty(config, centre)
    if features_ShwF is None:
        weights = params.get("encoder", {})
        features = image_features.encode(config.memory, weights, context.rgb_THWC)
    else:
        features = features_ShwF.astype(jnp.float32)
    return memories.remember(config, memory, context, features, valid_S)


def clip_tokens(config: Config, params: Params, clip: Clip) -> MapTokens:
    """Build every clip's memory from its context and return its tokens, leading axis B."""

    def one(context: Frames, valid_S: Array, features: Array, camera: Camera) -> MapTokens:
        memory = remember(config, {}, context, valid_S, features)
        return memories.tokens(config, memory, camera)

    def some(weights: Params, clip: Clip) -> MapTokens:
        features = clip.context_features_ShwF
        if features is None:
            features = _encode(config, weights, clip.context.rgb_THWC)
        context = as_signal(clip.context)
        return jax.vmap(one)(context, clip.context_valid_S, features, clip.frames.camera)

    return placement.by_batch(some, params.get("encoder", {}), clip)


def _encode(config: Config, weights: Params, rgb_BSHWC: Array) -> Array:
    """Return the features of every clip's context; a large encoder sees clip by clip."""

    def one(rgb_SHWC: Array) -> Array:
        return image_features.encode(config.memory, weights, codec.signal_from_rgb(rgb_SHWC))

    if config.memory.encoder == "patch_colours":
        return jax.vmap(one)(rgb_BSHWC)
    return jax.lax.map(one, rgb_BSHWC)


def loss(
    config: Config, params: Params, clip: Clip, key: Array, *, memory: bool
) -> tuple[Array, dict[str, Array]]:
    """Return the loss of one batch and its parts.

    Args:
        config: the experiment.
        params: the world model's parameters.
        clip: a batch, leading axis B, colours uint8 or float.
        key: randomness of times, noise and image noise.
        memory: False in stage 1, True in stage 2.

    Returns:
        ``(loss, {"loss_rgb", "loss_depth"})``: the weighted squared error of x0, averaged over
        everything with valid depth; for target v or ε the plain squared error of the target.
        Where the denoiser works without depth (``memory.depth``), colour alone counts.
    """
    frames = as_signal(clip.frames)
    x0 = codec.encode_rgbd(config, params, frames.rgb_THWC, frames.depth_THW)
    batch = x0.shape[0]
    time_key, noise_key, level_key, image_key = jax.random.split(key, 4)
    diffusion = config.diffusion
    timesteps = jax.random.randint(time_key, (batch,), 0, diffusion.train_steps)
    noise = jax.random.normal(noise_key, x0.shape)
    x_t = schedule.add_noise(diffusion, x0, noise, timesteps)

    level = jnp.exp(
        diffusion.image_noise_mean
        + diffusion.image_noise_std * jax.random.normal(level_key, (batch, 1, 1, 1))
    )
    first = frames.rgb_THWC[:, 0]
    first = first + level * jax.random.normal(image_key, first.shape)
    conditioning = world_model.condition(
        config, params, first, frames.depth_THW[:, 0], frames.camera
    )
    tokens = clip_tokens(config, params, clip) if memory else None
    prediction = world_model.apply(config, params, x_t, conditioning, timesteps, tokens)

    error = (prediction - schedule.target(diffusion, x0, noise, timesteps)) ** 2
    if diffusion.target == "x0":
        error = error * schedule.x0_weight(diffusion, timesteps)[:, None, None, None, None]
    split = codec.rgb_channels(config)
    measured = jnp.broadcast_to(codec.measured(config, frames.depth_THW), error[..., split:].shape)
    rgb = error[..., :split].mean()
    depth = (error[..., split:] * measured).sum() / jnp.maximum(measured.sum(), 1)
    if not config.memory.depth:
        return rgb, {"loss_rgb": rgb, "loss_depth": depth}
    channels = error.shape[-1]
    total = (rgb * split + depth * (channels - split)) / channels
    return total, {"loss_rgb": rgb, "loss_depth": depth}
