"""One block of the diffusion transformer: joint attention of text and video, both modulated."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from pewm_jax.config import DiTConfig
from pewm_jax.nn import attention as blocked_attention
from pewm_jax.nn import layers, placement
from pewm_jax.nn.token_layout import TokenLayout
from pewm_jax.types import Array

KEEP = jax.checkpoint_policies.dots_saveable
"""What a block stores for its backward pass: the results of matrix products. Norms, modulation,
rotation and gelu are cheaper to recompute than to store for every layer and read back."""


def open_gates(key: Array, shape: tuple[int, ...], dtype: jnp.dtype = jnp.float32) -> Array:
    """Initialise shifts and scales to 0 and both gates to 1: a plain pre-norm transformer.

    With gates at zero, a backbone trained from scratch spends hundreds of steps on opening them.
    (Only the memory blocks must start as the identity.)
    """
    del key
    part = jnp.arange(shape[0]) // (shape[0] // 6)
    return (part % 3 == 2).astype(dtype)


class LayerNormZero(nn.Module):
    """Expert adaptive layernorm: one shared norm, separate modulation of text and video."""

    @nn.compact
    def __call__(
        self, tokens_BND: Array, time_BE: Array, layout: TokenLayout
    ) -> tuple[Array, Array]:
        """Return normalised and modulated tokens, and the gate (B, N, D) of each token.

        Args:
            tokens_BND: (B, L + N, D) text and video tokens.
            time_BE: (B, E) time embedding; or (B, 1 + t, E): the text's, then one for each token
                in time.
            layout: the order of the tokens.
        """
        width, dtype = tokens_BND.shape[-1], tokens_BND.dtype
        linear = nn.Dense(
            6 * width,
            dtype=dtype,
            kernel_init=layers.zeros,
            bias_init=open_gates,
            name="linear",
        )
        modulation = placement.constrain(linear(nn.silu(time_BE)), "batch")
        video, text = jnp.split(layers.to_tokens(modulation), 2, -1)
        if time_BE.ndim == 3:
            text = jnp.broadcast_to(
                text[:, :1], (len(text), layout.parts * layout.text_per_part, text.shape[-1])
            )
            joined = layout.join(text, layout.per_token(video[:, 1:]))
            video = text = joined
        is_text = jnp.asarray(layout.is_text)
        shift, scale, gate = jnp.split(jnp.where(is_text, text, video), 3, -1)
        normed = layers.layer_norm(tokens_BND, "norm")
        return placement.constrain(normed * (1 + scale) + shift, "batch", "tokens"), gate


class Block(nn.Module):
    """One transformer block over text and video tokens."""

    config: DiTConfig

    @nn.compact
    def __call__(
        self, tokens_BND: Array, time_BE: Array, angles_NR: Array | None, layout: TokenLayout
    ) -> Array:
        """Return the updated tokens.

        Args:
            tokens_BND: (B, L + N, D) text and video tokens.
            time_BE: (B, E) time embedding.
            angles_NR: (L + N, head_dim/2) rotary angles in the order of the tokens, or None.
            layout: the order of the tokens.
        """
        before: Any = nn.remat(Block.before, policy=KEEP, prevent_cse=False, static_argnums=(4,))
        after: Any = nn.remat(Block.after, policy=KEEP, prevent_cse=False, static_argnums=(5,))
        q, k, v, gate = before(self, tokens_BND, time_BE, angles_NR, layout)
        mixed = blocked_attention.attention(q, k, v, self.config.attention, layout.real)
        return after(self, tokens_BND, time_BE, mixed, gate, layout)

    def before(
        self, tokens_BND: Array, time_BE: Array, angles_NR: Array | None, layout: TokenLayout
    ) -> tuple[Array, Array, Array, Array]:
        """Return queries, keys and values (B, K, N, d), and the gate of the attention's output."""
        heads, width, dtype = self.config.heads, self.config.width, tokens_BND.dtype
        normed, gate = LayerNormZero(name="norm1")(tokens_BND, time_BE, layout)
        q, k, v = (
            layers.split_heads(layers.dense(width, dtype, f"to_{n}")(normed), heads) for n in "qkv"
        )
        q, k, v = (placement.constrain(x, "batch", "heads", "tokens") for x in (q, k, v))
        q, k = (layers.layer_norm(x, f"norm_{n}", 1e-6) for x, n in ((q, "q"), (k, "k")))
        if angles_NR is not None:
            q, k = layers.rotate(q, angles_NR), layers.rotate(k, angles_NR)
        return q, k, v, gate

    def after(
        self,
        tokens_BND: Array,
        time_BE: Array,
        mixed_BKND: Array,
        gate: Array,
        layout: TokenLayout,
    ) -> Array:
        """Add the outputs of attention and of the feed-forward network to the tokens."""
        width, dtype = self.config.width, tokens_BND.dtype
        mixed = layers.merge_heads(mixed_BKND)
        tokens_BND += gate * layers.dense(width, dtype, "to_out")(mixed)
        tokens_BND = placement.constrain(tokens_BND, "batch", "tokens")
        normed, gate = LayerNormZero(name="norm2")(tokens_BND, time_BE, layout)
        return tokens_BND + gate * layers.FeedForward(self.config.mlp_ratio, name="ff")(normed)
