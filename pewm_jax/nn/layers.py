"""Layers shared by the diffusion transformer and the memory blocks.

Flax linen modules. Parameters are float32, computation is in the dtype of the activations, norms
and softmax are in float32.
"""

from __future__ import annotations

import math

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.nn import placement
from pewm_jax.types import Array

zeros = nn.initializers.zeros_init()


def dense(features: int, dtype: jnp.dtype, name: str, *, zero: bool = False) -> nn.Dense:
    """Return a linear layer with bias; ``zero`` initialises its kernel to zero."""
    kernel = zeros if zero else nn.initializers.lecun_normal()
    return nn.Dense(features, dtype=dtype, kernel_init=kernel, name=name)


def layer_norm(x: Array, name: str, epsilon: float = 1e-5) -> Array:
    """Affine layer norm over the last axis, computed in float32, returned in x's dtype.

    Call inside a compact module.
    """
    return nn.LayerNorm(epsilon=epsilon, dtype=jnp.float32, name=name)(x).astype(x.dtype)


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


def attention(q_BKND: Array, k_BKMD: Array, v_BKMD: Array) -> Array:
    """Scaled dot-product attention with the softmax in float32: (B, K, N, d)."""
    logits = jnp.einsum("bknd,bkmd->bknm", q_BKND, k_BKMD, preferred_element_type=jnp.float32)
    weights = jax.nn.softmax(logits / math.sqrt(q_BKND.shape[-1]), -1)
    return jnp.einsum("bknm,bkmd->bknd", weights.astype(v_BKMD.dtype), v_BKMD)


def split_heads(x_BND: Array, heads: int) -> Array:
    """(B, N, K·d) → (B, K, N, d)."""
    batch, tokens, width = x_BND.shape
    return x_BND.reshape(batch, tokens, heads, width // heads).transpose(0, 2, 1, 3)


def merge_heads(x_BKND: Array) -> Array:
    """(B, K, N, d) → (B, N, K·d)."""
    batch, heads, tokens, channels = x_BKND.shape
    return x_BKND.transpose(0, 2, 1, 3).reshape(batch, tokens, heads * channels)


class FeedForward(nn.Module):
    """Linear, tanh-gelu, linear."""

    ratio: int

    @nn.compact
    def __call__(self, x_BND: Array) -> Array:
        """(B, N, D) → (B, N, D)."""
        width = x_BND.shape[-1]
        hidden = dense(self.ratio * width, x_BND.dtype, "up")(x_BND)
        hidden = placement.constrain(hidden, "batch", "tokens", "hidden")
        return dense(width, x_BND.dtype, "down")(nn.gelu(hidden, approximate=True))


class TimeEmbedding(nn.Module):
    """Sinusoid of the diffusion time → linear, SiLU, linear."""

    width: int
    """Channels of the sinusoid: the model width in CogVideoX."""
    time_dim: int
    """Channels of the embedding."""
    dtype: jnp.dtype

    @nn.compact
    def __call__(self, timesteps_B: Array) -> Array:
        """(B,) → (B, time_dim)."""
        wave = sinusoid(timesteps_B, self.width).astype(self.dtype)
        hidden = dense(self.time_dim, self.dtype, "linear_1")(placement.constrain(wave, "batch"))
        hidden = nn.silu(placement.constrain(hidden, "batch"))
        return placement.constrain(dense(self.time_dim, self.dtype, "linear_2")(hidden), "batch")
