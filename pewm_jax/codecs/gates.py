"""The gate: what was seen is shown as it was seen, and not squeezed through the codec.

At the pixels' rate it sees the decoded picture and the rendered memory: colours, depth, where
anything is rendered, and how the two differ (where their depths disagree, something may hide
something). It mixes them,

    decoded + seen · (g · (rendered − decoded) + correction),

so that it is the decoder exactly where nothing is rendered. It is trained beside the codec, on
noisy true latents (``worlds.codec``), and needs no world model.

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
"""Pixels, each way, that are brought into the channels."""
SEES = 13
"""Channels at a pixel: colour 3 and depth 1, decoded, rendered and their difference, and seen."""
MAKES = 6
"""Channels at a pixel: a share for colour, one for depth, and corrections of colour and depth."""
TRUST = 2.0
"""The shares' logits at first: what was seen is believed."""


def layout(width: int) -> dict[str, tuple[int, int]]:
    """Return (channels in, channels out) of every convolution."""
    cells = FOLD**2
    blocks = {f"block_{i}/{part}": (width, width) for i in range(BLOCKS) for part in ("one", "two")}
    return {"into": (cells * SEES, width), **blocks, "out": (width, cells * MAKES)}


def init(width: int, key: Array) -> Params:
    """Return random parameters of a gate of this width; at first it takes most from the memory."""
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
        rendered_NHWC: (N, H, W, 4) the same of the memory, anything where nothing is seen.
        seen_NHW: (N, H, W) bool.

    Returns:
        (N, H, W, 4) colour and depth signal.
    """
    seen = seen_NHW[..., None].astype(decoded_NHWC.dtype)
    rendered = jnp.where(seen > 0, rendered_NHWC, 0)
    apart = (rendered - decoded_NHWC) * seen
    x = _gather(jnp.concatenate([decoded_NHWC, rendered, apart, seen], -1))
    x = _convolve(params["into"], x)
    for i in range(BLOCKS):
        block = params[f"block_{i}"]
        inner = _convolve(block["one"], jax.nn.silu(x))
        x = x + _convolve(block["two"], jax.nn.silu(inner))
    out = _spread(_convolve(params["out"], jax.nn.silu(x)))
    share = jax.nn.sigmoid(out[..., :2] + TRUST)
    share = jnp.concatenate([jnp.repeat(share[..., :1], 3, -1), share[..., 1:]], -1)
    return decoded_NHWC + seen * (share * apart + out[..., 2:])


def macs(width: int, height: int, across: int) -> float:
    """Return the multiply-adds of one picture."""
    pixels = height * across // FOLD**2
    return float(sum(9 * inward * outward * pixels for inward, outward in layout(width).values()))


def _convolve(weights: Params, x_NHWC: Array) -> Array:
    kernel, bias = (weights[name].astype(x_NHWC.dtype) for name in ("kernel", "bias"))
    return convolve(x_NHWC, kernel) + bias


def _gather(x_NHWC: Array) -> Array:
    n, height, width, c = x_NHWC.shape
    x = x_NHWC.reshape(n, height // FOLD, FOLD, width // FOLD, FOLD, c)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(n, height // FOLD, width // FOLD, FOLD**2 * c)


def _spread(x_NHWC: Array) -> Array:
    n, h, w, c = x_NHWC.shape
    x = x_NHWC.reshape(n, h, w, FOLD, FOLD, c // FOLD**2).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(n, h * FOLD, w * FOLD, c // FOLD**2)
