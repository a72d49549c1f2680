"""The gate: a network that blends the rendered memory into the decoded picture.

What was observed before need not pass through the codec, which would blur it. At the resolution of
pixels the gate gets the decoded picture and the rendered memory: colours, depth, where anything is
rendered, and the difference of the two (different depths indicate an occlusion). It returns

    decoded + seen · (g · (rendered − decoded) + correction),

which is exactly the decoded picture where nothing is rendered. It is trained together with the
codec, on noisy ground-truth latents (``worlds.codec``), and needs no world model.

Parameters: ``into`` and ``out``, and residual blocks ``block_i``, all 3 × 3 convolutions at half
the resolution.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from pewm_jax.nn.convolution import convolve
from pewm_jax.types import Array, Params

BLOCKS = 3
FOLD = 2
"""Pixels along each axis that are folded into the channels."""
IN_CHANNELS = 13
"""Input channels per pixel: colour 3 and depth 1 of decoded, rendered and difference, and seen."""
OUT_CHANNELS = 6
"""Output channels per pixel: weights and corrections, each of colour and depth."""
INITIAL_LOGIT = 2.0
"""Logit of the weights at initialization: the rendered memory dominates."""


def layout(width: int) -> dict[str, tuple[int, int]]:
    """Return (channels in, channels out) of every convolution."""
    cells = FOLD**2
    blocks = {f"block_{i}/{part}": (width, width) for i in range(BLOCKS) for part in ("one", "two")}
    return {"into": (cells * IN_CHANNELS, width), **blocks, "out": (width, cells * OUT_CHANNELS)}


def init(width: int, key: Array) -> Params:
    """Return random parameters of a gate of this width; it takes most from the memory."""
    params: Params = {}
    for number, (path, (inward, outward)) in enumerate(layout(width).items()):
        *folders, name = path.split("/")
        node = params
        for folder in folders:
            node = node.setdefault(folder, {})
        drawn = jax.random.normal(jax.random.fold_in(key, number), (3, 3, inward, outward))
        gain = 0.0 if name in ("two", "out") else 1 / math.sqrt(9 * inward)
        node[name] = {"kernel": gain * drawn, "bias": jnp.zeros((outward,))}
    return params


def apply(params: Params, decoded_NHWC: Array, rendered_NHWC: Array, seen_NHW: Array) -> Array:
    """Mix decoded and rendered pictures.

    Args:
        params: from ``init``.
        decoded_NHWC: (N, H, W, 4) colour and depth signal in [−1, 1]; H and W are even.
        rendered_NHWC: (N, H, W, 4) the same of the memory, any values where nothing is rendered.
        seen_NHW: (N, H, W) bool, where the memory is rendered.

    Returns:
        (N, H, W, 4) colour and depth signal.
    """
    seen = seen_NHW[..., None].astype(decoded_NHWC.dtype)
    rendered = jnp.where(seen > 0, rendered_NHWC, 0)
    difference = (rendered - decoded_NHWC) * seen
    x = _space_to_depth(jnp.concatenate([decoded_NHWC, rendered, difference, seen], -1))
    x = _convolve(params["into"], x)
    for i in range(BLOCKS):
        block = params[f"block_{i}"]
        inner = _convolve(block["one"], jax.nn.silu(x))
        x = x + _convolve(block["two"], jax.nn.silu(inner))
    out = _depth_to_space(_convolve(params["out"], jax.nn.silu(x)))
    weight = jax.nn.sigmoid(out[..., :2] + INITIAL_LOGIT)
    weight = jnp.concatenate([jnp.repeat(weight[..., :1], 3, -1), weight[..., 1:]], -1)
    return decoded_NHWC + seen * (weight * difference + out[..., 2:])


def _convolve(weights: Params, x_NHWC: Array) -> Array:
    kernel, bias = (weights[name].astype(x_NHWC.dtype) for name in ("kernel", "bias"))
    return convolve(x_NHWC, kernel) + bias


def _space_to_depth(x_NHWC: Array) -> Array:
    n, height, width, c = x_NHWC.shape
    x = x_NHWC.reshape(n, height // FOLD, FOLD, width // FOLD, FOLD, c)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(n, height // FOLD, width // FOLD, FOLD**2 * c)


def _depth_to_space(x_NHWC: Array) -> Array:
    n, h, w, c = x_NHWC.shape
    x = x_NHWC.reshape(n, h, w, FOLD, FOLD, c // FOLD**2).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(n, h * FOLD, w * FOLD, c // FOLD**2)
