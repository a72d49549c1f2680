"""Pixels ↔ latents: every codec behind one interface, chosen by the type of its settings.

A codec is a ``Codec`` and a module (or object) with

    init(settings, key) -> params                                    {} if it has none
    encode(settings, params, video_BTHWC, *, condition=False) -> latents_BthwC
    decode(settings, params, latents_BthwC) -> video_BTHWC
    SHARDING                                                         rules over ``codec/…`` paths
    costs(model, share) -> Costs                                     see ``models.costs``

and obeys the frame rule: q·k + 1 frames become k + 1 latent frames. Colour and depth are encoded
separately and their channels concatenated, as in the paper. The VAE sees depth as a grey image
(``DEPTH_AS_GREY``). A codec whose ``depth_channels`` are 0 encodes colour alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.core import Tracer

from pewm_jax.codecs.pixel import fold
from pewm_jax.codecs.signals import depth_from_signal, signal_from_depth
from pewm_jax.config import Codec, ModelConfig, functions
from pewm_jax.geometry import depth_images
from pewm_jax.nn import placement
from pewm_jax.nn.costs import Costs, Share
from pewm_jax.types import Array, Params, View


def init(config: Codec, key: Array) -> Params:
    """Return random parameters of a codec; the pixel codec has none."""
    return functions(config).init(config, key)


def encode(config: Codec, params: Params, video_BTHWC: Array, *, condition: bool = False) -> Array:
    """Encode a video.

    Args:
        config: the codec.
        params: its parameters, empty for the pixel codec.
        video_BTHWC: (B, q·k + 1, H, W, C) float in [−1, 1]; C is 3 where depth is encoded as grey.
        condition: whether the latents are what the denoiser is conditioned on. CogVideoX-1.5's
            image-to-video model divides such latents by the scaling factor; others multiply.

    Returns:
        (B, k + 1, H/s, W/s, C') latents.

    Raises:
        ValueError: the video's size cannot be encoded.
    """
    return functions(config).encode(config, params, video_BTHWC, condition=condition)


def decode(config: Codec, params: Params, latents_BthwC: Array) -> Array:
    """Decode latents, the inverse of ``encode``.

    Args:
        config: the codec.
        params: its parameters, empty for the pixel codec.
        latents_BthwC: (B, k + 1, h, w, C') latents; for the VAE k is even.

    Returns:
        (B, q·k + 1, h·s, w·s, C) video.

    Raises:
        UserError: latents that the VAE decodes to another number of frames.
    """
    return functions(config).decode(config, params, latents_BthwC)


def encode_rgbd(
    model: ModelConfig,
    params: Params,
    rgb_BTHWC: Array,
    depth_BTHW: Array,
    *,
    condition: bool = False,
) -> Array:
    """Encode colour in [−1, 1] and metric depth separately and concatenate the channels.

    No measurement is not a surface: a pixel without depth is encoded with that of the nearest pixel
    that has one, and an image without any at ``clip.far_m``. ``measured`` says what to count.

    Args:
        model: the model.
        params: the world model's parameters; those of the codec are under ``codec``.
        rgb_BTHWC: (B, T, H, W, 3).
        depth_BTHW: (B, T, H, W) metres.
        condition: see ``encode``.
    """
    weights = params.get("codec", {})
    if not model.codec.depth_channels:
        return _clip_by_clip(
            lambda weights, rgb: encode(
                model.codec, weights, rgb.astype(jnp.dtype(model.dtype)), condition=condition
            ).astype(jnp.float32),
            weights,
            rgb_BTHWC,
        )
    depth = jnp.asarray(depth_BTHW)
    whole = depth_images.fill_depth(depth.reshape(-1, *depth.shape[-2:]), model.clip.far_m)
    signal = signal_from_depth(model.clip, whole.reshape(depth.shape))[..., None]
    if not model.codec.DEPTH_AS_GREY:
        parts = [encode(model.codec, weights, x, condition=condition) for x in (rgb_BTHWC, signal)]
        return jnp.concatenate(parts, -1)

    def together(weights: Params, rgb: Array, signal: Array) -> Array:
        grey = jnp.broadcast_to(signal, rgb.shape)
        both = jnp.concatenate([rgb, grey]).astype(jnp.dtype(model.dtype))
        latents = encode(model.codec, weights, both, condition=condition)
        return jnp.concatenate(jnp.split(latents.astype(jnp.float32), 2), -1)

    return _clip_by_clip(together, weights, rgb_BTHWC, signal)


def _clip_by_clip(encoded: Callable[..., Array], weights: Params, *videos: Array) -> Array:
    """Encode clip by clip where it is compiled, so that memory does not grow with the batch."""

    def one_by_one(weights: Params, *videos: Array) -> Array:
        if len(videos[0]) == 1:
            return encoded(weights, *videos)
        latents = jax.lax.map(lambda clip: encoded(weights, *(x[None] for x in clip)), videos)
        return latents[:, 0]

    traced = isinstance(videos[0], Tracer)
    return placement.by_batch(one_by_one if traced else encoded, weights, *videos)


def decode_rgbd(model: ModelConfig, params: Params, latents_BthwC: Array) -> tuple[Array, Array]:
    """Invert ``encode_rgbd``: colour in [−1, 1] (B, T, H, W, 3) and metric depth (B, T, H, W).

    Where depth is not encoded it is 0 everywhere: not known.
    """
    if not model.codec.depth_channels:
        latents = latents_BthwC.astype(jnp.dtype(model.dtype))
        rgb = decode(model.codec, params.get("codec", {}), latents).astype(jnp.float32)
        return jnp.clip(rgb, -1, 1), jnp.zeros(rgb.shape[:-1])
    parts = jnp.split(latents_BthwC, [model.codec.rgb_channels], -1)
    weights = params.get("codec", {})
    if not model.codec.DEPTH_AS_GREY:
        rgb, signal = (decode(model.codec, weights, part) for part in parts)
    else:
        both = jnp.concatenate(parts).astype(jnp.dtype(model.dtype))
        video = decode(model.codec, weights, both).astype(jnp.float32)
        rgb, signal = jnp.split(video, 2)
    return jnp.clip(rgb, -1, 1), depth_from_signal(model.clip, signal.mean(-1))


def mix(
    model: ModelConfig, params: Params, rgb_BTHWC: Array, depth_BTHW: Array, view: View
) -> tuple[Array, Array]:
    """Mix decoded frames with what the memory looks like from their cameras, by the codec's gate.

    Args:
        model: the model, whose codec has a gate.
        params: the world model's parameters.
        rgb_BTHWC: (B, T, H, W, 3) decoded colours in [−1, 1].
        depth_BTHW: (B, T, H, W) decoded depth, metres.
        view: (B, T) the rendered memory; the first 3 of its features are colours.

    Returns:
        Colours and depth; those given where nothing is rendered.
    """

    def pictures(rgb: Array, depth: Array) -> Array:
        four = jnp.concatenate([rgb, signal_from_depth(model.clip, depth)[..., None]], -1)
        return four.reshape(-1, *four.shape[-3:])

    made = (
        functions(model.codec)
        .mix(
            params["codec"],
            pictures(rgb_BTHWC, depth_BTHW),
            pictures(view.features_THWF[..., :3], view.depth_THW),
            view.seen_THW.reshape(-1, *view.seen_THW.shape[-2:]),
        )
        .reshape(*rgb_BTHWC.shape[:-1], 4)
    )
    depth = jnp.where(view.seen_THW, depth_from_signal(model.clip, made[..., 3]), depth_BTHW)
    return jnp.clip(made[..., :3], -1, 1), depth


def measured(model: ModelConfig, depth_BTHW: Array) -> Array:
    """Return the share of measured pixels in each depth latent, the weight of its error.

    The shape (B, t, h, w, C) broadcasts with the depth channels of ``encode_rgbd``. If a channel is
    one pixel, as in the pixel codec, the share is 0 or 1. Otherwise it is the mean over the
    latent's pixels.
    """
    own = getattr(functions(model.codec), "measured", None)
    if own is not None:
        return own(model.codec, depth_BTHW)
    valid = (depth_BTHW > 0).astype(jnp.float32)[..., None]
    share = fold(valid, model.codec.spatial, model.codec.temporal)
    return share if model.codec.PIXELWISE else share.mean(-1, keepdims=True)


def costs_of_images(model: ModelConfig, share: Share, images: int, part: str) -> Costs:
    """Return what it costs to encode so many more images of a clip's size.

    A codec's own costs are those of T + 1 images of colour and of as many of depth.

    Args:
        model: the model.
        share: one device's share of the step.
        images: images that are encoded.
        part: the part of the model that they are encoded for.
    """
    whole = functions(model.codec).costs(model, share)
    times = images / (2 * (model.clip.frames + 1))
    products = (dataclasses.replace(x, part=part, macs=x.macs * times) for x in whole.products)
    return Costs(tuple(products), streamed=whole.streamed * times, held=whole.held * times)
