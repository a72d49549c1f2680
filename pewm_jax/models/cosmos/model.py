"""Cosmos' diffusion transformer, equal to ``CosmosTransformer3DModel`` of diffusers.

Video tokens attend to each other and to the text. The noise level modulates every block, and may
differ from one latent frame to the next: known frames have nearly none. A further
embedding per latent frame can be added to the time embedding wherever that one modulates the
network. This is how actions steer it (arXiv 2601.15284, Eq. 5).

The blocks are scanned, so compile time does not grow with depth. Norms and softmax are computed in
float32.

A memory enters the network in two places: ``memory_block`` runs after every block, and
``added_BND`` is added to the embedded tokens (both from ``models.interface.Readers``).

Parameters: ``patch_embed, time_embed, blocks (stacked over layers), modulate_out, proj_out``, and
``text_embed`` or ``positions`` where a variant has them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec as P

from pewm_jax.errors import UserError
from pewm_jax.models.cosmos.config import CosmosConfig
from pewm_jax.models.interface import require_shape
from pewm_jax.nn import attention as blocked_attention
from pewm_jax.nn import layers, placement
from pewm_jax.nn.layers import linear, rms_norm
from pewm_jax.nn.parameters import Leaf, draw
from pewm_jax.nn.tokens import TokenLayout, patchify
from pewm_jax.types import Array, Params

SHARDING = (
    # Matrices to and from heads and hidden channels.
    (r"backbone/blocks/(attn[12]/to_[qkv]|ff/up|modulate[123]/up)/kernel", P("fsdp", "tensor")),
    (r"backbone/blocks/(attn[12]/to_out|ff/down)/kernel", P("tensor", "fsdp")),
    (r"backbone/blocks/modulate[123]/down/kernel", P("fsdp", None)),
    (r"backbone/blocks/attn[12]/norm_[qk]/scale", P()),
    (r"backbone/(patch_embed|text_embed)/kernel", P(None, "fsdp")),
    (r"backbone/time_embed/linear_[12]/kernel", P(None, "fsdp")),
    (r"backbone/(modulate_out/down|proj_out)/kernel", P("fsdp", None)),
    (r"backbone/modulate_out/up/kernel", P("fsdp", "tensor")),
    (r"backbone/positions/(time|rows|columns)", P(None, "fsdp")),
    (r"backbone/(time_embed/norm/scale|text_embed/bias)", P()),
)
"""Rules over the paths of the parameters as a backbone; see ``config.parts.Backbone``."""

MemoryBlock = Callable[[Any, Array, Array], Array]
"""``memory_block(params, video_BND, time_BE or time_BtE) -> video_BND``, run after a block."""


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


def layout(config: CosmosConfig) -> dict[str, tuple[int, ...]]:
    """Return ``{path: shape}`` of the parameters."""
    blocks = {f"blocks/{path}": (config.layers, *s) for path, s in block_shapes(config)}
    return {**dict(_ends(config)), **blocks}


def _ends(config: CosmosConfig) -> Iterator[Leaf]:
    width, cells = config.width, config.patch_t * config.patch**2
    yield "patch_embed/kernel", (cells * (config.in_channels + config.padding_mask), width)
    yield "time_embed/linear_1/kernel", (width, width)
    yield "time_embed/linear_2/kernel", (width, 3 * width)
    yield "time_embed/norm/scale", (width,)
    if config.raw_text_dim:
        yield "text_embed/kernel", (config.raw_text_dim, config.text_dim)
        yield "text_embed/bias", (config.text_dim,)
    if config.learned_positions:
        for name, size in zip(("time", "rows", "columns"), config.max_grid, strict=True):
            yield f"positions/{name}", (size, width)
    yield from modulation("modulate_out", width, config.lora_dim, 2)
    yield "proj_out/kernel", (width, cells * config.out_channels)


def block_shapes(config: CosmosConfig) -> Iterator[Leaf]:
    """Yield the leaves of one block."""
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


def init(config: CosmosConfig, key: Array) -> Params:
    """Return random parameters, float32; the tree is ``layout``'s."""
    ends_key, blocks_key = jax.random.split(key)
    blocks = jax.vmap(lambda k: draw(dict(block_shapes(config)), k, key_per_leaf=True))(
        jax.random.split(blocks_key, config.layers)
    )
    return {**draw(dict(_ends(config)), ends_key, key_per_leaf=True), "blocks": blocks}


