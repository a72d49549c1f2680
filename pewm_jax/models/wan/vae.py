"""Wan's video autoencoder, equal to diffusers' ``AutoencoderKLWan`` of Wan 2.1 and Cosmos-Predict2.

Four frames of 8 × 8 pixels become one latent; the first frame has a latent of its own. Every layer
is causal, so 4n + 1 frames become n + 1 latents and 4n + 1 frames again, and no latent depends on
a later frame. The first frame is encoded alone and then four frames at a time, decoded one latent
at a time; layers pass their last frames on to the next chunk, and the result is that of the whole
clip at once. The chunks bound the memory.

Chunks share one compiled body. Inside ``jit`` they are scanned. Outside, ``encode`` and ``decode``
call a compiled function per chunk, so two compilations serve videos of any length.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer

from pewm_jax.config import UserError, WanVAEConfig
from pewm_jax.models.cogvideox.vae_shapes import draw
from pewm_jax.models.svd.layers import linear
from pewm_jax.models.svd.shapes import Leaf, conv
from pewm_jax.models.wan import layers
from pewm_jax.types import Array, Params

LOGVAR_RANGE = (-30.0, 20.0)
"""The logarithm of a latent's variance is clipped to this range."""


def layout(config: WanVAEConfig) -> dict[str, tuple[int, ...]]:
    """Return ``{path: shape}`` of the parameters.

    A 3D convolution is ``kernel (3, 3, 3, in, out)`` and ``bias``, one of frames ``(3, 3, in,
    out)``, one in time ``(3, in, out)``, a linear layer ``(in, out)``; a norm is ``scale``.
    """
    return dict([*_encoder(config), *_decoder(config)])


def init(config: WanVAEConfig, key: Array) -> Params:
    """Return random parameters, float32: ``{"encoder": …, "decoder": …}``."""
    return draw(layout(config), key)


def normalise(config: WanVAEConfig, latents_BthwC: Array) -> Array:
    """Return latents of mean 0 and deviation 1 in each channel, as the diffusion model has them."""
    mean, std = _statistics(config, latents_BthwC.dtype)
    return (latents_BthwC - mean) / std


def restore(config: WanVAEConfig, latents_BthwC: Array) -> Array:
    """Invert ``normalise``."""
    mean, std = _statistics(config, latents_BthwC.dtype)
    return latents_BthwC * std + mean


def _statistics(config: WanVAEConfig, dtype: jnp.dtype) -> tuple[Array, Array]:
    return jnp.asarray(config.latents_mean, dtype), jnp.asarray(config.latents_std, dtype)


def encode(config: WanVAEConfig, params: Params, video_BTHWC: Array) -> tuple[Array, Array]:
    """Encode a video to the mean and variance of its latents.

    To sample, compute mean + exp(logvar / 2)·noise.

    Args:
        config: the autoencoder.
        params: its parameters.
        video_BTHWC: (B, T, H, W, C) floats in [−1, 1]; their dtype is that of the computation.
            T is 4n + 1. Rows and columns beyond a multiple of ``config.spatial`` become no
            latents, as in the reference.

    Returns:
        Mean and logarithm of the variance, each (B, n + 1, H/8, W/8, z), not normalised.

    Raises:
        UserError: an array of another shape, or a video that cannot be encoded.
    """
    _check(video_BTHWC, config.in_channels, "video_BTHWC")
    frames, height, width = video_BTHWC.shape[1:4]
    if frames % 4 != 1:
        raise UserError(
            f"a video of {frames} frames cannot be encoded: use 4n + 1 frames (1, 5, 9, …)."
        )
    if min(height, width) < config.spatial:
        raise UserError(
            f"a video of {height}×{width} pixels is smaller than one latent, "
            f"{config.spatial}×{config.spatial}: enlarge it."
        )
    moments = _in_chunks(partial(_encode_chunk, config, params["encoder"]), video_BTHWC, 4)
    mean, logvar = jnp.split(moments, 2, -1)
    return mean, jnp.clip(logvar, *LOGVAR_RANGE)


def decode(config: WanVAEConfig, params: Params, latents_BthwC: Array) -> Array:
    """Decode latents to a video.

    Args:
        config: the autoencoder.
        params: its parameters.
        latents_BthwC: (B, t, h, w, z) latents, not normalised; their dtype is that of the
            computation.

    Returns:
        (B, 4·(t − 1) + 1, 8h, 8w, C) video, clipped to [−1, 1].

    Raises:
        UserError: an array of another shape.
    """
    _check(latents_BthwC, config.latent_channels, "latents_BthwC")
    step = partial(_decode_chunk, config, params["decoder"])
    return jnp.clip(_in_chunks(step, latents_BthwC, 1), -1, 1)


def _in_chunks(
    step: Callable[[Array, Params | None], tuple[Array, Params]], x_BTHWC: Array, size: int
) -> Array:
    """Run ``step(chunk, past) → (out, past)`` on the first frame, then on ``size`` at a time."""
    batch, frames, *rest = x_BTHWC.shape
    first, past = step(x_BTHWC[:, :1], None)
    if frames == 1:
        return first
    if not isinstance(x_BTHWC, Tracer):
        outs = [first]
        for start in range(1, frames, size):
            out, past = step(x_BTHWC[:, start : start + size], past)
            outs.append(out)
        return jnp.concatenate(outs, 1)

    def body(past: Params, chunk: Array) -> tuple[Params, Array]:
        out, past = step(chunk, past)
        return past, out

    chunks = jnp.moveaxis(x_BTHWC[:, 1:].reshape(batch, -1, size, *rest), 1, 0)
    _, outs = jax.lax.scan(body, past, chunks)
    outs = jnp.moveaxis(outs, 0, 1).reshape(batch, -1, *first.shape[2:])
    return jnp.concatenate([first, outs], 1)


