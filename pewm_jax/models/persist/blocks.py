"""Transformer blocks over frames, shared by PERSIST's networks.

A block has up to three parts: attention inside of each frame (``space``), attention of each token
to the same place in earlier frames (``time``: causal, rotary), and attention to context tokens of
the same frame (``cross``). Each is followed by a feed-forward layer, and both lie between a norm
that the frame's condition scales and shifts, and a gate (adaLN-zero, arXiv 2212.09748). Queries and
keys are divided by their root mean square. Nothing in a frame depends on later frames.

Over time a frame attends to itself and the ``context`` − 1 frames before it. A ``FrameCache`` holds
the keys and values of those, so frames can be processed one by one with the same result as all at
once. With several layers the receptive field is longer, with and without the cache.

The blocks are scanned, so compile time does not grow with depth.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec as P

from pewm_jax.models.persist.config import BlocksConfig
from pewm_jax.nn import attention as blocked_attention
from pewm_jax.nn import layers, parameters, placement
from pewm_jax.nn.layers import linear, rms_norm
from pewm_jax.nn.parameters import Leaf, draw
from pewm_jax.types import Array, Params

EPSILON = 1e-6
"""Added to the variance of tokens."""
WAVES = 256
"""Channels of the sinusoid of a time."""
Parts = tuple[str, ...]
"""Which of ``space``, ``time`` and ``cross`` a block has, in order."""

SHARDING = (
    (r"(space|time|cross)/(to_[qkv]|up|modulate)/kernel", P("fsdp", "tensor")),
    (r"(space|time|cross)/(to_[qkv]|up|modulate)/bias", P("tensor")),
    (r"(space|time|cross)/(to_out|down)/kernel", P("tensor", "fsdp")),
    (r"(space|time|cross)/(to_out|down)/bias", P()),
    (r"(space|time|cross)/norm_[qk]/scale", P()),
)
"""Rules over the paths inside of one block; ``rules`` adds a prefix."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class FrameCache:
    """Keys and values of the last frames, for the attention over time.

    Attributes:
        keys_LBSNKd: (layers, B, context − 1, N, heads, head_dim) rotated keys, the last one last.
        values_LBSNKd: the values.
        known_BSN: bool, which of those tokens may be read.
        count: () int32, frames processed so far; slots before the first frame are not read.
    """

    keys_LBSNKd: Array
    values_LBSNKd: Array
    known_BSN: Array
    count: Array


def empty_cache(
    config: BlocksConfig, batch: int, tokens: int, dtype: Any = jnp.float32
) -> FrameCache:
    """Return the cache before the first frame, for ``tokens`` tokens in a frame."""
    slots = (config.layers, batch, config.context - 1, tokens, config.heads, config.head_dim)
    nothing = jnp.zeros(slots, dtype)
    return FrameCache(nothing, nothing, jnp.ones(slots[1:4], bool), jnp.zeros((), jnp.int32))


def rules(where: str) -> tuple[tuple[str, Any], ...]:
    """Return the sharding rules of blocks and end layers whose paths begin with ``where``."""
    return (
        *((rf"{where}/blocks/{path}", spec) for path, spec in SHARDING),
        (rf"{where}/modulate_out/kernel", P("fsdp", "tensor")),
        (rf"{where}/modulate_out/bias", P("tensor")),
        (rf"{where}/proj_out/kernel", P("fsdp", None)),
        (rf"{where}/.*/kernel", P(None, "fsdp")),
        (rf"{where}/.*/bias", P()),
    )


def shapes(config: BlocksConfig, parts: Parts) -> Iterator[Leaf]:
    """Yield path and shape of every parameter of one block."""
    width, hidden = config.width, config.mlp_ratio * config.width
    sizes = {f"to_{name}": (width, width) for name in ("q", "k", "v", "out")}
    sizes |= {"up": (width, hidden), "down": (hidden, width)}
    for part in parts:
        for name, (inward, outward) in sizes.items():
            yield from parameters.linear(f"{part}/{name}", inward, outward)
        if config.modulation == "own":
            yield f"{part}/modulate/kernel", (width, 6 * width)
        yield f"{part}/modulate/bias", (6 * width,)
        yield f"{part}/norm_q/scale", (config.head_dim,)
        yield f"{part}/norm_k/scale", (config.head_dim,)


