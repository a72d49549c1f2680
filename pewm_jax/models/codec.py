"""Pixels ↔ latents behind one interface, and metric depth ↔ [−1, 1].

The pixel codec has no parameters and is exactly invertible: space-to-depth of s × s pixels and a
temporal fold of q frames, with CogVideoX's frame rule (q·k + 1 frames → k + 1 latent frames; the
first frame is alone in its latent, repeated q times). Colour and depth are encoded separately and
concatenated, as the paper does with the VAE.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from pewm_jax.config import ClipConfig, CodecConfig, Config
from pewm_jax.geometry.plucker import fold_frames
from pewm_jax.types import Array


def latent_shape(config: Config) -> tuple[int, int, int]:
    """Return (t, h, w) of one clip's latents."""
    clip, codec = config.clip, config.codec
    frames = (clip.frames - 1) // codec.temporal + 1
    return frames, clip.height // codec.spatial, clip.width // codec.spatial


def encode(config: CodecConfig, video_BTHWC: Array) -> Array:
    """Encode a video.

    Args:
        config: the codec.
        video_BTHWC: (B, q·k + 1, H, W, C) float.

    Returns:
        (B, k + 1, H/s, W/s, q·s·s·C) latents.

    Raises:
        ValueError: the frame count is not q·k + 1, or s does not divide the image.
    """
    batch, frames, height, width, channels = video_BTHWC.shape
    s, q = config.spatial, config.temporal
    if (frames - 1) % q or height % s or width % s:
        raise ValueError(
            f"a video of {frames}×{height}×{width} cannot be folded: the codec needs {q}k + 1 "
            f"frames and multiples of {s} pixels."
        )
    folded = jax.vmap(lambda video: fold_frames(video, q))(video_BTHWC)
    grid = folded.reshape(batch, -1, q, height // s, s, width // s, s, channels)
    grid = grid.transpose(0, 1, 3, 5, 2, 4, 6, 7)
    return grid.reshape(*grid.shape[:4], q * s * s * channels)


def decode(config: CodecConfig, latents_BthwC: Array) -> Array:
    """Invert ``encode``; the q copies of the first frame are averaged.

    Args:
        config: the codec.
        latents_BthwC: (B, k + 1, h, w, q·s·s·C).

    Returns:
        (B, q·k + 1, h·s, w·s, C) video.
    """
    batch, latent_frames, h, w, width = latents_BthwC.shape
    s, q = config.spatial, config.temporal
    grid = latents_BthwC.reshape(batch, latent_frames, h, w, q, s, s, width // (q * s * s))
    grid = grid.transpose(0, 1, 4, 2, 5, 3, 6, 7)
    video = grid.reshape(batch, latent_frames, q, h * s, w * s, -1)
    rest = video[:, 1:].reshape(batch, -1, *video.shape[3:])
    return jnp.concatenate([video[:, :1].mean(2), rest], 1)


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


def encode_rgbd(config: Config, rgb_BTHWC: Array, depth_BTHW: Array) -> Array:
    """Encode colour in [−1, 1] and metric depth separately and concatenate the channels."""
    rgb = encode(config.codec, rgb_BTHWC)
    depth = encode(config.codec, signal_from_depth(config.clip, depth_BTHW)[..., None])
    return jnp.concatenate([rgb, depth], -1)


def decode_rgbd(config: Config, latents_BthwC: Array) -> tuple[Array, Array]:
    """Invert ``encode_rgbd``: colour in [−1, 1] (B, T, H, W, 3) and metric depth (B, T, H, W)."""
    split = rgb_channels(config)
    rgb = decode(config.codec, latents_BthwC[..., :split])
    depth = decode(config.codec, latents_BthwC[..., split:])[..., 0]
    return jnp.clip(rgb, -1, 1), depth_from_signal(config.clip, depth)


def rgb_channels(config: Config) -> int:
    """Latent channels of the colour part."""
    return 3 * config.codec.temporal * config.codec.spatial**2


def latent_channels(config: Config) -> int:
    """Latent channels of colour and depth together."""
    return 4 * config.codec.temporal * config.codec.spatial**2
