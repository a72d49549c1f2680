"""Convolutions of videos, in the form that the backend runs fastest."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pewm_jax.config import VAEConfig
from pewm_jax.types import Array, Params


def convolve(config: VAEConfig, params: Params, padded_BTHWC: Array) -> Array:
    """3×3×3 convolution of a video already padded in time; zeros around the frame.

    Args:
        config: ``config.convolution`` chooses the form.
        params: ``kernel`` (3, 3, 3, C, D) and ``bias``.
        padded_BTHWC: (B, T + 2, H, W, C).

    Returns:
        (B, T, H, W, D).
    """
    kernel = params["kernel"].astype(padded_BTHWC.dtype)
    if form(config) == "volume":
        out = jax.lax.conv_general_dilated(
            padded_BTHWC,
            kernel,
            (1, 1, 1),
            ((0, 0), (1, 1), (1, 1)),
            dimension_numbers=("NDHWC", "DHWIO", "NDHWC"),
            preferred_element_type=jnp.float32,
        )
    else:
        frames = padded_BTHWC.shape[1] - 2
        out = sum(
            _frames(padded_BTHWC[:, k : k + frames], kernel[k], 1, ((1, 1), (1, 1)))
            for k in range(3)
        )
    return (out + params["bias"]).astype(padded_BTHWC.dtype)


def convolve_2d(
    params: Params, x_BTHWC: Array, stride: int, padding: tuple[tuple[int, int], tuple[int, int]]
) -> Array:
    """2D convolution of every frame, ``kernel`` (3, 3, C, D) and ``bias``."""
    kernel = params["kernel"].astype(x_BTHWC.dtype)
    out = _frames(x_BTHWC, kernel, stride, padding)
    return (out + params["bias"]).astype(x_BTHWC.dtype)


def form(config: VAEConfig) -> str:
    """Return the form of the convolutions on the default backend: ``taps`` or ``volume``."""
    if config.convolution != "auto":
        return config.convolution
    return "taps" if jax.default_backend() == "cpu" else "volume"


def _frames(x_BTHWC: Array, kernel: Array, stride: int, padding) -> Array:
    batch, frames = x_BTHWC.shape[:2]
    out = jax.lax.conv_general_dilated(
        x_BTHWC.reshape(batch * frames, *x_BTHWC.shape[2:]),
        kernel,
        (stride, stride),
        padding,
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        preferred_element_type=jnp.float32,
    )
    return out.reshape(batch, frames, *out.shape[1:])