def end_shapes(width: int, outputs: int) -> Iterator[Leaf]:
    """Yield path and shape of the embedding of time and of the layers after the blocks."""
    yield from mlp_shapes("time_embed", WAVES, width)
    yield from parameters.linear("modulate_out", width, 2 * width)
    yield from parameters.linear("proj_out", width, outputs)


def mlp_shapes(path: str, inward: int, width: int) -> Iterator[Leaf]:
    """Yield path and shape of ``mlp``: two linear layers."""
    yield from parameters.linear(f"{path}/one", inward, width)
    yield from parameters.linear(f"{path}/two", width, width)


def init(config: BlocksConfig, parts: Parts, ends: Iterable[Leaf], key: Array) -> Params:
    """Return random parameters: blocks stacked over layers, and ends of these shapes.

    The layers of the modulation and the last layer are zero, the gates follow ``config.gates``.
    """
    ends_key, blocks_key = jax.random.split(key)
    params = draw(dict(ends), ends_key)
    one = dict(shapes(config, parts))
    blocks = jax.vmap(lambda k: draw(one, k))(jax.random.split(blocks_key, config.layers))
    open_ = jnp.arange(6 * config.width) // config.width % 3 == 2
    shared = {}
    for part in parts:
        modulate = blocks[part]["modulate"]
        kernel = jnp.zeros((config.width, 6 * config.width))
        if config.modulation == "own":
            modulate["kernel"] = jnp.zeros_like(modulate["kernel"])
        else:
            shared[part] = {"kernel": kernel}
        if config.gates == "open":
            modulate["bias"] = modulate["bias"] + open_
    for name in ("modulate_out", "proj_out"):
        params[name]["kernel"] = jnp.zeros_like(params[name]["kernel"])
    return {**params, "blocks": blocks} | ({"modulate": shared} if shared else {})


def mlp(part: Params, x: Array) -> Array:
    """Linear layer, SiLU, linear layer."""
    return linear(part["two"], jax.nn.silu(linear(part["one"], x)))


def embed_times(params: Params, times_BT: Array, dtype: Any) -> Array:
    """Return the embedding (B, T, D) of each frame's time, in the network's units."""
    return mlp(params["time_embed"], layers.sinusoid(times_BT, WAVES).astype(dtype))


