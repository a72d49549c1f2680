"""One block of Cosmos' transformer, and its positions.

Self-attention, attention to the text and a feed-forward layer, each between a norm that is
modulated by the time and a gate. No layer has a bias. The modulation is a sum of two parts: one
that all blocks share, and one of the block's own, through a bottleneck (adaLN-LoRA). Norms and
softmax are computed in float32. Reference: ``CosmosTransformerBlock`` of diffusers.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.models.cosmos.config import CosmosConfig
from pewm_jax.nn import attention as blocked_attention
from pewm_jax.nn import layers, placement
from pewm_jax.nn.layers import linear, rms_norm
from pewm_jax.nn.parameters import Leaf
from pewm_jax.nn.tokens import TokenLayout
from pewm_jax.types import Array, Params

EPS, HEAD_EPS = 1e-6, 1e-5
"""Added to the variances of tokens, and of queries and keys."""
BASE_FPS = 24.0
"""Frames per second at which a latent frame is one step of the rotary embedding."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Time:
    """The noise level as the blocks see it, one row per clip (T = 1) or per token in time.

    Attributes:
        embedding_BTE: what each block's own part of the modulation is made from.
        shared_BTC: the shared part, 3·D channels: shift, scale, gate.
    """

    embedding_BTE: Array
    shared_BTC: Array


def shapes(config: CosmosConfig) -> Iterator[Leaf]:
    """Yield path and shape of every leaf of one block."""
    width, lora = config.width, config.lora_dim
    for n, context in ((1, width), (2, config.text_dim)):
        yield from modulation(f"modulate{n}", width, lora, 3)
        yield f"attn{n}/to_q/kernel", (width, width)
        yield f"attn{n}/to_k/kernel", (context, width)
        yield f"attn{n}/to_v/kernel", (context, width)
        yield f"attn{n}/to_out/kernel", (width, width)
        yield f"attn{n}/norm_q/scale", (config.head_dim,)
        yield f"attn{n}/norm_k/scale", (config.head_dim,)
    yield from modulation("modulate3", width, lora, 3)
    yield "ff/up/kernel", (width, config.hidden)
    yield "ff/down/kernel", (config.hidden, width)


def modulation(where: str, width: int, lora: int, parts: int) -> Iterator[Leaf]:
    """Yield the two linear layers of a modulation of ``parts``·width channels."""
    yield f"{where}/down/kernel", (width, lora)
    yield f"{where}/up/kernel", (lora, parts * width)


def run(
    config: CosmosConfig,
    params: Params,
    x_BND: Array,
    time: Time,
    text_BLD: Array,
    angles_NR: Array,
    layout: TokenLayout,
) -> Array:
    """Return the updated tokens.

    Args:
        config: the transformer.
        params: this block's.
        x_BND: (B, N, D) video tokens in the order of ``layout``.
        time: the noise level.
        text_BLD: (B, L, text_dim) text tokens.
        angles_NR: (N, head_dim/2) rotary angles.
        layout: the order of the tokens.
    """
    normed, gate = modulate(params["modulate1"], x_BND, time, layout)
    x = x_BND + gate * _attend(config, params["attn1"], normed, normed, angles_NR, layout)
    x = placement.constrain(x, "batch", "tokens")
    normed, gate = modulate(params["modulate2"], x, time, layout)
    x = x + gate * _attend(config, params["attn2"], normed, text_BLD)
    x = placement.constrain(x, "batch", "tokens")
    normed, gate = modulate(params["modulate3"], x, time, layout)
    hidden = placement.constrain(linear(params["ff"]["up"], normed), "batch", "tokens", "hidden")
    return x + gate * linear(params["ff"]["down"], jax.nn.gelu(hidden, approximate=False))


def modulate(
    params: Params, x_BND: Array, time: Time, layout: TokenLayout
) -> tuple[Array, Array | float]:
    """Return the normalised tokens, scaled and shifted, and the gate where there is one."""
    own = linear(params["up"], linear(params["down"], jax.nn.silu(time.embedding_BTE)))
    parts = placement.constrain(own + time.shared_BTC[..., : own.shape[-1]], "batch")
    if parts.shape[1] > 1:
        parts = layout.per_token(parts)
    shift, scale, *gate = jnp.split(parts, own.shape[-1] // x_BND.shape[-1], -1)
    normed = layers.standardise(x_BND, EPS).astype(x_BND.dtype) * (1 + scale) + shift
    return placement.constrain(normed, "batch", "tokens"), gate[0] if gate else 1.0


def _attend(
    config: CosmosConfig,
    params: Params,
    x_BND: Array,
    context_BMD: Array,
    angles_NR: Array | None = None,
    layout: TokenLayout | None = None,
) -> Array:
    """Multi-head attention; queries and keys are normalised, and rotated where there are angles."""
    q = layers.split_heads(linear(params["to_q"], x_BND), config.heads)
    k, v = (
        layers.split_heads(linear(params[n], context_BMD), config.heads) for n in ("to_k", "to_v")
    )
    q, k = rms_norm(params["norm_q"], q, HEAD_EPS), rms_norm(params["norm_k"], k, HEAD_EPS)
    if angles_NR is not None:
        q, k = layers.rotate_halves(q, angles_NR), layers.rotate_halves(k, angles_NR)
    real = None if layout is None else layout.real
    mixed = blocked_attention.attention(q, k, v, config.attention, real)
    return linear(params["to_out"], layers.merge_heads(mixed))


def angles(config: CosmosConfig, grid: tuple[int, int, int], fps: Array | float | None) -> Array:
    """Return (t·h·w, head_dim/2) rotary angles of a grid of tokens: time, rows, columns.

    Args:
        config: the transformer.
        grid: tokens along time, height and width.
        fps: frames per second of the video; None counts frames.
    """
    side = config.head_dim // 6 * 2
    channels = (config.head_dim - 2 * side, side, side)
    parts = []
    for axis, (dim, scale) in enumerate(zip(channels, config.rope_scale, strict=True)):
        base = 1e4 * scale ** (dim / (dim - 2))
        frequency = np.float32(base ** -(np.arange(0, dim, 2) / dim))
        place = jnp.arange(grid[axis], dtype=jnp.float32)
        if axis == 0 and fps is not None:
            place = place / jnp.asarray(fps, jnp.float32) * BASE_FPS
        angle = jnp.expand_dims(place[:, None] * frequency, [n for n in range(3) if n != axis])
        parts.append(jnp.broadcast_to(angle, (*grid, dim // 2)))
    return jnp.concatenate(parts, -1).reshape(-1, config.head_dim // 2)


def learned_positions(params: Params, grid: tuple[int, int, int]) -> Array:
    """Return (t·h·w, D) learned positions of a grid, of length √D each, in float32."""
    time, rows, columns = (
        params[name][:size].astype(jnp.float32)
        for name, size in zip(("time", "rows", "columns"), grid, strict=True)
    )
    table = time[:, None, None] + rows[:, None] + columns
    length = jnp.linalg.norm(table, axis=-1, keepdims=True)
    table = table / (EPS + length / np.float32(np.sqrt(table.shape[-1])))
    return table.reshape(-1, table.shape[-1])
