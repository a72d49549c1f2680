"""The memory block of a rendered memory: video tokens look at the picture where they are.

The video tokens get an adaptive layer norm from the time embedding, and the picture's part at each
token is joined to them. What a feed-forward network makes of both is added:

    H ← H + α · FF(concat(H_norm, picture))

The gate α starts at zero, so a fresh block is the identity.
"""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp

from pewm_jax.nn import layers, modules, placement
from pewm_jax.nn.tokens import TokenLayout
from pewm_jax.types import Array


class RenderBlock(nn.Module):
    """Adds to video tokens what a rendered memory shows at their place; no attention."""

    mlp_ratio: int
    """Hidden channels over the tokens' width."""
    layout: TokenLayout
    """The order of the video tokens."""

    @nn.compact
    def __call__(self, video_BND: Array, time_BE: Array, picture_BNW: Array) -> Array:
        """Return the updated video tokens.

        Args:
            video_BND: (B, N, D) hidden states H.
            time_BE: (B, E) time embedding, or (B, t, E), one for each token in time.
            picture_BNW: (B, N, W) the embedded part of the picture at each token.
        """
        dtype, width = video_BND.dtype, video_BND.shape[-1]
        modulation = modules.dense(3 * width, dtype, "linear", zero=True)(nn.silu(time_BE))
        modulation = placement.constrain(modulation, "batch")
        if time_BE.ndim == 3:
            modulation = self.layout.per_token(modulation)
        shift, scale, gate = jnp.split(modulation, 3, -1)
        normed = layers.modulate(modules.layer_norm(video_BND, "norm"), shift, scale)
        joined = placement.constrain(jnp.concatenate([normed, picture_BNW], -1), "batch", "tokens")
        hidden = modules.dense(self.mlp_ratio * width, dtype, "up")(joined)
        hidden = nn.gelu(placement.constrain(hidden, "batch", "tokens", "hidden"), approximate=True)
        mixed = modules.dense(width, dtype, "down")(hidden)
        return placement.constrain(video_BND + layers.to_tokens(gate) * mixed, "batch", "tokens")
