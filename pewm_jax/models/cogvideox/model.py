"""The diffusion transformer, equal to CogVideoX's.

Text and video tokens attend jointly. Each kind has its own adaptive-layernorm modulation from the
time embedding ("expert" adaptive layernorm) around one shared layernorm. Queries and keys are
normalised per head, and video tokens get a 3D rotary embedding. The blocks are scanned, so
compile time does not grow with depth (small networks on a CPU are unrolled: ``UNROLLED``).
Reference: ``CogVideoXTransformer3DModel`` of diffusers; ``models.cogvideox.config`` has the
settings of its five published networks.

A memory enters the network in two places: ``memory_block`` runs after every block, and
``added_BND`` is added to the embedded tokens (both from ``models.interface.Readers``).

Parameters: ``patch_embed, text_embed, time_embed, blocks (stacked over layers), norm_final,
norm_out, modulate_out, proj_out``, and ``positions`` or ``ofs_embed`` where a variant has them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from pewm_jax.errors import UserError
from pewm_jax.models.cogvideox import positions
from pewm_jax.models.cogvideox.config import DiTConfig
from pewm_jax.nn import attention as blocked_attention
from pewm_jax.nn import layers, modules, placement, target
from pewm_jax.nn.tokens import TokenLayout, patchify, unpatchify
from pewm_jax.types import Array, Params

MemoryBlock = Callable[[Any, Array, Array], Array]
"""``memory_block(layer_params, video_BND, time_BE) -> video_BND``, run after a block."""

OFS = 2.0
"""The value of the second scalar input, with which 1.5-5B-I2V was trained."""
KEEP = jax.checkpoint_policies.dots_saveable
"""What a block stores for its backward pass: the results of matrix products. Norms, modulation,
rotation and gelu are cheaper to recompute than to store for every layer and read back."""

UNROLLED = 2048
"""Largest layers × width of a network that is unrolled on a CPU: compilation takes longer with the
layers, and large matrices make the copies unimportant."""
WORTHWHILE = 2**17
"""Fewest values of the tokens with which it is."""


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
        """Return normalised and modulated text and video tokens, and the gate (B, N, D) of each.

        ``time_BE`` is (B, E); or (B, 1 + t, E): the text's, then one for each token in time.
        """
        width, dtype = tokens_BND.shape[-1], tokens_BND.dtype
        linear = modules.Dense(
            6 * width,
            dtype=dtype,
            kernel_init=modules.zeros,
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
        shift, scale, gate = (  # apart, so that no gradient of all three is joined
            jnp.where(is_text, *parts)
            for parts in zip(jnp.split(text, 3, -1), jnp.split(video, 3, -1), strict=True)
        )
        normed = modules.layer_norm(tokens_BND, "norm")
        return placement.constrain(normed * (1 + scale) + shift, "batch", "tokens"), gate


class Block(nn.Module):
    """One transformer block over text and video tokens."""

    config: DiTConfig

    @nn.compact
    def __call__(
        self, tokens_BND: Array, time_BE: Array, angles_NR: Array | None, layout: TokenLayout
    ) -> Array:
        """Return the updated tokens; angles (L + N, head_dim/2) are in the order of the tokens."""
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
            layers.split_heads(modules.dense(width, dtype, f"to_{n}")(normed), heads) for n in "qkv"
        )
        q, k, v = (placement.constrain(x, "batch", "heads", "tokens") for x in (q, k, v))
        q, k = (modules.layer_norm(x, f"norm_{n}", 1e-6) for x, n in ((q, "q"), (k, "k")))
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
        tokens_BND += gate * modules.dense(width, dtype, "to_out")(mixed)
        tokens_BND = placement.constrain(tokens_BND, "batch", "tokens")
        normed, gate = LayerNormZero(name="norm2")(tokens_BND, time_BE, layout)
        return tokens_BND + gate * modules.FeedForward(self.config.mlp_ratio, name="ff")(normed)


class Ends(nn.Module):
    """The layers before and after the blocks: embeddings and the output projection."""

    config: DiTConfig
    out_channels: int
    dtype: jnp.dtype

    def setup(self):
        """Name the submodules."""
        config, dtype = self.config, self.dtype
        self.patch_embed = modules.dense(config.width, dtype, "patch_embed")
        self.text_embed = modules.dense(config.width, dtype, "text_embed")
        self.time_embed = modules.TimeEmbedding(config.width, config.time_dim, dtype)
        if config.ofs_dim:
            self.ofs_embed = modules.TimeEmbedding(config.ofs_dim, config.ofs_dim, dtype)
        if config.positions == "rope_learned":
            tokens = config.text_length + positions.sample_tokens(config)
            normal = nn.initializers.normal(0.02)
            self.positions = self.param("positions", normal, (tokens, config.width))
        self.norm_final = nn.LayerNorm(epsilon=1e-5, dtype=jnp.float32)
        self.norm_out = nn.LayerNorm(epsilon=1e-5, dtype=jnp.float32)
        self.modulate_out = modules.dense(2 * config.width, dtype, "modulate_out", zero=True)
        cells = config.patch_t * config.patch**2
        self.proj_out = modules.dense(cells * self.out_channels, dtype, "proj_out", zero=True)

    def embed(self, patches_BNC: Array, text_BLC: Array, timesteps_B: Array, ofs_B: Array):
        """Return text and video tokens (B, L + N, D) and the time embedding (B, E)."""
        text_BLC, patches_BNC = (placement.constrain(x, "batch") for x in (text_BLC, patches_BNC))
        tokens = jnp.concatenate([self.text_embed(text_BLC), self.patch_embed(patches_BNC)], 1)
        tokens = placement.constrain(tokens, "batch")
        time = self.time_embed(timesteps_B)
        if self.config.ofs_dim:
            ofs = self.ofs_embed(ofs_B)
            time += ofs if time.ndim == 2 else ofs[:, None]
        return tokens, time

    def project(self, video_BND: Array, time_BE: Array, layout: TokenLayout | None = None) -> Array:
        """Return output patches (B, N, C·p_t·p·p) with ``time_BE`` as in the blocks."""
        modulation = placement.constrain(self.modulate_out(nn.silu(time_BE)), "batch")
        if layout is not None and time_BE.ndim == 3:
            modulation = layout.per_token(modulation[:, 1:])
        shift, scale = jnp.split(modulation, 2, -1)
        video = self.norm_out(self.norm_final(video_BND)).astype(self.dtype)
        return self.proj_out(layers.modulate(video, shift, scale))

    def __call__(
        self, patches_BNC: Array, text_BLC: Array, timesteps_B: Array, ofs_B: Array
    ) -> Array:
        """Touch every parameter once (for initialisation)."""
        tokens, time = self.embed(patches_BNC, text_BLC, timesteps_B, ofs_B)
        return self.project(tokens, time)


def init(config: DiTConfig, key: Array) -> Params:
    """Initialise: float32, output layer at zero, blocks stacked over layers.

    Raises:
        UserError: ``in_channels`` or ``out_channels`` is 0 (to be filled in by the world model).
    """
    if not (config.in_channels and config.out_channels):
        raise UserError(
            "in_channels and out_channels are 0, which leaves them to the world model: "
            "set both to build the transformer alone (CogVideoX: 16 and 16)."
        )
    ends_key, blocks_key = jax.random.split(key)
    cells = config.patch_t * config.patch**2
    length = config.text_length
    video = positions.sample_tokens(config) if config.positions == "rope_learned" else 1
    ends = Ends(config, config.out_channels, jnp.dtype(jnp.float32)).init(
        ends_key,
        jnp.zeros((1, video, config.in_channels * cells)),
        jnp.zeros((1, length, config.text_dim)),
        jnp.zeros((1,)),
        jnp.zeros((1,)),
    )["params"]
    token, time = jnp.zeros((1, 1, config.width)), jnp.zeros((1, config.time_dim))
    blocks = jax.vmap(
        lambda k: Block(config).init(k, token, time, None, TokenLayout(1, 0, 1, 1))["params"]
    )(jax.random.split(blocks_key, config.layers))
    return {**ends, "blocks": blocks}


def apply(
    config: DiTConfig,
    params: Params,
    latents_BthwC: Array,
    text_BLD: Array,
    timesteps_B: Array,
    ofs_B: Array | None = None,
    *,
    memory_block: MemoryBlock | None = None,
    memory_params: Any = None,
    modulation_BtE: Array | None = None,
    added_BND: Array | None = None,
) -> Array:
    """Predict from noisy latents: (B, t, h, w, C_out) in their dtype, that of the computation.

    Args:
        latents_BthwC: h and w are multiples of the patch, t of ``patch_t``.
        text_BLD: (B, L, text_dim) text tokens.
        timesteps_B: (B,) diffusion times, 0 … train_steps − 1, or a single one; or (B, t'), one
            for each of the t' = t / ``patch_t`` tokens in time (the text gets their mean).
        ofs_B: (B,) second scalar of 1.5-5B-I2V; None means ``OFS``.
        memory_block: function of the video tokens that runs after every block and reads the
            memory; tokens are in the order of ``layout_of``.
        memory_params: its parameters, stacked over layers.
        modulation_BtE: (B, t', E) added to the time embedding of each token in time, not to the
            text's.
        added_BND: (B, N, D) added to the embedded video tokens, in the order of ``layout_of``.

    Raises:
        UserError: the network cannot take these sizes; raised while tracing.
    """
    grid = positions.token_grid(config, latents_BthwC.shape)
    _require_inputs(config, params, latents_BthwC, text_BLD, ofs_B)
    dtype, patch, patch_t = latents_BthwC.dtype, config.patch, config.patch_t
    batch, frames, height, width, _ = latents_BthwC.shape
    length = text_BLD.shape[1]
    out_channels = params["proj_out"]["bias"].shape[0] // (patch_t * patch**2)
    ends = Ends(config, out_channels, dtype)
    rest = {name: leaf for name, leaf in params.items() if name != "blocks"}
    ends_params = {"params": jax.tree.map(placement.constrain, rest)}
    embedded: Any = ends.apply(
        ends_params,
        patchify(latents_BthwC, patch, patch_t),
        text_BLD.astype(dtype),
        _per_clip(jnp.asarray(timesteps_B), batch),
        jnp.broadcast_to(jnp.asarray(OFS if ofs_B is None else ofs_B), (batch,)),
        method="embed",
    )
    tokens, time = embedded
    if modulation_BtE is not None or time.ndim == 3:
        time = _frame_times(time, modulation_BtE)
    tokens = positions.add(config, tokens, params.get("positions"), grid)
    angles = positions.joint_angles(config, grid, length)
    layout = layout_of(config, latents_BthwC.shape, length)
    tokens = placement.constrain(layout.arrange(tokens), "batch", "tokens")
    if added_BND is not None:
        text, video = layout.split(tokens)
        tokens = layout.join(text, video + added_BND.astype(dtype))
    angles = None if angles is None else layout.arrange(angles[None])[0]

    def body(tokens: Array, layer: tuple[Params, Any]) -> tuple[Array, None]:
        tokens = Block(config).apply({"params": layer[0]}, tokens, time, angles, layout)
        if memory_block is not None:
            text, video = layout.split(tokens)
            video_time = time[:, 1:] if time.ndim == 3 else time
            tokens = layout.join(text, memory_block(layer[1], video, video_time))
        return placement.constrain(tokens, "batch", "tokens"), None

    body = jax.checkpoint(body) if config.remat else body
    unroll = _unrolls(config, tokens)
    tokens, _ = jax.lax.scan(body, tokens, (params["blocks"], memory_params), unroll=unroll)
    video = layout.split(tokens)[1]
    patches: Array = ends.apply(ends_params, video, time, layout, method="project")
    return unpatchify(layout.gather(patches), frames, height, width, patch, patch_t)


def _unrolls(config: DiTConfig, tokens_BND: Array) -> bool:
    """Tell whether layers run without a loop: on one CPU, where many values would be copied.

    A loop stacks what the backward pass needs, and copies it twice.
    """
    one_cpu = target.current().platform == "cpu" and not placement.is_split()
    small = config.layers * config.width <= UNROLLED
    return one_cpu and small and tokens_BND.size >= WORTHWHILE


def _per_clip(timesteps: Array, batch: int) -> Array:
    """Broadcast times (B,), (1,), () or (B, t) to one row per clip."""
    return jnp.broadcast_to(timesteps, (batch, *timesteps.shape[1:]))


def _frame_times(time: Array, modulation_BtE: Array | None) -> Array:
    """Return the time embeddings (B, 1 + t, E): the text's, then one for each token in time."""
    base, frames = (time, time[:, None]) if time.ndim == 2 else (time.mean(1), time)
    if modulation_BtE is not None:
        frames = frames + modulation_BtE.astype(time.dtype)
    return jnp.concatenate([base[:, None], frames], 1)


def layout_of(config: DiTConfig, shape: tuple[int, ...], length: int) -> TokenLayout:
    """Return the token order for latents of shape (B, t, h, w, C) and ``length`` text tokens."""
    frames, rows, columns = positions.token_grid(config, shape)
    return TokenLayout.for_mesh(length, frames, rows * columns)


def _require_inputs(
    config: DiTConfig, params: Params, latents: Array, text: Array, ofs: Array | None
) -> None:
    """Refuse inputs that do not fit the parameters."""
    takes = params["patch_embed"]["kernel"].shape[0] // (config.patch_t * config.patch**2)
    if latents.shape[-1] != takes:
        raise UserError(
            f"The latents have {latents.shape[-1]} channels and this network takes {takes}: an "
            "image-to-video network takes 32 (noisy latents, then the image's), a text-to-video "
            "network 16; channels are the last axis."
        )
    if text.ndim != 3 or text.shape[0] != latents.shape[0] or text.shape[2] != config.text_dim:
        raise UserError(
            f"The text has shape {tuple(text.shape)}: give (batch {latents.shape[0]}, tokens, "
            f"{config.text_dim} channels)."
        )
    table = config.positions == "rope_learned" and config.learned != "drop"
    if table and text.shape[1] != config.text_length:
        raise UserError(
            f"The text has {text.shape[1]} tokens: this network's learned positions are for "
            f"{config.text_length}; pad the prompt to that."
        )
    if ofs is not None and not config.ofs_dim:
        raise UserError(
            "ofs_B was given to a network without an ofs embedding; only 1.5-5B-I2V has one."
        )
