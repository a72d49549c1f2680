"""Stable Video Diffusion's autoencoder, equal to diffusers' ``AutoencoderKLTemporalDecoder``.

The encoder sees one frame at a time. The decoder mixes neighbouring frames: its residual blocks
convolve over time as well. It therefore decodes the frames of a clip together, or some at a time
with less memory and a slightly different result at the seams.

Neither ``encode`` nor ``decode`` applies ``config.scaling_factor``; ``svd_vae_codec`` does.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp

from pewm_jax.errors import UserError
from pewm_jax.models.svd import layers as svd_layers
from pewm_jax.models.svd.config import SVDVAEConfig
from pewm_jax.models.svd.layers import resnet_2d_leaves, resnet_leaves
from pewm_jax.nn.attention import multi_head_attention
from pewm_jax.nn.layers import linear
from pewm_jax.nn.parameters import Leaf, convolution, draw
from pewm_jax.nn.parameters import linear as linear_leaves
from pewm_jax.nn.parameters import norm as norm_leaves
from pewm_jax.nn.video_convolution import SAME, convolve_frames
from pewm_jax.types import Array, Params

EPS, TEMPORAL_EPS = 1e-6, 1e-5
"""Added to the variances of group norms: of frames, and over time."""
AFTER = ((0, 1), (0, 1))
"""Padding of the encoder's strided convolutions."""


def layout(config: SVDVAEConfig) -> dict[str, tuple[int, ...]]:
    """Return ``{path: shape}`` of the parameters; see ``svd.layers``."""
    return dict([*_encoder(config), *_decoder(config)])


def init(config: SVDVAEConfig, key: Array) -> Params:
    """Return random parameters, float32: ``{"encoder": …, "decoder": …}``."""
    return draw(layout(config), key, key_per_leaf=True)


def encode(config: SVDVAEConfig, params: Params, video_BTHWC: Array) -> Array:
    """Encode every frame to the mean of its latents, which is the distribution's mode.

    Args:
        config: the autoencoder.
        params: its parameters.
        video_BTHWC: (B, T, H, W, C) floats in [−1, 1]; their dtype is that of the computation.
            H and W are multiples of ``config.spatial``.

    Returns:
        (B, T, H/8, W/8, z), not scaled.

    Raises:
        UserError: an array of another shape, or a size that is no multiple.
    """
    _check(video_BTHWC, config.in_channels, "video_BTHWC")
    height, width = video_BTHWC.shape[2:4]
    side = config.spatial
    if height % side or width % side:
        raise UserError(
            f"a video of {height}×{width} pixels cannot be encoded: height and width must be "
            f"multiples of {side}."
        )
    return _encode(config, params["encoder"], video_BTHWC)


def decode(
    config: SVDVAEConfig, params: Params, latents_BThwC: Array, *, at_once: int | None = None
) -> Array:
    """Decode latents to a video.

    Args:
        config: the autoencoder.
        params: its parameters.
        latents_BThwC: (B, T, h, w, z) latents, divided by ``config.scaling_factor`` again; their
            dtype is that of the computation.
        at_once: frames that are decoded together, as ``decode_chunk_size`` of diffusers'
            pipeline; None for all.

    Returns:
        (B, T, 8h, 8w, C) video in about [−1, 1].

    Raises:
        UserError: an array of another shape, or ``at_once`` below 1.
    """
    _check(latents_BThwC, config.latent_channels, "latents_BThwC")
    frames = latents_BThwC.shape[1]
    if at_once is not None and at_once < 1:
        raise UserError(f"at_once is {at_once}: decode at least one frame at a time.")
    step = at_once or frames
    parts = [latents_BThwC[:, k : k + step] for k in range(0, frames, step)]
    return jnp.concatenate([_decode(config, params["decoder"], part) for part in parts], 1)


@partial(jax.jit, static_argnums=0)
def _encode(config: SVDVAEConfig, params: Params, x: Array) -> Array:
    x = convolve_frames(params["conv_in"], x, 1, SAME)
    for level in range(len(config.widths)):
        place = params[f"down_{level}"]
        for k in range(config.resnets):
            x = svd_layers.resnet_2d(place[f"resnet_{k}"], x, None, EPS)
        if "resample" in place:
            x = svd_layers.downsample(place["resample"], x, AFTER)
    place = params["mid"]
    x = svd_layers.resnet_2d(place["resnet_0"], x, None, EPS)
    x = _attend(place["attend_0"], x)
    x = svd_layers.resnet_2d(place["resnet_1"], x, None, EPS)
    x = svd_layers.active(params["norm_out"], x, EPS)
    moments = linear(params["quant"], convolve_frames(params["conv_out"], x, 1, SAME))
    return moments[..., : config.latent_channels]