def run(
    config: BlocksConfig,
    parts: Parts,
    params: Params,
    x_BTND: Array,
    condition_BTD: Array,
    *,
    context_BTMD: Array | None = None,
    known_BTN: Array | None = None,
    cache: FrameCache | None = None,
    sides: tuple[int, ...] = (),
) -> tuple[Array, FrameCache | None]:
    """Run all blocks on T frames; also return the cache that includes them, if there is one.

    Args:
        params: those of the network, with ``blocks``, and ``modulate`` if the blocks share it.
        x_BTND: tokens of the frames after the cache's; their dtype is that of the computation.
        condition_BTD: each frame's condition, from which its modulation is made.
        context_BTMD: the tokens that ``cross`` attends to, each frame to its own.
        known_BTN: bool, which tokens later frames may read; None for all.
        cache: the frames before; None if there are none and none are kept.
        sides: tokens of a frame along each of its axes, for ``config.rotary``.
    """
    position_NR = position_angles(sides, config.head_dim) if config.rotary else None
    frames = x_BTND.shape[1]
    past = 0 if cache is None else config.context - 1
    first = jnp.int32(0) if cache is None else cache.count
    angles_TR, allowed = times_of(config, first, frames, past)
    if cache is not None:
        here = jnp.ones(x_BTND.shape[:3], bool) if known_BTN is None else known_BTN
        known_BTN = jnp.concatenate([cache.known_BSN, here], 1)
    if known_BTN is not None:
        itself = jnp.arange(past, past + frames)[:, None] == jnp.arange(past + frames)
        known_BN1S = jnp.moveaxis(known_BTN, 1, 2)[:, :, None]
        allowed = (allowed & (known_BN1S | itself))[:, :, None]  # (B, N, 1, T, S)
    condition = jax.nn.silu(condition_BTD)[:, :, None]
    common = {part: linear(layer, condition) for part, layer in params.get("modulate", {}).items()}

    def modulation(part: str, layer: Params) -> Array:
        if part not in common:
            return linear(layer, condition)
        return common[part] + layer["bias"].astype(condition.dtype)

    def body(x: Array, layer: Any) -> tuple[Array, Any]:
        weights, kept = layer
        for part in parts:
            inside = weights[part]
            shift, scale, gate, *after = jnp.split(modulation(part, inside["modulate"]), 6, -1)
            normed = norm(x) * (1 + scale) + shift
            if part == "time":
                mixed, kept = _over_time(config, inside, normed, angles_TR, allowed, kept)
            else:
                context, angles = (normed, position_NR) if part == "space" else (context_BTMD, None)
                mixed = _in_frame(config, inside, normed, context, angles)
            x = x + gate * mixed
            shift, scale, gate = after
            hidden = linear(inside["up"], norm(x) * (1 + scale) + shift)
            hidden = placement.constrain(hidden, "batch", None, "tokens", "hidden")
            x = x + gate * linear(inside["down"], jax.nn.gelu(hidden, approximate=True))
            x = placement.constrain(x, "batch", None, "tokens")
        return x, kept

    body = jax.checkpoint(body) if config.remat else body
    before = None if cache is None else (cache.keys_LBSNKd, cache.values_LBSNKd)
    x, after = jax.lax.scan(body, x_BTND, (params["blocks"], before))
    if cache is None:
        return x, None
    keys, values = after
    assert known_BTN is not None
    return x, FrameCache(keys, values, known_BTN[:, frames:], cache.count + frames)


def project(params: Params, x_BTND: Array, condition_BTD: Array) -> Array:
    """Return the outputs of tokens, (B, T, N, outputs)."""
    condition = jax.nn.silu(condition_BTD)[:, :, None]
    shift, scale = jnp.split(linear(params["modulate_out"], condition), 2, -1)
    return linear(params["proj_out"], norm(x_BTND) * (1 + scale) + shift)


def norm(x: Array) -> Array:
    """Normalise over the last axis, in float32; returned in x's dtype."""
    return layers.standardise(x, EPSILON).astype(x.dtype)


def times_of(config: BlocksConfig, first: Array, frames: int, past: int) -> tuple[Array, Array]:
    """Return rotary angles (T, head_dim/2) of frames, and the attention mask over past and present.

    ``first`` is the number of the first frame; the last of the ``past`` slots is the one before.
    """
    half = config.head_dim // 2
    frequency = np.float32(1e4) ** (-np.arange(half, dtype=np.float32) / half)
    number_T = first + jnp.arange(frames)
    number_S = first + jnp.arange(-past, frames)
    back = number_T[:, None] - number_S
    allowed = (back >= 0) & (back < config.context) & (number_S >= 0)
    return number_T[:, None] * frequency, allowed


def positions(sides: tuple[int, ...], width: int) -> np.ndarray:
    """Return (N, D) fixed sinusoids of a grid's positions, the channels divided among its axes.

    Channels that are left over, where ``width`` is no multiple of twice the axes, are 0.
    """
    each = width // (2 * len(sides))
    frequency = 1e4 ** (-np.arange(each) / max(each, 1))
    places = np.stack(np.meshgrid(*map(np.arange, sides), indexing="ij"), -1)
    angle = places.reshape(-1, len(sides), 1) * frequency
    waves = np.concatenate([np.sin(angle), np.cos(angle)], -1).reshape(math.prod(sides), -1)
    return np.pad(waves, ((0, 0), (0, width - waves.shape[1]))).astype(np.float32)