@partial(jax.jit, static_argnums=0)
def _encode_chunk(
    config: WanVAEConfig, params: Params, x: Array, past: Params | None
) -> tuple[Array, Params]:
    new: dict[str, Any] = {}
    x, new["conv_in"] = layers.causal_conv(config, params["conv_in"], x, _of(past, "conv_in"))
    for level in range(len(config.multiples)):
        name = f"down_{level}"
        x, new[name] = _resnets(config, params[name], x, _of(past, name))
        if "resample" in params[name]:
            before = _of(_of(past, name), "resample")
            x, new[name]["resample"] = layers.downsample(params[name]["resample"], x, before)
    x, new["mid"] = layers.middle(config, params["mid"], x, _of(past, "mid"))
    x = layers.active(params["norm_out"], x)
    x, new["conv_out"] = layers.causal_conv(config, params["conv_out"], x, _of(past, "conv_out"))
    return linear(params["quant"], x), new


@partial(jax.jit, static_argnums=0)
def _decode_chunk(
    config: WanVAEConfig, params: Params, x: Array, past: Params | None
) -> tuple[Array, Params]:
    new: dict[str, Any] = {}
    x = linear(params["quant"], x)
    x, new["conv_in"] = layers.causal_conv(config, params["conv_in"], x, _of(past, "conv_in"))
    x, new["mid"] = layers.middle(config, params["mid"], x, _of(past, "mid"))
    for level in range(len(config.multiples)):
        name = f"up_{level}"
        x, new[name] = _resnets(config, params[name], x, _of(past, name))
        if "resample" in params[name]:
            before = _of(_of(past, name), "resample")
            x, new[name]["resample"] = layers.upsample(params[name]["resample"], x, before)
    x = layers.active(params["norm_out"], x)
    x, new["conv_out"] = layers.causal_conv(config, params["conv_out"], x, _of(past, "conv_out"))
    return x, new


def _resnets(
    config: WanVAEConfig, params: Params, x: Array, past: Params | None
) -> tuple[Array, Params]:
    new: dict[str, Any] = {}
    for k in range(sum(name.startswith("resnet") for name in params)):
        name = f"resnet_{k}"
        x, new[name] = layers.resnet(config, params[name], x, _of(past, name))
    return x, new


def _of(past: Params | None, name: str) -> Any:
    return None if past is None else past[name]


def _encoder(config: WanVAEConfig) -> Iterator[Leaf]:
    inside, moments = config.base_width, 2 * config.latent_channels
    yield from conv("encoder/conv_in", (3, 3, 3), config.in_channels, inside)
    for level, multiple in enumerate(config.multiples):
        where, width = f"encoder/down_{level}", multiple * config.base_width
        for k in range(config.resnets):
            yield from layers.resnet_shapes(f"{where}/resnet_{k}", inside, width)
            inside = width
        if level < len(config.halves_time):
            yield from conv(f"{where}/resample/space", (3, 3), width, width)
            if config.halves_time[level]:
                yield from conv(f"{where}/resample/time", (3,), width, width)
    yield from layers.middle_shapes("encoder/mid", inside)
    yield "encoder/norm_out/scale", (inside,)
    yield from conv("encoder/conv_out", (3, 3, 3), inside, moments)
    yield from conv("encoder/quant", (), moments, moments)


def _decoder(config: WanVAEConfig) -> Iterator[Leaf]:
    widths = [multiple * config.decoder_base_width for multiple in config.multiples[::-1]]
    inside, latent = widths[0], config.latent_channels
    yield from conv("decoder/quant", (), latent, latent)
    yield from conv("decoder/conv_in", (3, 3, 3), latent, inside)
    yield from layers.middle_shapes("decoder/mid", inside)
    for level, width in enumerate(widths):
        where = f"decoder/up_{level}"
        for k in range(config.resnets + 1):
            yield from layers.resnet_shapes(f"{where}/resnet_{k}", inside, width)
            inside = width
        if level < len(config.halves_time):
            inside = width // 2
            yield from conv(f"{where}/resample/space", (3, 3), width, inside)
            if config.halves_time[::-1][level]:
                yield from conv(f"{where}/resample/time", (3,), width, 2 * width)
    yield "decoder/norm_out/scale", (inside,)
    yield from conv("decoder/conv_out", (3, 3, 3), inside, config.out_channels)


def _check(x: Array, channels: int, name: str) -> None:
    if x.ndim != 5 or x.shape[-1] != channels:
        raise UserError(
            f"{name} has shape {tuple(x.shape)}: five axes are needed, batch, time, height, width "
            f"and {channels} channels last."
        )
    if not jnp.issubdtype(x.dtype, jnp.floating):
        raise UserError(f"{name} holds {x.dtype}: convert it to floats first.")
