"""Layers as flax modules, shared by the diffusion transformer, DINOv2 and the memory blocks.

Parameters are float32, computation is in the dtype of the activations, norms are in float32.
"""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp

from pewm_jax.nn import placement
from pewm_jax.nn.layers import on_rows, sinusoid
from pewm_jax.types import Array

zeros = nn.initializers.zeros_init()


class Dense(nn.Dense):
    """A linear layer of flax, computed by ``layers.on_rows``."""

    def __call__(self, inputs: Array) -> Array:
        """(…, C) → (…, features)."""
        return on_rows(super().__call__, inputs)


def dense(features: int, dtype: jnp.dtype, name: str, *, zero: bool = False) -> Dense:
    """Return a linear layer with bias; ``zero`` initialises its kernel to zero."""
    kernel = zeros if zero else nn.initializers.lecun_normal()
    return Dense(features, dtype=dtype, kernel_init=kernel, name=name)


def layer_norm(x: Array, name: str, epsilon: float = 1e-5) -> Array:
    """Affine layer norm over the last axis, computed in float32, returned in x's dtype.

    Call inside a compact module.
    """
    return nn.LayerNorm(epsilon=epsilon, dtype=jnp.float32, name=name)(x).astype(x.dtype)


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
