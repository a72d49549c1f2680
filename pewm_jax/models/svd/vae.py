"""Stable Video Diffusion's autoencoder, equal to diffusers' ``AutoencoderKLTemporalDecoder``.

The encoder sees one frame at a time. The decoder mixes neighbouring frames: its residual blocks
convolve over time as well. It therefore decodes the frames of a clip together, or some at a time
with less memory and a slightly different result at the seams.

Neither ``encode`` nor ``decode`` applies ``config.scaling_factor``. ``SVDVAECodec`` does, a codec
of the mean of the latents: it scales the latents that are denoised to unit variance, but not those
of the conditioning image, as in the reference's pipeline.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp

from pewm_jax.errors import UserError, require, require_positive
from pewm_jax.models.interface import PublishedVAE
from pewm_jax.models.svd import layers as svd_layers
from pewm_jax.models.svd.layers import GROUPS, resnet_2d_leaves, resnet_leaves
from pewm_jax.nn.attention import multi_head_attention
from pewm_jax.nn.layers import linear
from pewm_jax.nn.parameters import Leaf, convolution, draw, levels
from pewm_jax.nn.parameters import linear as linear_leaves
from pewm_jax.nn.parameters import norm as norm_leaves
from pewm_jax.nn.video_convolution import AFTER, SAME, convolve_frames, require_video
from pewm_jax.types import Array, Params

EPS, TEMPORAL_EPS = 1e-6, 1e-5
"""Added to the variances of group norms: of frames, and over time."""


@dataclasses.dataclass(frozen=True)
class SVDVAECodec(PublishedVAE):
    """An image encoder and a decoder over space and time (arXiv 2311.15127, appendix D).

    The defaults are as published; the weights come from a converted checkpoint.
    """

    in_channels: int = 3
    """Channels of an input frame."""
    out_channels: int = 3
    """Channels of an output frame."""
    latent_channels: int = 4
    """Channels of a latent."""
    widths: tuple[int, ...] = (128, 256, 512, 512)
    """Channels of each level of the encoder; each level but the last halves height and width."""
    resnets: int = 2
    """Residual blocks per level of the encoder; the decoder has one more."""
    scaling_factor: float = 0.18215
    """Factor that gives latents unit variance for the diffusion model. The latents of the
    conditioning image stay without it."""
    depth: bool = True
    """Whether depth is encoded too, as grey pictures by the same weights, in as many channels more;
    Stable Video Diffusion itself knows colour alone."""

    @property
    def spatial(self) -> int:
        """Pixels per latent cell, along height and along width."""
        return 2 ** (len(self.widths) - 1)

    @property
    def temporal(self) -> int:
        """Frames per latent frame after the first: every frame has its own latents."""
        return 1

    def __post_init__(self):
        """Validate."""
        require(len(self.widths) > 0, "codec.widths is empty: name at least one level's channels.")
        require_positive(self, "codec", "in_channels", "out_channels", "latent_channels")
        require(
            self.resnets >= 2,
            f"codec.resnets is {self.resnets}: use at least 2, or the decoder's bottom has no "
            "attention.",
        )
        for width in self.widths:
            require(
                width >= 1 and width % GROUPS == 0,
                f"codec.widths holds {width}, which is not a multiple of {GROUPS} groups.",
            )
        require(
            self.scaling_factor > 0,
            f"codec.scaling_factor is {self.scaling_factor}: use the checkpoint's positive factor "
            "(0.18215).",
        )

    @property
    def framewise(self) -> bool:
        """Whether a latent frame is decoded by itself: no, with its neighbours."""
        return False

    def init(self, key: Array) -> Params:
        """Return random parameters."""
        return init(self, key)

    def encode(self, params: Params, video_BTHWC: Array, *, condition: bool = False) -> Array:
        """Encode a video to the mean of its latents."""
        mean = encode(self, params, video_BTHWC)
        return mean if condition else mean * self.scaling_factor

    def decode(self, params: Params, latents_BthwC: Array) -> Array:
        """Decode scaled latents to as many frames, all of a clip together."""
        return decode(self, params, latents_BthwC / self.scaling_factor)


def layout(config: SVDVAECodec) -> dict[str, tuple[int, ...]]:
    """Return ``{path: shape}`` of the parameters; see ``svd.layers``."""
    return dict([*_encoder(config), *_decoder(config)])


def init(config: SVDVAECodec, key: Array) -> Params:
    """Return random parameters, float32: ``{"encoder": …, "decoder": …}``."""
    return draw(layout(config), key, key_per_leaf=True)


def encode(config: SVDVAECodec, params: Params, video_BTHWC: Array) -> Array:
    """Encode every frame to the mean of its latents, (B, T, H/8, W/8, z), not scaled.

    The mean is the distribution's mode. The video is of floats in [−1, 1], whose dtype is that of
    the computation; H and W are multiples of ``config.spatial``.

    Raises:
        UserError: an array of another shape, or a size that is no multiple.
    """
    require_video(video_BTHWC, config.in_channels, "video_BTHWC")
    height, width = video_BTHWC.shape[2:4]
    side = config.spatial
    if height % side or width % side:
        raise UserError(
            f"a video of {height}×{width} pixels cannot be encoded: height and width must be "
            f"multiples of {side}."
        )
    return _encode(config, params["encoder"], video_BTHWC)


def decode(
    config: SVDVAECodec, params: Params, latents_BThwC: Array, *, at_once: int | None = None
) -> Array:
    """Decode latents (B, T, h, w, z) to a video (B, T, 8h, 8w, C) in about [−1, 1].

    The latents are divided by ``config.scaling_factor`` again; their dtype is that of the
    computation. ``at_once`` frames are decoded together (diffusers: ``decode_chunk_size``).

    Raises:
        UserError: an array of another shape, or ``at_once`` below 1.
    """
    require_video(latents_BThwC, config.latent_channels, "latents_BThwC")
    frames = latents_BThwC.shape[1]
    if at_once is not None and at_once < 1:
        raise UserError(f"at_once is {at_once}: decode at least one frame at a time.")
    step = at_once or frames
    parts = [latents_BThwC[:, k : k + step] for k in range(0, frames, step)]
    return jnp.concatenate([_decode(config, params["decoder"], part) for part in parts], 1)


@partial(jax.jit, static_argnums=0)
def _encode(config: SVDVAECodec, params: Params, x: Array) -> Array:
    x = convolve_frames(params["conv_in"], x, 1, SAME)
    for level in range(len(config.widths)):
        place = params[f"down_{level}"]
        for k in range(config.resnets):
            x = svd_layers.resnet_2d(place[f"resnet_{k}"], x, None, EPS)
        if "resample" in place:
            x = convolve_frames(place["resample"], x, 2, AFTER)
    place = params["mid"]
    x = svd_layers.resnet_2d(place["resnet_0"], x, None, EPS)
    x = _attend(place["attend_0"], x)
    x = svd_layers.resnet_2d(place["resnet_1"], x, None, EPS)
    x = svd_layers.active(params["norm_out"], x, EPS)
    moments = linear(params["quant"], convolve_frames(params["conv_out"], x, 1, SAME))
    return moments[..., : config.latent_channels]


@partial(jax.jit, static_argnums=0)
def _decode(config: SVDVAECodec, params: Params, x: Array) -> Array:
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


def _encoder(config: SVDVAECodec) -> Iterator[Leaf]:
    widths, moments = config.widths, 2 * config.latent_channels
    yield from convolution("encoder/conv_in", (3, 3), config.in_channels, widths[0])
    yield from levels("encoder/down", widths, config.resnets, resnet_2d_leaves)
    for k in range(2):
        yield from resnet_2d_leaves(f"encoder/mid/resnet_{k}", widths[-1], widths[-1])
    yield from _attention("encoder/mid/attend_0", widths[-1])
    yield from norm_leaves("encoder/norm_out", widths[-1])
    yield from convolution("encoder/conv_out", (3, 3), widths[-1], moments)
    yield from linear_leaves("encoder/quant", moments, moments)


def _decoder(config: SVDVAECodec) -> Iterator[Leaf]:
    widths = config.widths[::-1]
    yield from convolution("decoder/conv_in", (3, 3), config.latent_channels, widths[0])
    for k in range(config.resnets):
        yield from resnet_leaves(f"decoder/mid/resnet_{k}", widths[0], widths[0])
    yield from _attention("decoder/mid/attend_0", widths[0])
    yield from levels("decoder/up", widths, config.resnets + 1, resnet_leaves)
    yield from norm_leaves("decoder/norm_out", widths[-1])
    yield from convolution("decoder/conv_out", (3, 3), widths[-1], config.out_channels)
    yield from convolution("decoder/time_out", (3,), config.out_channels, config.out_channels)


def _attention(where: str, width: int) -> Iterator[Leaf]:
    yield from norm_leaves(f"{where}/norm", width)
    for name in ("to_q", "to_k", "to_v", "to_out"):
        yield from linear_leaves(f"{where}/{name}", width, width)
