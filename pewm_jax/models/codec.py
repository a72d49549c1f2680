"""Pixels ↔ latents behind one interface, and metric depth ↔ [−1, 1].

Two codecs: ``pixel`` (no parameters) for small models, ``vae`` (CogVideoX's) for large ones. Both
keep the frame rule q·k + 1 frames → k + 1 latent frames. Colour and depth are encoded separately
and concatenated, as the paper does with the VAE, which sees depth as a grey picture.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax.core import Tracer

from pewm_jax.config import ClipConfig, CodecConfig, Config
from pewm_jax.models import pixel_codec, placement, vae
from pewm_jax.types import Array, Params


def latent_shape(config: Config) -> tuple[int, int, int]:
    """Return (t, h, w) of one clip's latents."""
    clip, codec = config.clip, config.codec
    frames = (clip.frames - 1) // codec.temporal + 1
    return frames, clip.height // codec.spatial, clip.width // codec.spatial


def init(config: CodecConfig, key: Array) -> Params:
    """Return random parameters of the codec; the pixel codec has none."""
    return vae.init(config.vae, key) if config.kind == "vae" else {}


def encode(
    config: CodecConfig, params: Params, video_BTHWC: Array, *, condition: bool = False
) -> Array:
    """Encode a video.

    Args:
        config: the codec.
        params: its parameters, empty for the pixel codec.
        video_BTHWC: (B, q·k + 1, H, W, C) float in [−1, 1]; C is 3 for the VAE.
        condition: whether the latents are what the denoiser is conditioned on. CogVideoX-1.5's
            image-to-video model divides these by the scaling factor instead of multiplying.

    Returns:
        (B, k + 1, H/s, W/s, C') latents: of the VAE the mean, scaled; of the pixel codec
        C' = q·s·s·C.

    Raises:
        ValueError: the video's size cannot be encoded.
    """
    if config.kind == "pixel":
        return pixel_codec.encode(config, video_BTHWC)
    mean, _ = vae.encode(config.vae, params, video_BTHWC)
    return mean * _scale(config, condition=condition)


def decode(config: CodecConfig, params: Params, latents_BthwC: Array) -> Array:
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
    if config.kind == "pixel":
        return pixel_codec.decode(config, latents_BthwC)
    frames = config.temporal * (latents_BthwC.shape[1] - 1) + 1
    return vae.decode(config.vae, params, latents_BthwC / config.vae.scaling_factor, frames=frames)


def _scale(config: CodecConfig, *, condition: bool) -> float:
    factor = config.vae.scaling_factor
    return 1 / factor if condition and config.vae.invert_scale_latents else factor


def signal_from_depth(config: ClipConfig, depth: Array) -> Array:
    """Map metric depth to [−1, 1]; depths outside near … far are clipped, 0 (invalid) to −1."""
    depth = jnp.clip(depth, config.near_m, config.far_m)
    if config.depth_scale == "log":
        share = jnp.log(depth / config.near_m) / math.log(config.far_m / config.near_m)
    else:
        share = (depth - config.near_m) / (config.far_m - config.near_m)
    return 2 * share - 1


def depth_from_signal(config: ClipConfig, signal: Array) -> Array:
    """Map [−1, 1] to metric depth: the inverse of ``signal_from_depth`` between near and far."""
    share = (jnp.clip(signal, -1, 1) + 1) / 2
    if config.depth_scale == "log":
        return config.near_m * jnp.exp(share * math.log(config.far_m / config.near_m))
    return config.near_m + share * (config.far_m - config.near_m)


def signal_from_rgb(rgb: Array) -> Array:
    """Map uint8 colours to float32 in [−1, 1]; floats pass through."""
    if jnp.issubdtype(rgb.dtype, jnp.integer):
        return jnp.asarray(rgb, jnp.float32) / 127.5 - 1
    return jnp.asarray(rgb)


def rgb_from_signal(signal: Array) -> Array:
    """Map floats in [−1, 1] to uint8 colours, rounded and clipped."""
    return jnp.round(jnp.clip((signal + 1) * 127.5, 0, 255)).astype(jnp.uint8)


def encode_rgbd(
    config: Config,
    params: Params,
    rgb_BTHWC: Array,
    depth_BTHW: Array,
    *,
    condition: bool = False,
) -> Array:
    """Encode colour in [−1, 1] and metric depth separately and concatenate the channels.

    Args:
        config: the experiment.
        params: the world model's parameters; those of the codec are under ``codec``.
        rgb_BTHWC: (B, T, H, W, 3).
        depth_BTHW: (B, T, H, W) metres.
        condition: see ``encode``.
    """
    signal = signal_from_depth(config.clip, depth_BTHW)[..., None]
    weights = params.get("codec", {})
    if config.codec.kind == "pixel":
        parts = [encode(config.codec, weights, x) for x in (rgb_BTHWC, signal)]
        return jnp.concatenate(parts, -1)

    def together(weights: Params, rgb: Array, signal: Array) -> Array:
        grey = jnp.broadcast_to(signal, rgb.shape)
        both = jnp.concatenate([rgb, grey]).astype(jnp.dtype(config.train.dtype))
        latents = encode(config.codec, weights, both, condition=condition)
        return jnp.concatenate(jnp.split(latents.astype(jnp.float32), 2), -1)

    def one_by_one(weights: Params, *videos: Array) -> Array:
        """Encode clip by clip, so that memory does not grow with the batch."""
        if len(videos[0]) == 1:
            return together(weights, *videos)
        one = jax.lax.map(lambda clip: together(weights, *(x[None] for x in clip)), videos)
        return one[:, 0]

    traced = isinstance(rgb_BTHWC, Tracer)
    return placement.by_batch(one_by_one if traced else together, weights, rgb_BTHWC, signal)


def decode_rgbd(config: Config, params: Params, latents_BthwC: Array) -> tuple[Array, Array]:
    """Invert ``encode_rgbd``: colour in [−1, 1] (B, T, H, W, 3) and metric depth (B, T, H, W)."""
    parts = jnp.split(latents_BthwC, [rgb_channels(config)], -1)
    weights = params.get("codec", {})
    if config.codec.kind == "pixel":
        rgb, signal = (decode(config.codec, weights, part) for part in parts)
    else:
        both = jnp.concatenate(parts).astype(jnp.dtype(config.train.dtype))
        video = decode(config.codec, weights, both).astype(jnp.float32)
        rgb, signal = jnp.split(video, 2)
    return jnp.clip(rgb, -1, 1), depth_from_signal(config.clip, signal.mean(-1))


def measured(config: Config, depth_BTHW: Array) -> Array:
    """Return what share of each depth latent was measured, to weigh its error with.

    Shape (B, t, h, w, C) that broadcasts with the depth channels of ``encode_rgbd``. A channel of
    the pixel codec is one pixel (0 or 1); a latent of the VAE counts by the share of its pixels.
    """
    share = pixel_codec.encode(config.codec, (depth_BTHW > 0).astype(jnp.float32)[..., None])
    return share if config.codec.kind == "pixel" else share.mean(-1, keepdims=True)


def rgb_channels(config: Config) -> int:
    """Latent channels of the colour part."""
    if config.codec.kind == "vae":
        return config.codec.vae.latent_channels
    return 3 * config.codec.temporal * config.codec.spatial**2


def latent_channels(config: Config) -> int:
    """Latent channels of colour and depth together."""
    if config.codec.kind == "vae":
        return 2 * config.codec.vae.latent_channels
    return 4 * config.codec.temporal * config.codec.spatial**2
