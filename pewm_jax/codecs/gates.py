"""The gate: a network that blends the rendered memory into the decoded frames.

Content that was observed before need not pass through the codec, which blurs. At the resolution of
pixels the gate gets the decoded and the rendered frame (colours, depth, a mask of rendered pixels)
and their difference (different depths indicate an occlusion). It returns

    decoded + seen · (g · (rendered − decoded) + correction),

which is exactly the decoded frame where nothing is rendered. It is trained together with the codec,
on noisy ground-truth latents (``worlds.codec``), and needs no world model.

Parameters: ``into`` and ``out``, and residual blocks ``block_i``, all 3 × 3 convolutions at half
the resolution.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from pewm_jax.nn.convolution import convolve_layer
from pewm_jax.types import Array, Params

BLOCKS = 3
FOLD = 2
"""Pixels along each axis that are moved into the channels."""
IN_CHANNELS = 13
"""Input channels per pixel: colour 3 and depth 1 of decoded, rendered and difference, and seen."""
OUT_CHANNELS = 6
"""Output channels per pixel: weights and corrections, each of colour and depth."""
INITIAL_LOGIT = 2.0
"""Logit of the weights at initialization: the rendered memory dominates."""


Layout = dict[str, tuple[int, int, int]]
"""Path of a convolution → its side in pixels, channels in and channels out."""


def layout(width: int) -> Layout:
    """Return the layout of every convolution of a gate of this width."""
    cells = FOLD**2
    blocks = {
        f"block_{i}/{part}": (3, width, width) for i in range(BLOCKS) for part in ("one", "two")
    }
    first, last = (3, cells * IN_CHANNELS, width), (3, width, cells * OUT_CHANNELS)
    return {"into": first, **blocks, "out": last}


def init(width: int, key: Array) -> Params:
    """Return random parameters of a gate of this width, which prefers the memory at first."""
    return init_convolutions(layout(width), key, zero=("two", "out"))


def init_convolutions(layers: Layout, key: Array, *, zero: tuple[str, ...]) -> Params:
    """Return random kernels and zero biases; kernels whose name is in ``zero`` are 0."""
    params: Params = {}
    for number, (path, (side, inward, outward)) in enumerate(layers.items()):
        *folders, name = path.split("/")
        node = params
        for folder in folders:
            node = node.setdefault(folder, {})
        drawn = jax.random.normal(jax.random.fold_in(key, number), (side, side, inward, outward))
        gain = 0.0 if name in zero else 1 / math.sqrt(side * side * inward)
        node[name] = {"kernel": gain * drawn, "bias": jnp.zeros((outward,))}
    return params


def apply(params: Params, decoded_NHWC: Array, rendered_NHWC: Array, seen_NHW: Array) -> Array:
    """Blend (N, H, W, 4) decoded and rendered frames: colour and depth signal in [−1, 1].

    H and W are even; rendered values count where ``seen_NHW``, bool, is True.
    """
    seen = seen_NHW[..., None].astype(decoded_NHWC.dtype)
    rendered = jnp.where(seen > 0, rendered_NHWC, 0)
    difference = (rendered - decoded_NHWC) * seen
    x = space_to_depth(jnp.concatenate([decoded_NHWC, rendered, difference, seen], -1), FOLD)
    x = convolve_layer(params["into"], x)
    for i in range(BLOCKS):
        x = residual_block(params[f"block_{i}"], x)
    out = depth_to_space(convolve_layer(params["out"], jax.nn.silu(x)), FOLD)
    weight = jax.nn.sigmoid(out[..., :2] + INITIAL_LOGIT)
    weight = jnp.concatenate([jnp.repeat(weight[..., :1], 3, -1), weight[..., 1:]], -1)
    return decoded_NHWC + seen * (weight * difference + out[..., 2:])


def residual_block(weights: Params, x_NHWC: Array) -> Array:
    """Add two convolutions, ``one`` and ``two``, each after a SiLU."""
    inner = convolve_layer(weights["one"], jax.nn.silu(x_NHWC))
    return x_NHWC + convolve_layer(weights["two"], jax.nn.silu(inner))


def space_to_depth(x_NHWC: Array, s: int) -> Array:
    """Move s × s pixels into the channels of one."""
    n, height, width, c = x_NHWC.shape
    x = x_NHWC.reshape(n, height // s, s, width // s, s, c).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(n, height // s, width // s, s * s * c)


def depth_to_space(x_NHWC: Array, s: int) -> Array:
    """Invert ``space_to_depth``."""
    n, h, w, c = x_NHWC.shape
    x = x_NHWC.reshape(n, h, w, s, s, c // (s * s)).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(n, h * s, w * s, c // (s * s))
