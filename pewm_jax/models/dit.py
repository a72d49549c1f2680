"""The diffusion transformer, in CogVideoX's form.

Text and video tokens attend jointly; each kind has its own adaptive-layernorm modulation from the
time embedding ("expert" adaptive layernorm) around one shared layernorm; queries and keys are
normalised per head; a 3D rotary embedding turns the video tokens. The blocks are scanned, so
compile time does not grow with depth. Reference: ``CogVideoXTransformer3DModel`` of diffusers.

Parameters: ``patch_embed, text_embed, time_embed, blocks (stacked over layers), norm_final,
norm_out, proj_out``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from pewm_jax.config import DiTConfig
from pewm_jax.models import layers
from pewm_jax.types import Array, Params

BlockExpert = Callable[[Any, Array, Array], Array]
"""``expert(layer_params, video_BND, time_BE) -> video_BND``, run after a block."""


def open_gates(key: Array, shape: tuple[int, ...], dtype: jnp.dtype = jnp.float32) -> Array:
    """Start shifts and scales at 0 and both gates at 1: a plain pre-norm transformer.

    With gates at zero a backbone trained from nothing spends its first hundreds of steps on
    opening them. (Only the memory blocks must start as the identity.)
    """
    del key
    part = jnp.arange(shape[0]) // (shape[0] // 6)
    return (part % 3 == 2).astype(dtype)


class LayerNormZero(nn.Module):
    """Expert adaptive layernorm: one shared norm, separate modulation of video and text."""

    @nn.compact
    def __call__(
        self, video_BND: Array, text_BLD: Array, time_BE: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Return normalised video, normalised text, video gate (B, D), text gate (B, D)."""
        width, dtype = video_BND.shape[-1], video_BND.dtype
        linear = nn.Dense(
            6 * width,
            dtype=dtype,
            kernel_init=layers.zeros,
            bias_init=open_gates,
            name="linear",
        )
        modulation = linear(nn.silu(time_BE))
        shift, scale, gate, text_shift, text_scale, text_gate = jnp.split(modulation, 6, -1)
        both = layers.layer_norm(jnp.concatenate([text_BLD, video_BND], 1), "norm")
        text, video = jnp.split(both, [text_BLD.shape[1]], 1)
        return (
            layers.modulate(video, shift, scale),
            layers.modulate(text, text_shift, text_scale),
            gate,
            text_gate,
        )


class Block(nn.Module):
    """One transformer block over text and video tokens."""

    config: DiTConfig

    @nn.compact
    def __call__(
        self, video_BND: Array, text_BLD: Array, time_BE: Array, angles_NR: Array
    ) -> tuple[Array, Array]:
        """Return the updated video and text tokens.

        Args:
            video_BND: (B, N, D) video tokens.
            text_BLD: (B, L, D) text tokens.
            time_BE: (B, E) time embedding.
            angles_NR: (N, head_dim/2) rotary angles of the video tokens.
        """
        heads, dtype = self.config.heads, video_BND.dtype
        length, width = text_BLD.shape[1], self.config.width

        video, text, gate, text_gate = LayerNormZero(name="norm1")(video_BND, text_BLD, time_BE)
        both = jnp.concatenate([text, video], 1)
        q, k, v = (
            layers.split_heads(layers.dense(width, dtype, f"to_{n}")(both), heads) for n in "qkv"
        )
        q, k = (layers.layer_norm(x, f"norm_{n}", 1e-6) for x, n in ((q, "q"), (k, "k")))
        q, k = (
            jnp.concatenate([x[:, :, :length], layers.rotate(x[:, :, length:], angles_NR)], 2)
            for x in (q, k)
        )
        mixed = layers.merge_heads(layers.attention(q, k, v))
        mixed = layers.dense(width, dtype, "to_out")(mixed)
        video_BND += gate[:, None] * mixed[:, length:]
        text_BLD += text_gate[:, None] * mixed[:, :length]

        video, text, gate, text_gate = LayerNormZero(name="norm2")(video_BND, text_BLD, time_BE)
        both = layers.FeedForward(self.config.mlp_ratio, name="ff")(
            jnp.concatenate([text, video], 1)
        )
        video_BND += gate[:, None] * both[:, length:]
        text_BLD += text_gate[:, None] * both[:, :length]
        return video_BND, text_BLD


