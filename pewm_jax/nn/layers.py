"""Layers as functions of their parameters and activations, for every network.

Parameters are ``{"kernel", "bias"}`` or ``{"scale", "bias"}``. Computation is in the dtype of the
activations; norms are in float32. ``nn.modules`` has the same in the form of flax modules,
``nn.parameters`` draws parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.nn import placement, target
from pewm_jax.types import Array, Params

EPSILON = 1e-5
"""Added to variances, as torch does by default."""


def linear(params: Params, x: Array) -> Array:
    """Multiply the last axis by ``kernel`` (in, out) and add ``bias``, if there is one."""
    y = on_rows(lambda rows: rows @ params["kernel"].astype(x.dtype), x)
    return y + params["bias"].astype(x.dtype) if "bias" in params else y


def on_rows(function: Callable[[Array], Array], x: Array) -> Array:
    """Apply a function of the last axis to x; on one CPU to the rows (N, C) of one matrix.

    XLA computes the gradient of a kernel as one product of two matrices then. With more axes its
    CPU backend transposes one operand first, and the product takes up to twice as long.
    """
    if x.ndim < 3 or target.current().platform != "cpu" or placement.is_split():
        return function(x)
    rows = function(x.reshape(-1, x.shape[-1]))
    return rows.reshape(*x.shape[:-1], rows.shape[-1])


def mlp(params: Params, x: Array) -> Array:
    """Apply a linear layer, SiLU, and another linear layer: ``linear_1`` and ``linear_2``."""
    return linear(params["linear_2"], jax.nn.silu(linear(params["linear_1"], x)))


def standardise(x: Array, epsilon: float = EPSILON) -> Array:
    """Bring the last axis to mean 0 and variance 1, float32: a layer norm without parameters."""
    wide = x.astype(jnp.float32)
    centred = wide - wide.mean(-1, keepdims=True)
    return centred * jax.lax.rsqrt(jnp.square(centred).mean(-1, keepdims=True) + epsilon)


def layer_norm(params: Params, x: Array, epsilon: float = EPSILON) -> Array:
    """Normalise over the last axis, with ``scale`` and ``bias``; returned in x's dtype."""
    return (standardise(x, epsilon) * params["scale"] + params["bias"]).astype(x.dtype)


def rms_norm(params: Params, x: Array, epsilon: float = 1e-6) -> Array:
    """Divide by the root mean square of the last axis, in float32; returned in x's dtype."""
    value = x.astype(jnp.float32)
    scale = jax.lax.rsqrt(jnp.square(value).mean(-1, keepdims=True) + epsilon)
    return (value * scale * params["scale"]).astype(x.dtype)


def group_norm(params: Params, x: Array, groups: int) -> Array:
    """Normalise (B, …, C) over positions and each group of channels; returned in x's dtype."""
    grouped = x.astype(jnp.float32).reshape(len(x), -1, groups, x.shape[-1] // groups)
    mean = grouped.mean((1, 3), keepdims=True)
    variance = jnp.square(grouped - mean).mean((1, 3), keepdims=True)
    normed = ((grouped - mean) * jax.lax.rsqrt(variance + EPSILON)).reshape(x.shape)
    return (normed * params["scale"] + params["bias"]).astype(x.dtype)


def group_norm_affine(
    params: Params, x_BTHWC: Array, groups: int, eps: float
) -> tuple[Array, Array]:
    """Return the (B, C) factor and offset that normalise each group over time, space and channels.

    In float32; ``x·factor + offset`` is the affine group norm. In this form a video is read once,
    and later layers can change the factor and the offset before they are applied.
    """
    batch, *_, channels = x_BTHWC.shape
    x = x_BTHWC.astype(jnp.float32)
    # Subtracting some pixel first keeps the variance exact when the mean is far from zero.
    origin = jax.lax.stop_gradient(x[:, :1, :1, :1])
    near = x - origin
    count = x[0, ..., 0].size
    first = jnp.sum(near, (1, 2, 3)) / count
    second = jnp.sum(near * near, (1, 2, 3)) / count
    mean = first + origin[:, 0, 0, 0]
    spread = second - first * first

    def pool(value_BC: Array) -> Array:
        return value_BC.reshape(batch, groups, -1).mean(-1, keepdims=True)

    mean_g = pool(mean)
    between = jnp.square(mean.reshape(batch, groups, -1) - mean_g).mean(-1, keepdims=True)
    scale = jax.lax.rsqrt(pool(spread) + between + eps)
    scale = jnp.broadcast_to(scale, (batch, groups, channels // groups)).reshape(batch, channels)
    mean = jnp.broadcast_to(mean_g, (batch, groups, channels // groups)).reshape(batch, channels)
    factor = scale * params["scale"]
    return factor, params["bias"] - mean * factor


def sinusoid(values: Array, channels: int, max_period: float = 1e4) -> Array:
    """Return (..., channels) cosines then sines of values at geometric frequencies.

    CogVideoX's time embedding: ``Timesteps(flip_sin_to_cos=True, downscale_freq_shift=0)`` of
    diffusers.
    """
    half = channels // 2
    frequency = np.exp(-math.log(max_period) * np.arange(half) / half).astype(np.float32)
    angle = values[..., None].astype(jnp.float32) * frequency
    return jnp.concatenate([jnp.cos(angle), jnp.sin(angle)], -1)


def modulate(x: Array, shift_BD: Array, scale_BD: Array) -> Array:
    """Return x·(1 + scale) + shift of (B, N, D) tokens, with (B, D) or (B, N, D) modulation."""
    return x * (1 + to_tokens(scale_BD)) + to_tokens(shift_BD)


def to_tokens(x_BD: Array) -> Array:
    """Add a token axis to (B, D); return (B, N, D) unchanged."""
    return x_BD[:, None] if x_BD.ndim == 2 else x_BD


def rotate(x: Array, angles: Array) -> Array:
    """Rotate channel pairs (0, 1), (2, 3), … of x by angles.

    Args:
        x: (..., d) with d even.
        angles: (..., d/2) radians, broadcasting with x's leading shape.
    """
    cos, sin = jnp.cos(angles), jnp.sin(angles)
    pairs = x.reshape(*x.shape[:-1], -1, 2).astype(jnp.float32)
    a, b = pairs[..., 0], pairs[..., 1]
    turned = jnp.stack([a * cos - b * sin, b * cos + a * sin], -1)
    return turned.reshape(*turned.shape[:-2], -1).astype(x.dtype)


def rotate_halves(x: Array, angles: Array) -> Array:
    """Rotate channel pairs (0, d/2), (1, d/2 + 1), … of x by angles (..., d/2).

    The same as ``rotate`` up to the order of channels, and faster: no interleaving.
    """
    cos, sin = jnp.cos(angles), jnp.sin(angles)
    a, b = jnp.split(x.astype(jnp.float32), 2, -1)
    return jnp.concatenate([a * cos - b * sin, b * cos + a * sin], -1).astype(x.dtype)


def split_heads(x_BND: Array, heads: int) -> Array:
    """(B, N, K·d) → (B, K, N, d)."""
    batch, tokens, width = x_BND.shape
    return x_BND.reshape(batch, tokens, heads, width // heads).transpose(0, 2, 1, 3)


def merge_heads(x_BKND: Array) -> Array:
    """(B, K, N, d) → (B, N, K·d)."""
    batch, heads, tokens, channels = x_BKND.shape
    return x_BKND.transpose(0, 2, 1, 3).reshape(batch, tokens, heads * channels)