@partial(jax.jit, static_argnums=0)
def _decode(config: SVDVAEConfig, params: Params, x: Array) -> Array:
    mix = partial(svd_layers.resnet, eps=EPS, temporal_eps=TEMPORAL_EPS, switched=True)
    x = convolve_frames(params["conv_in"], x, 1, SAME)
    place = params["mid"]
    x = mix(place["resnet_0"], x, None)
    x = _attend(place["attend_0"], x)
    x = mix(place["resnet_1"], x, None)  # the reference runs no more of them than two
    for level in range(len(config.widths)):
        place = params[f"up_{level}"]
        for k in range(config.resnets + 1):
            x = mix(place[f"resnet_{k}"], x, None)
        if "resample" in place:
            x = svd_layers.upsample(place["resample"], x, *(2 * side for side in x.shape[2:4]))
    x = svd_layers.active(params["norm_out"], x, EPS)
    x = convolve_frames(params["conv_out"], x, 1, SAME)
    return svd_layers.convolve_time(params["time_out"], x)


def _attend(params: Params, x_BTHWC: Array) -> Array:
    """Self-attention of each frame with one head, residual."""
    batch, frames, height, width, channels = x_BTHWC.shape
    x = svd_layers.norm(params["norm"], x_BTHWC, EPS).astype(x_BTHWC.dtype)
    x = x.reshape(batch * frames, height * width, channels)
    return x_BTHWC + multi_head_attention(params, x, x, 1).reshape(x_BTHWC.shape)


def _encoder(config: SVDVAEConfig) -> Iterator[Leaf]:
    widths, moments = config.widths, 2 * config.latent_channels
    yield from convolution("encoder/conv_in", (3, 3), config.in_channels, widths[0])
    inside = widths[0]
    for level, width in enumerate(widths):
        where = f"encoder/down_{level}"
        for k in range(config.resnets):
            yield from resnet_2d_leaves(f"{where}/resnet_{k}", inside, width)
            inside = width
        if level + 1 < len(widths):
            yield from convolution(f"{where}/resample", (3, 3), width, width)
    for k in range(2):
        yield from resnet_2d_leaves(f"encoder/mid/resnet_{k}", inside, inside)
    yield from _attention("encoder/mid/attend_0", inside)
    yield from norm_leaves("encoder/norm_out", inside)
    yield from convolution("encoder/conv_out", (3, 3), inside, moments)
    yield from linear_leaves("encoder/quant", moments, moments)


def _decoder(config: SVDVAEConfig) -> Iterator[Leaf]:
    widths = config.widths[::-1]
    inside = widths[0]
    yield from convolution("decoder/conv_in", (3, 3), config.latent_channels, inside)
    for k in range(config.resnets):
        yield from resnet_leaves(f"decoder/mid/resnet_{k}", inside, inside)
    yield from _attention("decoder/mid/attend_0", inside)
    for level, width in enumerate(widths):
        where = f"decoder/up_{level}"
        for k in range(config.resnets + 1):
            yield from resnet_leaves(f"{where}/resnet_{k}", inside, width)
            inside = width
        if level + 1 < len(widths):
            yield from convolution(f"{where}/resample", (3, 3), width, width)
    yield from norm_leaves("decoder/norm_out", inside)
    yield from convolution("decoder/conv_out", (3, 3), inside, config.out_channels)
    yield from convolution("decoder/time_out", (3,), config.out_channels, config.out_channels)


def _attention(where: str, width: int) -> Iterator[Leaf]:
    yield from norm_leaves(f"{where}/norm", width)
    for name in ("to_q", "to_k", "to_v", "to_out"):
        yield from linear_leaves(f"{where}/{name}", width, width)


def _check(x: Array, channels: int, name: str) -> None:
    if x.ndim != 5 or x.shape[-1] != channels:
        raise UserError(
            f"{name} has shape {tuple(x.shape)}: five axes are needed, batch, time, height, width "
            f"and {channels} channels last."
        )
    if not jnp.issubdtype(x.dtype, jnp.floating):
        raise UserError(f"{name} holds {x.dtype}: convert it to floats first.")