class Ends(nn.Module):
    """What stands before and after the blocks: embeddings and the output layer."""

    config: DiTConfig
    out_channels: int
    dtype: jnp.dtype

    def setup(self):
        """Name the submodules."""
        width, patch = self.config.width, self.config.patch
        self.patch_embed = layers.dense(width, self.dtype, "patch_embed")
        self.text_embed = layers.dense(width, self.dtype, "text_embed")
        self.time_embed = layers.TimeEmbedding(width, self.config.time_dim, self.dtype)
        self.norm_final = nn.LayerNorm(epsilon=1e-5, dtype=jnp.float32)
        self.norm_out = nn.LayerNorm(epsilon=1e-5, dtype=jnp.float32)
        self.modulate_out = layers.dense(2 * width, self.dtype, "modulate_out", zero=True)
        self.proj_out = layers.dense(
            patch * patch * self.out_channels, self.dtype, "proj_out", zero=True
        )

    def embed(self, patches_BNC: Array, text_BLC: Array, timesteps_B: Array):
        """Return video tokens, text tokens and the time embedding."""
        return (
            self.patch_embed(patches_BNC),
            self.text_embed(text_BLC),
            self.time_embed(timesteps_B),
        )

    def project(self, video_BND: Array, time_BE: Array) -> Array:
        """Return output patches (B, N, p·p·C)."""
        shift, scale = jnp.split(self.modulate_out(nn.silu(time_BE)), 2, -1)
        video = self.norm_out(self.norm_final(video_BND)).astype(self.dtype)
        return self.proj_out(layers.modulate(video, shift, scale))

    def __call__(self, patches_BNC: Array, text_BLC: Array, timesteps_B: Array) -> Array:
        """Touch every parameter once (for initialisation)."""
        video, _, time = self.embed(patches_BNC, text_BLC, timesteps_B)
        return self.project(video, time)


def patchify(latents_BthwC: Array, patch: int) -> Array:
    """(B, t, h, w, C) → (B, t·h/p·w/p, C·p·p), channels before the patch's rows and columns."""
    batch, frames, height, width, channels = latents_BthwC.shape
    grid = latents_BthwC.reshape(
        batch, frames, height // patch, patch, width // patch, patch, channels
    )
    return grid.transpose(0, 1, 2, 4, 6, 3, 5).reshape(batch, -1, channels * patch * patch)


def unpatchify(tokens_BNC: Array, frames: int, height: int, width: int, patch: int) -> Array:
    """Invert ``patchify`` to (B, frames, height, width, C); sizes are the latents'."""
    batch = tokens_BNC.shape[0]
    grid = tokens_BNC.reshape(batch, frames, height // patch, width // patch, -1, patch, patch)
    return grid.transpose(0, 1, 2, 5, 3, 6, 4).reshape(batch, frames, height, width, -1)


def init(config: DiTConfig, key: Array, in_channels: int, out_channels: int) -> Params:
    """Initialise: float32, output layer at zero, blocks stacked over layers."""
    ends_key, blocks_key = jax.random.split(key)
    time = jnp.zeros((1, config.time_dim))
    ends = Ends(config, out_channels, jnp.dtype(jnp.float32)).init(
        ends_key,
        jnp.zeros((1, 1, in_channels * config.patch**2)),
        jnp.zeros((1, config.text_length, config.text_dim)),
        jnp.zeros((1,)),
    )["params"]
    token = jnp.zeros((1, 1, config.width))
    angles = jnp.zeros((1, config.head_dim // 2))
    blocks = jax.vmap(lambda k: Block(config).init(k, token, token, time, angles)["params"])(
        jax.random.split(blocks_key, config.layers)
    )
    return {**ends, "blocks": blocks}


def apply(
    config: DiTConfig,
    params: Params,
    latents_BthwC: Array,
    text_BLC: Array,
    timesteps_B: Array,
    *,
    expert: BlockExpert | None = None,
    expert_params: Any = None,
) -> Array:
    """Denoise.

    Args:
        config: the transformer.
        params: its parameters.
        latents_BthwC: (B, t, h, w, C) input latents; h and w are multiples of the patch. Their
            dtype is the dtype of the computation.
        text_BLC: (B, L, text_dim) text tokens.
        timesteps_B: (B,) diffusion times, 0 … train_steps − 1.
        expert: run after every block on the video tokens (the memory block).
        expert_params: the experts' parameters, stacked over layers.

    Returns:
        (B, t, h, w, C_out) prediction; C_out is the output layer's.
    """
    dtype = latents_BthwC.dtype
    _, frames, height, width, _ = latents_BthwC.shape
    patch = config.patch
    out_channels = params["proj_out"]["bias"].shape[0] // patch**2
    ends = Ends(config, out_channels, dtype)
    ends_params = {"params": {k: v for k, v in params.items() if k != "blocks"}}
    embedded: Any = ends.apply(
        ends_params,
        patchify(latents_BthwC, patch),
        text_BLC.astype(dtype),
        timesteps_B,
        method="embed",
    )
    video, text, time = embedded
    angles = jnp.asarray(
        layers.rope_angles(frames, height // patch, width // patch, config.head_dim)
    )

    def body(carry, layer):
        video, text = Block(config).apply({"params": layer[0]}, *carry, time, angles)
        if expert is not None:
            video = expert(layer[1], video, time)
        return (video, text), None

    body = jax.checkpoint(body) if config.remat else body
    (video, _), _ = jax.lax.scan(body, (video, text), (params["blocks"], expert_params))
    patches: Array = ends.apply(ends_params, video, time, method="project")
    return unpatchify(patches, frames, height, width, patch)
