"""The layers of the video autoencoder, channels last.

A causal layer sees no later frames. The first chunk of a video is padded by repeating its first
frame; a later chunk by the last frames of the chunk before. These are passed on as ``past``: one
array per convolution, nested like the parameters. ``layout`` lists the parameters: a norm of the
decoder also has the 1×1×1 convolutions ``scale_by`` and ``shift_by`` from latents to its channels.
Reference: ``autoencoder_kl_cogvideox.py`` of diffusers.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

import jax
import jax.numpy as jnp

from pewm_jax.models.cogvideox.config import VAEConfig
from pewm_jax.nn.layers import group_norm_affine
from pewm_jax.nn.parameters import Leaf, convolution, levels
from pewm_jax.nn.parameters import norm as norm_leaves
from pewm_jax.nn.video_convolution import (
    convolve_causal,
    convolve_frame_by_frame,
    convolve_frames,
    convolve_upsampled,
    form,
    frame_by_frame,
)
from pewm_jax.types import Array, Params

EPS = 1e-6
"""Added to the variance where the reference uses a constant instead of its setting."""


def causal_conv(
    config: VAEConfig, params: Params, x_BTHWC: Array, past: Array | None
) -> tuple[Array, Array]:
    """Convolve causally; before the first chunk (``past`` None) its first frame is repeated."""
    if past is None:
        past = jnp.repeat(x_BTHWC[:, :1], 2, axis=1)
    return convolve_causal(config.convolution, params, x_BTHWC, past)


def pointwise(params: Params, x: Array) -> Array:
    """1×1×1 convolution over the last axis."""
    kernel = params["kernel"].astype(x.dtype)
    return x @ kernel.reshape(kernel.shape[-2:]) + params["bias"].astype(x.dtype)


def norm(
    params: Params, x_BTHWC: Array, latents_BthwC: Array | None, groups: int, eps: float
) -> Array:
    """Group norm and swish; with latents, they scale and shift the normalised values.

    The reference upsamples the latents of the chunk (B, t, h, w, z) to x's size (nearest) and then
    maps their channels by ``scale_by`` and ``shift_by``. Mapping them first gives the same result
    with far less work.
    """
    return _swish(x_BTHWC, *_affine(params, x_BTHWC, latents_BthwC, groups, eps))


def norm_conv(
    config: VAEConfig,
    params: Params,
    k: str,
    x_BTHWC: Array,
    latents_BthwC: Array | None,
    past: Array | None,
) -> tuple[Array, Array]:
    """Apply ``norm`` and ``causal_conv``, whose parameters end in ``k``, in one pass if possible.

    In the form ``frames`` one frame after the other is normalised and convolved.
    """
    eps = config.eps if latents_BthwC is None and k != "_out" else EPS
    norms, kernel = params[f"norm{k}"], params[f"conv{k}"]
    how = form(config.convolution, x_BTHWC.dtype, len(x_BTHWC), decodes=latents_BthwC is not None)
    if how != "frames":
        h = norm(norms, x_BTHWC, latents_BthwC, config.groups, eps)
        return causal_conv(config, kernel, h, past)
    parts = _affine(norms, x_BTHWC, latents_BthwC, config.groups, eps)
    frames = x_BTHWC.shape[1]
    per_frame = (jnp.broadcast_to(v, (len(v), frames, *v.shape[2:])) for v in parts)
    return convolve_frame_by_frame(kernel, _swish, (x_BTHWC, *per_frame), past)


def _affine(
    params: Params, x_BTHWC: Array, latents_BthwC: Array | None, groups: int, eps: float
) -> tuple[Array, Array]:
    """Return factor and offset of ``norm``: (B, 1, 1, 1, C), or (B, T, h, w, C) with latents."""
    factor, offset = (
        v[:, None, None, None] for v in group_norm_affine(params, x_BTHWC, groups, eps)
    )
    if latents_BthwC is None:
        return factor, offset
    latents = latents_BthwC.astype(jnp.float32)
    by = pointwise(params["scale_by"], latents)
    factor, offset = by * factor, by * offset + pointwise(params["shift_by"], latents)
    frames = x_BTHWC.shape[1]
    return stretch(factor, frames), stretch(offset, frames)


def _swish(x_BTHWC: Array, factor_BThwC: Array, offset_BThwC: Array) -> Array:
    """Return swish(x·factor + offset) in x's dtype; a factor counts for a cell of pixels."""
    h, w = factor_BThwC.shape[2:4]
    wide = x_BTHWC.astype(jnp.float32)
    if h > 1 or w > 1:
        # The pixels of a cell are axes of their own, so that no array is upsampled.
        batch, frames, height, width, channels = x_BTHWC.shape
        wide = wide.reshape(batch, frames, h, height // h, w, width // w, channels)
        factor_BThwC, offset_BThwC = (
            v[:, :, :, None, :, None] for v in (factor_BThwC, offset_BThwC)
        )
    out = jax.nn.silu(wide * factor_BThwC + offset_BThwC).astype(x_BTHWC.dtype)
    return out.reshape(x_BTHWC.shape)


def stretch(x_BthwC: Array, frames: int) -> Array:
    """Repeat frames of latents to a number of frames; if it is odd, the first is not repeated."""
    if frames > 1 and frames % 2:
        first, rest = x_BthwC[:, :1], x_BthwC[:, 1:]
        rest = jnp.repeat(rest, (frames - 1) // rest.shape[1], axis=1)
        return jnp.concatenate([first, rest], 1)
    return jnp.repeat(x_BthwC, frames // x_BthwC.shape[1], axis=1)


def resnet(
    config: VAEConfig,
    params: Params,
    x_BTHWC: Array,
    latents_BthwC: Array | None,
    past: Params,
) -> tuple[Array, Params]:
    """Residual block: norm, swish, convolution, twice; returned with the next chunk's past.

    ``latents_BthwC`` condition the decoder's norms, and are None in the encoder. ``past`` is empty
    in the first chunk.
    """
    h, new = x_BTHWC, {}
    for k in "12":
        name = f"conv{k}"
        h, new[name] = norm_conv(config, params, k, h, latents_BthwC, past.get(name))
    if "shortcut" in params:
        x_BTHWC = pointwise(params["shortcut"], x_BTHWC)
    return x_BTHWC + h, new


def downsample(params: Params, x_BTHWC: Array, *, in_time: bool) -> Array:
    """Average pairs of frames, then halve height and width by a strided convolution.

    If the number of frames is odd, the first one is not averaged.
    """
    if in_time:
        odd = x_BTHWC.shape[1] % 2
        rest = x_BTHWC[:, odd:].astype(jnp.float32)
        rest = ((rest[:, ::2] + rest[:, 1::2]) / 2).astype(x_BTHWC.dtype)
        x_BTHWC = jnp.concatenate([x_BTHWC[:, :odd], rest], 1)
    return convolve_frames(params, x_BTHWC, stride=2, padding=((0, 1), (0, 1)))


def upsample(config: VAEConfig, params: Params, x_BTHWC: Array, *, in_time: bool) -> Array:
    """Double height and width (nearest) and convolve each frame; then repeat frames.

    If the number of frames is odd, the first one is not repeated. (Repeating frames after a
    convolution of single frames gives the same as before it, with less work.)
    """
    if form(config.convolution, x_BTHWC.dtype, len(x_BTHWC), decodes=True) == "frames":
        x = frame_by_frame(lambda frame: convolve_upsampled(params, frame), x_BTHWC)
    else:
        x = convolve_upsampled(params, x_BTHWC)
    frames = x.shape[1]
    if not in_time or frames == 1:
        return x
    odd = frames % 2
    return jnp.concatenate([x[:, :odd], jnp.repeat(x[:, odd:], 2, axis=1)], 1)


def layout(config: VAEConfig) -> dict[str, tuple[int, ...]]:
    """Return ``{path: shape}`` of the parameters."""
    return dict([*_encoder_leaves(config), *_decoder_leaves(config)])


def _encoder_leaves(config: VAEConfig) -> Iterator[Leaf]:
    widths = config.widths
    yield from convolution("encoder/conv_in", (3, 3, 3), config.in_channels, widths[0])
    yield from levels("encoder/down", widths, config.resnets, _resnet_leaves)
    for k in range(2):
        yield from _resnet_leaves(f"encoder/mid/resnet_{k}", widths[-1], widths[-1])
    yield from norm_leaves("encoder/norm_out", widths[-1])
    yield from convolution("encoder/conv_out", (3, 3, 3), widths[-1], 2 * config.latent_channels)


def _decoder_leaves(config: VAEConfig) -> Iterator[Leaf]:
    widths, latent = config.widths[::-1], config.latent_channels
    block = functools.partial(_resnet_leaves, latent=latent)
    yield from convolution("decoder/conv_in", (3, 3, 3), latent, widths[0])
    for k in range(2):
        yield from block(f"decoder/mid/resnet_{k}", widths[0], widths[0])
    yield from levels("decoder/up", widths, config.resnets + 1, block)
    yield from _norm_leaves("decoder/norm_out", widths[-1], latent)
    yield from convolution("decoder/conv_out", (3, 3, 3), widths[-1], config.out_channels)


def _norm_leaves(where: str, width: int, latent: int = 0) -> Iterator[Leaf]:
    yield from norm_leaves(where, width)
    if latent:
        yield from convolution(f"{where}/scale_by", (1, 1, 1), latent, width)
        yield from convolution(f"{where}/shift_by", (1, 1, 1), latent, width)


def _resnet_leaves(where: str, inside: int, outside: int, latent: int = 0) -> Iterator[Leaf]:
    yield from _norm_leaves(f"{where}/norm1", inside, latent)
    yield from convolution(f"{where}/conv1", (3, 3, 3), inside, outside)
    yield from _norm_leaves(f"{where}/norm2", outside, latent)
    yield from convolution(f"{where}/conv2", (3, 3, 3), outside, outside)
    if inside != outside:
        yield from convolution(f"{where}/shortcut", (1, 1, 1), inside, outside)