def apply(
    config: CosmosConfig,
    params: Params,
    latents_BthwC: Array,
    timesteps_Bt: Array,
    text_BLD: Array,
    condition_BthwC: Array | None = None,
    padding_BHWC: Array | None = None,
    fps: Array | float | None = None,
    *,
    modulation_BtE: Array | None = None,
    memory_block: MemoryBlock | None = None,
    memory_params: Any = None,
    added_BND: Array | None = None,
) -> Array:
    """Predict from noisy latents: (B, t, h, w, out_channels) in their dtype.

    Args:
        latents_BthwC: scaled; h and w are multiples of the patch, t of ``patch_t``. Their dtype is
            that of the computation.
        timesteps_Bt: (B,) noise level in the network's units, σ / (1 + σ); or (B, t'), one for
            each of the t' = t / ``patch_t`` tokens in time.
        text_BLD: (B, L, D) text tokens.
        condition_BthwC: (B, t, h, w, 1) joined to the channels of the latents: 1 where a frame is
            given, else 0. With the latents it has ``in_channels`` channels.
        padding_BHWC: (B or 1, H, W, 1) 1 where a pixel is padding, of any size; None for none.
        fps: frames per second, one number; None for an image, and to count frames.
        modulation_BtE: (B, t', width) added to the time embedding of each token in time, from
            which every block and the output layer compute their modulation.
        memory_block: function of the video tokens that runs after every block and reads the
            memory; tokens are in the order of ``layout_of``.
        memory_params: its parameters, stacked over layers.
        added_BND: (B, N, D) added to the embedded tokens, in the order of ``layout_of``.

    Raises:
        UserError: an argument of another shape, or a size beyond the positions.
    """
    latents = _joined(config, latents_BthwC, condition_BthwC, padding_BHWC)
    grid = _grid(config, latents.shape)
    batch, dtype = len(latents), latents.dtype
    wanted = {
        "timesteps_Bt": (timesteps_Bt, ((batch,), (batch, grid[0]))),
        "text_BLD": (text_BLD, ((batch, "L", config.raw_text_dim or config.text_dim),)),
        "modulation_BtE": (modulation_BtE, ((batch, grid[0], config.width),)),
        "added_BND": (added_BND, ((batch, math.prod(grid), config.width),)),
        "fps": (None if fps is None else jnp.asarray(fps), ((),)),
    }
    for name, (value, forms) in wanted.items():
        require_shape(name, value, forms)
    params = {
        name: leaf if name == "blocks" else jax.tree.map(placement.constrain, leaf)
        for name, leaf in params.items()
    }
    order = layout_of(config, latents.shape)

    def arranged(x_BNC: Array) -> Array:
        return placement.constrain(order.spread(x_BNC), "batch", "tokens")

    time = _time(config, params, dtype, timesteps_Bt, modulation_BtE)
    text = text_BLD.astype(dtype)
    if config.raw_text_dim:
        text = jax.nn.gelu(linear(params["text_embed"], text), approximate=False)
    patches = placement.constrain(patchify(latents, config.patch, config.patch_t), "batch")
    x = arranged(linear(params["patch_embed"], patches))
    if added_BND is not None:
        x = x + added_BND.astype(dtype)
    angles = order.spread(rotary_angles(config, grid, fps)[None])[0]
    positions = None
    if config.learned_positions:
        table = learned_positions(params["positions"], grid).astype(dtype)
        positions = order.spread(table[None])
    seen = time.embedding_BTE[:, 0] if time.embedding_BTE.shape[1] == 1 else time.embedding_BTE

    def body(x: Array, layer: tuple[Params, Any]) -> tuple[Array, None]:
        if positions is not None:
            x = x + positions
        x = run_block(config, layer[0], x, time, text, angles, order)
        if memory_block is not None:
            x = memory_block(layer[1], x, seen)
        return placement.constrain(x, "batch", "tokens"), None

    body = jax.checkpoint(body) if config.remat else body
    x, _ = jax.lax.scan(body, x, (params["blocks"], memory_params))
    x, _ = modulate(params["modulate_out"], x, time, order)
    return _unpatched(config, order.gather(linear(params["proj_out"], x)), grid)


def layout_of(config: CosmosConfig, shape: tuple[int, ...]) -> TokenLayout:
    """Return the token order for latents of shape (B, t, h, w, C)."""
    frames, height, width = shape[1:4]
    return TokenLayout.for_mesh(
        0, frames // config.patch_t, (height // config.patch) * (width // config.patch)
    )


