"""Colours and metric depth to network inputs in [−1, 1], and back."""

from __future__ import annotations

import math

import jax.numpy as jnp

from pewm_jax.config import ClipConfig
from pewm_jax.geometry.cameras import require_array
from pewm_jax.types import Array, Frames


def signal_from_depth(config: ClipConfig, depth: Array) -> Array:
    """Map metric depth to [−1, 1]; depths outside near … far are clipped, 0 (invalid) to −1."""
    depth = jnp.clip(depth, config.near_m, config.far_m)
    if config.depth_scale == "log":
        share = jnp.log(depth / config.near_m) / math.log(config.far_m / config.near_m)
    else:
        share = (depth - config.near_m) / (config.far_m - config.near_m)
    return 2 * share - 1


def rgbd_signal(config: ClipConfig, rgb: Array, depth: Array) -> Array:
    """Return (..., 4) colour in [−1, 1] and the signal of metric depth."""
    return jnp.concatenate([rgb, signal_from_depth(config, depth)[..., None]], -1)


def depth_from_signal(config: ClipConfig, signal: Array) -> Array:
    """Map [−1, 1] to metric depth: the inverse of ``signal_from_depth`` between near and far."""
    share = (jnp.clip(signal, -1, 1) + 1) / 2
    if config.depth_scale == "log":
        return config.near_m * jnp.exp(share * math.log(config.far_m / config.near_m))
    return config.near_m + share * (config.far_m - config.near_m)


def signal_from_rgb(rgb: Array) -> Array:
    """Map uint8 colours to float32 in [−1, 1]; return floats unchanged."""
    if jnp.issubdtype(rgb.dtype, jnp.integer):
        return jnp.asarray(rgb, jnp.float32) / 127.5 - 1
    return jnp.asarray(rgb)


def rgb_from_signal(signal: Array) -> Array:
    """Map floats in [−1, 1] to uint8 colours, rounded and clipped.

    Raises:
        UserError: the signal is not an array of numbers, or not finite.
    """
    require_array("rgb_from_signal", "signal", signal, ...)
    return jnp.round(jnp.clip((signal + 1) * 127.5, 0, 255)).astype(jnp.uint8)


def as_signal(frames: Frames) -> Frames:
    """Return frames with colours as floats in [−1, 1]."""
    return Frames(signal_from_rgb(frames.rgb_THWC), frames.depth_THW, frames.camera)