SHORTEST = 2 * math.pi
"""Shortest wavelength of the rotation by position, tokens."""
LONGEST = 200 * math.pi
"""Longest wavelength, not reached, tokens."""


def position_angles(sides: tuple[int, ...], head_dim: int) -> np.ndarray:
    """Return (N, head_dim/2) rotary angles (arXiv 2104.09864) of a grid's positions.

    The channel pairs are divided among the axes with more than one token; those that are left over
    are not rotated.
    """
    axes = [axis for axis, side in enumerate(sides) if side > 1]
    each = head_dim // 2 // max(len(axes), 1)
    wavelength = SHORTEST * (LONGEST / SHORTEST) ** (np.arange(each) / max(each, 1))
    places = np.stack(np.meshgrid(*map(np.arange, sides), indexing="ij"), -1)
    places = places.reshape(math.prod(sides), len(sides), 1)[:, axes]
    angles = (places * (2 * np.pi / wavelength)).reshape(len(places), -1)
    return np.pad(angles, ((0, 0), (0, head_dim // 2 - angles.shape[1]))).astype(np.float32)


def _in_frame(
    config: BlocksConfig,
    part: Params,
    x_BTND: Array,
    context_BTMD: Array,
    angles_NR: np.ndarray | None = None,
) -> Array:
    """Attend inside of each frame."""
    batch, frames = x_BTND.shape[:2]

    def heads(name: str, x: Array) -> Array:
        flat = linear(part[name], x).reshape(batch * frames, x.shape[2], -1)
        return layers.split_heads(flat, config.heads)

    q, k = (
        rms_norm(part[f"norm_{n}"], heads(f"to_{n}", x))
        for n, x in (("q", x_BTND), ("k", context_BTMD))
    )
    if angles_NR is not None:
        q, k = (layers.rotate_halves(x, jnp.asarray(angles_NR)) for x in (q, k))
    mixed = blocked_attention.attention(q, k, heads("to_v", context_BTMD), config.attention)
    return linear(part["to_out"], layers.merge_heads(mixed).reshape(x_BTND.shape))


def _over_time(
    config: BlocksConfig,
    part: Params,
    x_BTND: Array,
    angles_TR: Array,
    allowed: Array,
    kept: tuple[Array, Array] | None,
) -> tuple[Array, tuple[Array, Array] | None]:
    """Attend to the same place in earlier frames; also return the keys and values to keep."""
    split = (*x_BTND.shape[:3], config.heads, config.head_dim)
    q, k, v = (linear(part[f"to_{n}"], x_BTND).reshape(split) for n in "qkv")
    q, k = (
        layers.rotate_halves(rms_norm(part[f"norm_{n}"], x), angles_TR[:, None, None])
        for n, x in (("q", q), ("k", k))
    )
    if kept is not None:
        here = x_BTND.shape[1]
        k, v = (
            jnp.concatenate([old.astype(new.dtype), new], 1)
            for old, new in zip(kept, (k, v), strict=True)
        )
        kept = (k[:, here:].astype(kept[0].dtype), v[:, here:].astype(kept[1].dtype))
    if config.context == 1:  # a frame attends to itself alone
        mixed = v
    else:
        logits = jnp.einsum("btnkd,bsnkd->bnkts", q, k, preferred_element_type=jnp.float32)
        logits = jnp.where(allowed, logits / math.sqrt(config.head_dim), -jnp.inf)
        weights = jax.nn.softmax(logits, -1).astype(v.dtype)
        mixed = jnp.einsum("bnkts,bsnkd->btnkd", weights, v)
    return linear(part["to_out"], mixed.reshape(x_BTND.shape)), kept
