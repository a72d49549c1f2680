"""The layers of Wan's video autoencoder, channels last.

A causal layer sees no later frames. A video starts with one frame of its own, before which there
are zeros; each later chunk gets the last frames of the chunk before. These are passed on as
``past``: one array per layer, nested like the parameters; None at the start. Reference:
``autoencoder_kl_wan.py`` of diffusers.
"""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp

from pewm_jax.config import WanVAEConfig
from pewm_jax.models.cogvideox.vae_convolution import convolve, convolve_2d, convolve_doubled
from pewm_jax.models.svd.layers import linear
from pewm_jax.models.svd.shapes import Leaf, conv
from pewm_jax.nn import attention as blocked_attention
from pewm_jax.types import Array, Params

SMALLEST = 1e-12
"""Least length that a pixel's channels are divided by."""
AFTER = ((0, 1), (0, 1))
"""Padding of the encoder's strided convolutions."""


def resnet_shapes(where: str, inside: int, outside: int) -> Iterator[Leaf]:
    """Yield the leaves of a residual block."""
    yield f"{where}/norm1/scale", (inside,)
    yield from conv(f"{where}/conv1", (3, 3, 3), inside, outside)
    yield f"{where}/norm2/scale", (outside,)
    yield from conv(f"{where}/conv2", (3, 3, 3), outside, outside)
    if inside != outside:
        yield from conv(f"{where}/shortcut", (), inside, outside)


def middle_shapes(where: str, width: int) -> Iterator[Leaf]:
    """Yield the leaves of the bottom: two residual blocks around an attention."""
    yield from resnet_shapes(f"{where}/resnet_0", width, width)
    yield f"{where}/attend_0/norm/scale", (width,)
    yield from conv(f"{where}/attend_0/to_qkv", (), width, 3 * width)
    yield from conv(f"{where}/attend_0/to_out", (), width, width)
    yield from resnet_shapes(f"{where}/resnet_1", width, width)


def norm(params: Params, x: Array) -> Array:
    """Divide the channels of each pixel by their root mean square; float32."""
    value = x.astype(jnp.float32)
    length = jnp.sqrt(jnp.square(value).sum(-1, keepdims=True))
    return value * (x.shape[-1] ** 0.5 / jnp.maximum(length, SMALLEST)) * params["scale"]


def active(params: Params, x: Array) -> Array:
    """Norm and SiLU, in x's dtype."""
    return jax.nn.silu(norm(params, x)).astype(x.dtype)


def causal_conv(
    config: WanVAEConfig, params: Params, x_BTHWC: Array, past: Array | None
) -> tuple[Array, Array]:
    """3×3×3 convolution over this frame and the two before, zeros around the frame.

    Args:
        config: the autoencoder (which form of the convolution).
        params: ``kernel`` (3, 3, 3, C, D) and ``bias``.
        x_BTHWC: (B, T, H, W, C).
        past: (B, 2, H, W, C), the two frames before.

    Returns:
        (B, T, H, W, D), and the next chunk's past.
    """
    padded = jnp.concatenate([_two_zeros(x_BTHWC) if past is None else past, x_BTHWC], 1)
    return convolve(config, params, padded), padded[:, -2:]


def resnet(
    config: WanVAEConfig, params: Params, x_BTHWC: Array, past: Params | None
) -> tuple[Array, Params]:
    """Residual block: norm, SiLU, convolution, twice; with the next chunk's past."""
    h, new = x_BTHWC, {}
    for k in "12":
        name = f"conv{k}"
        h = active(params[f"norm{k}"], h)
        h, new[name] = causal_conv(config, params[name], h, None if past is None else past[name])
    if "shortcut" in params:
        x_BTHWC = linear(params["shortcut"], x_BTHWC)
    return x_BTHWC + h, new


def middle(
    config: WanVAEConfig, params: Params, x_BTHWC: Array, past: Params | None
) -> tuple[Array, Params]:
    """Run the bottom: residual block, attention within each frame, residual block."""
    new = {}
    for k in range(2):
        name = f"resnet_{k}"
        x_BTHWC, new[name] = resnet(
            config, params[name], x_BTHWC, None if past is None else past[name]
        )
        if k == 0:
            x_BTHWC = _attend(params["attend_0"], x_BTHWC)
    return x_BTHWC, new


def _attend(params: Params, x_BTHWC: Array) -> Array:
    """Self-attention of each frame with one head, residual."""
    batch, frames, height, width, channels = x_BTHWC.shape
    x = norm(params["norm"], x_BTHWC).astype(x_BTHWC.dtype)
    x = x.reshape(batch * frames, 1, height * width, channels)
    q, k, v = jnp.split(linear(params["to_qkv"], x), 3, -1)
    x = linear(params["to_out"], blocked_attention.attention(q, k, v))
    return x_BTHWC + x.reshape(x_BTHWC.shape)


def downsample(params: Params, x_BTHWC: Array, past: Array | None) -> tuple[Array, Array | None]:
    """Halve height and width; with ``time`` among the parameters, halve frames too.

    The video's first frame stays as it is. Each two further frames become one, together with the
    frame before them.
    """
    x = convolve_2d(params["space"], x_BTHWC, 2, AFTER)
    if "time" not in params:
        return x, None
    last = x[:, -1:]
    if past is None:
        return x, last
    return _taps(params["time"], jnp.concatenate([past, x], 1), 2), last


def upsample(params: Params, x_BTHWC: Array, past: Array | None) -> tuple[Array, Array | None]:
    """Double height and width; with ``time`` among the parameters, double frames too.

    The video's first frame stays one, and later frames do not see it: in its place are zeros.
    """
    if "time" not in params:
        return convolve_doubled(params["space"], x_BTHWC), None
    if past is None:
        return convolve_doubled(params["space"], x_BTHWC), _two_zeros(x_BTHWC)
    padded = jnp.concatenate([past, x_BTHWC], 1)
    batch, frames, *rest = x_BTHWC.shape
    half = {
        name: jnp.split(params["time"][name].astype(x_BTHWC.dtype), 2, -1)
        for name in ("kernel", "bias")
    }
    pair = [
        _taps({"kernel": kernel, "bias": bias}, padded, 1)
        for kernel, bias in zip(half["kernel"], half["bias"], strict=True)
    ]
    doubled = jnp.stack(pair, 2).reshape(batch, 2 * frames, *rest)
    return convolve_doubled(params["space"], doubled), padded[:, -2:]


def _taps(params: Params, padded_BTHWC: Array, stride: int) -> Array:
    """Convolve each pixel over three frames, ``kernel`` (3, C, D) and ``bias``."""
    kernel = params["kernel"].astype(padded_BTHWC.dtype)
    end = padded_BTHWC.shape[1] - 2
    parts = [padded_BTHWC[:, k : k + end : stride] @ tap for k, tap in enumerate(kernel)]
    return sum(parts[1:], parts[0]) + params["bias"].astype(padded_BTHWC.dtype)


def _two_zeros(x_BTHWC: Array) -> Array:
    """Return two frames of zeros."""
    batch, _, *rest = x_BTHWC.shape
    return jnp.zeros((batch, 2, *rest), x_BTHWC.dtype)