def _time(
    config: CosmosConfig,
    params: Params,
    dtype: jnp.dtype,
    timesteps: Array,
    modulation: Array | None,
) -> Time:
    """Embed the noise levels: (B, 1, ·), or (B, t, ·) where frames differ."""
    inside = params["time_embed"]
    times = jnp.asarray(timesteps)
    wave = layers.sinusoid(times if times.ndim == 2 else times[:, None], config.width).astype(dtype)
    wave = placement.constrain(wave, "batch")
    shared = linear(inside["linear_2"], jax.nn.silu(linear(inside["linear_1"], wave)))
    embedding = rms_norm(inside["norm"], wave)
    if modulation is not None:
        embedding = embedding + modulation.astype(dtype)
        shared = jnp.broadcast_to(shared, (*embedding.shape[:2], shared.shape[-1]))
    return Time(embedding, shared)


def _unpatched(config: CosmosConfig, tokens_BNC: Array, grid: tuple[int, int, int]) -> Array:
    """(B, N, p·p·p_t·C) → (B, t, h, w, C); the reference orders cells otherwise than going in."""
    patch, patch_t = config.patch, config.patch_t
    x = tokens_BNC.reshape(len(tokens_BNC), *grid, patch, patch, patch_t, -1)
    x = x.transpose(0, 1, 6, 2, 4, 3, 5, 7)
    frames, rows, columns = grid
    return x.reshape(len(x), frames * patch_t, rows * patch, columns * patch, -1)


def _joined(
    config: CosmosConfig, latents: Array, condition: Array | None, padding: Array | None
) -> Array:
    """Join latents, condition and padding mask along the channels."""
    if latents.ndim != 5:
        raise UserError(
            f"latents_BthwC has shape {latents.shape}: five axes are needed, batch, time, height, "
            "width and channels last."
        )
    batch, frames, height, width, channels = latents.shape
    parts = [latents]
    if condition is not None:
        require_shape("condition_BthwC", condition, ((batch, frames, height, width, "C"),))
        parts.append(condition.astype(latents.dtype))
        channels += condition.shape[-1]
    if channels != config.in_channels:
        raise UserError(
            f"latents_BthwC and condition_BthwC have {channels} channels together: the network "
            f"takes {config.in_channels} (Cosmos-Predict2 for video: 16 of latents and 1 that "
            "marks given frames)."
        )
    if padding is not None and not config.padding_mask:
        raise UserError("padding_BHWC was given to a network without a padding mask.")
    if config.padding_mask:
        mask = jnp.zeros((1, height, width, 1)) if padding is None else padding
        require_shape("padding_BHWC", mask, ((1, "H", "W", 1), (batch, "H", "W", 1)))
        rows, columns = (
            np.arange(new) * old // new
            for old, new in zip(mask.shape[1:3], (height, width), strict=True)
        )
        mask = mask[:, rows[:, None], columns].astype(latents.dtype)
        parts.append(jnp.broadcast_to(mask[:, None], (*latents.shape[:4], 1)))
    return jnp.concatenate(parts, -1)


def _grid(config: CosmosConfig, shape: tuple[int, ...]) -> tuple[int, int, int]:
    """Return tokens along time, height and width.

    Raises:
        UserError: a size that is no multiple of the patch, or beyond the positions.
    """
    _, frames, height, width, _ = shape
    patch, patch_t = config.patch, config.patch_t
    if frames % patch_t or height % patch or width % patch:
        raise UserError(
            f"latents of {frames}×{height}×{width} cannot be cut into patches: height and width "
            f"must be multiples of {patch}, time of {patch_t}."
        )
    grid = frames // patch_t, height // patch, width // patch
    most = config.max_grid if config.learned_positions else (max(config.max_grid),) * 3
    if any(size > end for size, end in zip(grid, most, strict=True)):
        raise UserError(
            f"latents of {frames}×{height}×{width} are {grid} tokens along time, height and "
            f"width: the network's positions reach {most}."
        )
    return grid


def run_block(
    config: CosmosConfig,
    params: Params,
    x_BND: Array,
    time: Time,
    text_BLD: Array,
    angles_NR: Array,
    layout: TokenLayout,
) -> Array:
    """Return the updated video tokens (B, N, D), in the order of ``layout``.

    Self-attention, attention to the text and a feed-forward layer, each between a norm that is
    modulated by the time and a gate. No layer has a bias. The modulation is a sum of two parts: one
    that all blocks share, and one of the block's own, through a bottleneck (adaLN-LoRA).
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


def rotary_angles(
    config: CosmosConfig, grid: tuple[int, int, int], fps: Array | float | None
) -> Array:
    """Return (t·h·w, head_dim/2) rotary angles of a grid of tokens: time, rows, columns.

    Args:
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
