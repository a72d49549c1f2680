"""EfficientNet with group norms: the feature vector of an image.

Tan and Le 2019 (arXiv 1905.11946), B0 and networks scaled in width and depth, with each batch norm
replaced by a group norm of 16 channels per group, as in NoMaD. The padding is that of
``efficientnet_pytorch`` 0.7.1 for its own size of 224: before strides of 2, one row more below and
right than above and left, for any size of image.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math

import jax
import jax.numpy as jnp

from pewm_jax.nn.layers import group_norm
from pewm_jax.types import Array, Params

STAGES = (
    (1, 3, 1, 1, 32, 16),
    (2, 3, 2, 6, 16, 24),
    (2, 5, 2, 6, 24, 40),
    (3, 3, 2, 6, 40, 80),
    (3, 5, 1, 6, 80, 112),
    (4, 5, 2, 6, 112, 192),
    (1, 3, 1, 6, 192, 320),
)
"""Blocks, kernel, stride of the first block, expansion, channels in and out, of B0's stages."""
STEM, HEAD = 32, 1280
SQUEEZE = 4
"""Channels of a block's input per channel of its squeeze layer."""
GROUP = 16
"""Channels of a group of the norms, at least."""
STEP = 8
"""Numbers of channels are multiples of this number."""
LETTERS = ("NHWC", "HWIO", "NHWC")


@dataclasses.dataclass(frozen=True)
class Block:
    """One inverted bottleneck: expand, depthwise convolution, squeeze and excitation, project."""

    kernel: int
    stride: int
    inward: int
    hidden: int
    outward: int


def blocks(width: float = 1.0, depth: float = 1.0, stages: int = len(STAGES)) -> list[Block]:
    """Return the blocks of the first stages of a network scaled in width and depth from B0."""
    found = []
    for count, kernel, stride, expansion, inward, outward in STAGES[:stages]:
        before, after = scaled(inward, width), scaled(outward, width)
        for number in range(math.ceil(depth * count)):
            first = number == 0
            entering = before if first else after
            step = stride if first else 1
            found.append(Block(kernel, step, entering, entering * expansion, after))
    return found


def scaled(channels: int, width: float) -> int:
    """Return a number of channels times ``width``, to the next multiple of 8, not 10 % below."""
    wanted = channels * width
    near = max(STEP, int(wanted + STEP / 2) // STEP * STEP)
    return near + STEP if near < 0.9 * wanted else near


def features(width: float = 1.0) -> int:
    """Return the length of the feature vector."""
    return scaled(HEAD, width)


def shapes(
    colours: int, width: float = 1.0, depth: float = 1.0, stages: int = len(STAGES)
) -> dict[str, tuple[int, ...]]:
    """Return the shape of each parameter by path, for images of this number of channels."""
    made: dict[str, tuple[int, ...]] = {}

    def add(name: str, *kernel: int, bias: bool = False) -> None:
        made[f"{name}/kernel"] = kernel
        if bias:
            made[f"{name}/bias"] = kernel[-1:]
        else:
            made[f"{name}_norm/scale"] = made[f"{name}_norm/bias"] = kernel[-1:]

    add("stem", 3, 3, colours, scaled(STEM, width))
    found = blocks(width, depth, stages)
    for number, block in enumerate(found):
        name, squeezed = f"block_{number}", max(1, block.inward // SQUEEZE)
        if block.hidden != block.inward:
            add(f"{name}/expand", 1, 1, block.inward, block.hidden)
        add(f"{name}/filter", block.kernel, block.kernel, 1, block.hidden)
        add(f"{name}/squeeze", 1, 1, block.hidden, squeezed, bias=True)
        add(f"{name}/excite", 1, 1, squeezed, block.hidden, bias=True)
        add(f"{name}/project", 1, 1, block.hidden, block.outward)
    add("head", 1, 1, found[-1].outward, features(width))
    return made


def apply(width: float, depth: float, stages: int, params: Params, pictures_BHWC: Array) -> Array:
    """Return the mean over places of the last feature map, (B, features(width)).

    ``width`` and ``depth`` are channels and blocks as multiples of B0's, which has 7 ``stages``.
    The dtype of the pictures, normalised floats, is the computation's.
    """
    x = _normed(params, "stem", pictures_BHWC, 3, 2, active=True)
    for number, block in enumerate(blocks(width, depth, stages)):
        x = _block(block, params[f"block_{number}"], x)
    return _normed(params, "head", x, active=True).mean((1, 2))


def groups(channels: int) -> int:
    """Return the number of groups of a norm: one for 16 channels, or the next fewer that fits."""
    count = max(1, channels // GROUP)
    while channels % count:
        count -= 1
    return count


def _block(block: Block, part: Params, x_BHWC: Array) -> Array:
    x = x_BHWC
    if block.hidden != block.inward:
        x = _normed(part, "expand", x, active=True)
    x = _normed(part, "filter", x, block.kernel, block.stride, active=True)
    weights = _convolved(part["squeeze"], x.mean((1, 2), keepdims=True))
    weights = _convolved(part["excite"], jax.nn.silu(weights))
    x = _normed(part, "project", x * jax.nn.sigmoid(weights))
    return x + x_BHWC if block.stride == 1 and block.inward == block.outward else x


def _normed(
    part: Params, name: str, x_BHWC: Array, side: int = 1, stride: int = 1, *, active: bool = False
) -> Array:
    """Convolve and normalise, and apply SiLU if ``active``."""
    x = _convolved(part[name], x_BHWC, side, stride)
    x = group_norm(part[f"{name}_norm"], x, groups(x.shape[-1]))
    return jax.nn.silu(x) if active else x


def _convolved(part: Params, x_BHWC: Array, side: int = 1, stride: int = 1) -> Array:
    """Convolve; a kernel with one input channel is a depthwise convolution."""
    kernel, inward = part["kernel"].astype(x_BHWC.dtype), x_BHWC.shape[-1]
    if side == 1:
        x = x_BHWC @ kernel[0, 0]
    else:
        before = (side - stride) // 2
        pad = (before, side - stride - before)
        alone = kernel.shape[2] == 1 != inward
        x = (
            _filtered(x_BHWC, kernel, stride, pad)
            if alone
            else jax.lax.conv_general_dilated(
                x_BHWC, kernel, (stride, stride), (pad, pad), None, None, LETTERS
            )
        )
    return x + part["bias"].astype(x.dtype) if "bias" in part else x


def _filtered(x_BHWC: Array, kernel: Array, stride: int, pad: tuple[int, int]) -> Array:
    """Compute a depthwise convolution as a sum of shifted images, one per kernel position.

    XLA's grouped convolution takes minutes to compile on CPUs and is slower there.
    """
    x = jnp.pad(x_BHWC, ((0, 0), pad, pad, (0, 0)))
    side = kernel.shape[0]
    rows, columns = ((n - side) // stride * stride + 1 for n in x.shape[1:3])
    shifted = (
        x[:, i : i + rows : stride, j : j + columns : stride] * kernel[i, j, 0]
        for i, j in itertools.product(range(side), repeat=2)
    )
    return functools.reduce(jnp.add, shifted)
