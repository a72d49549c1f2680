"""Wan's video autoencoder, equal to diffusers' ``AutoencoderKLWan`` of Wan 2.1 and Cosmos-Predict2.

Four frames of 8 × 8 pixels become one latent; the first frame has a latent of its own. Every layer
is causal, so 4n + 1 frames become n + 1 latents and 4n + 1 frames again, and no latent depends on
a later frame. The first frame is encoded alone and then four frames at a time, decoded one latent
at a time; layers pass their last frames on to the next chunk, and the result is that of the whole
clip at once. The chunks bound the memory. A video starts with one frame of its own, before which
there are zeros. The last frames are passed on as ``past``: one array per layer, nested like the
parameters; empty at the start. Reference: ``autoencoder_kl_wan.py`` of diffusers.

Outside of ``jit``, ``encode`` and ``decode`` call a compiled function per chunk, so two
compilations serve videos of any length. ``WanVAECodec`` makes a codec of it: the mean of the
latents, each channel normalised.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp

from pewm_jax.errors import UserError, require, require_positive
from pewm_jax.models.interface import PublishedVAE
from pewm_jax.nn import attention as blocked_attention
from pewm_jax.nn import video_convolution as convolutions
from pewm_jax.nn.layers import linear
from pewm_jax.nn.parameters import Leaf, convolution, draw
from pewm_jax.nn.parameters import linear as linear_leaves
from pewm_jax.nn.video_convolution import (
    AFTER,
    convolve_frames,
    convolve_upsampled,
    in_chunks,
    require_video,
)
from pewm_jax.types import Array, Params

LOGVAR_RANGE = (-30.0, 20.0)
"""The logarithm of a latent's variance is clipped to this range."""
MEAN_16 = (
    *(-0.7571, -0.7089, -0.9113, 0.1075, -0.1745, 0.9653, -0.1517, 1.5508),
    *(0.4134, -0.0715, 0.5517, -0.3632, -0.1922, -0.9497, 0.2503, -0.2921),
)
STD_16 = (
    *(2.8184, 1.4541, 2.3275, 2.6558, 1.2196, 1.7708, 2.6052, 2.0743),
    *(3.2687, 2.1526, 2.8652, 1.5579, 1.6382, 1.1253, 2.8251, 1.9160),
)
SMALLEST = 1e-12
"""Least length that a pixel's channels are divided by."""


@dataclasses.dataclass(frozen=True)
class WanVAECodec(PublishedVAE):
    """Wan 2.1's video autoencoder (arXiv 2503.20314): causal, four frames to a latent.

    Cosmos-Predict2 uses it. The defaults are as published; the weights come from a converted
    checkpoint.
    """

    in_channels: int = 3
    """Channels of an input frame."""
    out_channels: int = 3
    """Channels of an output frame."""
    latent_channels: int = 16
    """Channels of a latent."""
    base_width: int = 96
    """Channels of the encoder's first layer."""
    decoder_base_width: int = 96
    """The same for the decoder's last one."""
    multiples: tuple[int, ...] = (1, 2, 4, 4)
    """Channels of each level over the base; each level but the last halves height and width."""
    resnets: int = 2
    """Residual blocks per level of the encoder; the decoder has one more."""
    halves_time: tuple[bool, ...] = (False, True, True)
    """Whether a level of the encoder, but the last, halves the number of frames too."""
    latents_mean: tuple[float, ...] = MEAN_16
    """Mean of each channel of latents, by which the diffusion model's latents are shifted."""
    latents_std: tuple[float, ...] = STD_16
    """Standard deviation of each channel. Neither encoding nor decoding uses the two;
    ``normalise`` and ``restore`` do."""
    convolution: Literal["auto", "stacked", "taps", "volume", "winograd"] = "auto"
    """The form of 3D convolutions, as in ``VAEConfig``."""
    depth: bool = True
    """Whether depth is encoded too, as grey pictures by the same weights, in as many channels more;
    Cosmos-Predict2 itself knows colour alone."""

    @property
    def spatial(self) -> int:
        """Pixels per latent cell, along height and along width."""
        return 2 ** len(self.halves_time)

    @property
    def temporal(self) -> int:
        """Frames per latent after the first."""
        return 2 ** sum(self.halves_time)

    def __post_init__(self):
        """Validate."""
        require_positive(self, "codec", "in_channels", "out_channels", "latent_channels", "resnets")
        require_positive(self, "codec", "base_width", "decoder_base_width")
        require(
            len(self.multiples) > 0 and min(self.multiples) >= 1,
            f"codec.multiples is {self.multiples}: name one number of at least 1 per level.",
        )
        require(
            len(self.halves_time) == len(self.multiples) - 1,
            f"codec.halves_time names {len(self.halves_time)} levels: name one value for each of "
            f"the {len(self.multiples)} levels but the last.",
        )
        require(
            self.temporal <= 4,
            f"codec.halves_time halves time {sum(self.halves_time)} times: at most twice, the "
            "reference reads four frames at a time.",
        )
        require(
            all(self.decoder_base_width * m % 2 == 0 for m in self.multiples[1:]),
            f"codec.decoder_base_width {self.decoder_base_width} times codec.multiples must be "
            "even numbers: each step up halves the channels.",
        )
        for name in ("latents_mean", "latents_std"):
            require(
                len(getattr(self, name)) == self.latent_channels,
                f"codec.{name} names {len(getattr(self, name))} channels: name one number for each "
                f"of the {self.latent_channels} of codec.latent_channels.",
            )
        require(
            min(self.latents_std) > 0,
            f"codec.latents_std holds {min(self.latents_std)}: use numbers above 0.",
        )

    @property
    def framewise(self) -> bool:
        """Whether a latent frame is decoded by itself: no, with those before it."""
        return False

    def check(self, model: Any) -> None:
        """Refuse clips that are not encoded four frames at a time."""
        super().check(model)
        require(
            model.clip.frames % 4 == 1,
            f"clip.frames is {model.clip.frames}: this codec encodes four frames at a time after "
            "the first, so use 4k + 1 frames (5, 9, …).",
        )

    def init(self, key: Array) -> Params:
        """Return random parameters."""
        return init(self, key)

    def encode(self, params: Params, video_BTHWC: Array, *, condition: bool = False) -> Array:
        """Encode a video to the mean of its latents."""
        del condition
        mean, _ = encode(self, params, video_BTHWC)
        return normalise(self, mean)

    def decode(self, params: Params, latents_BthwC: Array) -> Array:
        """Decode normalised latents to q·(t − 1) + 1 frames."""
        return decode(self, params, restore(self, latents_BthwC))


def layout(config: WanVAECodec) -> dict[str, tuple[int, ...]]:
    """Return ``{path: shape}`` of the parameters.

    A 3D convolution is ``kernel (3, 3, 3, in, out)`` and ``bias``, one of frames ``(3, 3, in,
    out)``, one in time ``(3, in, out)``, a linear layer ``(in, out)``; a norm is ``scale``.
    """
    return dict([*_encoder(config), *_decoder(config)])


def init(config: WanVAECodec, key: Array) -> Params:
    """Return random parameters, float32: ``{"encoder": …, "decoder": …}``."""
    return draw(layout(config), key, key_per_leaf=True)


def normalise(config: WanVAECodec, latents_BthwC: Array) -> Array:
    """Return latents of mean 0 and deviation 1 in each channel, as the diffusion model has them."""
    mean, std = _statistics(config, latents_BthwC.dtype)
    return (latents_BthwC - mean) / std


def restore(config: WanVAECodec, latents_BthwC: Array) -> Array:
    """Invert ``normalise``."""
    mean, std = _statistics(config, latents_BthwC.dtype)
    return latents_BthwC * std + mean


def _statistics(config: WanVAECodec, dtype: jnp.dtype) -> tuple[Array, Array]:
    return jnp.asarray(config.latents_mean, dtype), jnp.asarray(config.latents_std, dtype)


def encode(config: WanVAECodec, params: Params, video_BTHWC: Array) -> tuple[Array, Array]:
    """Encode a video to mean and logarithm of the variance of its latents, (B, n + 1, H/8, W/8, z).

    They are not normalised. To sample, compute mean + exp(logvar / 2)·noise. The video is of floats
    in [−1, 1], whose dtype is that of the computation; T is 4n + 1. Rows and columns beyond a
    multiple of ``config.spatial`` become no latents, as in the reference.

    Raises:
        UserError: an array of another shape, or a video that cannot be encoded.
    """
    require_video(video_BTHWC, config.in_channels, "video_BTHWC")
    frames, height, width = video_BTHWC.shape[1:4]
    if frames % 4 != 1:
        raise UserError(
            f"a video of {frames} frames cannot be encoded: use 4n + 1 frames (1, 5, 9, …)."
        )
    if min(height, width) < config.spatial:
        raise UserError(
            f"a video of {height}×{width} pixels is smaller than one latent, "
            f"{config.spatial}×{config.spatial}: enlarge it."
        )
    moments = in_chunks(partial(_encode_chunk, config, params["encoder"]), video_BTHWC, 1, 4)
    mean, logvar = jnp.split(moments, 2, -1)
    return mean, jnp.clip(logvar, *LOGVAR_RANGE)


def decode(config: WanVAECodec, params: Params, latents_BthwC: Array) -> Array:
    """Decode latents (B, t, h, w, z), not normalised, to (B, 4·(t − 1) + 1, 8h, 8w, C) in [−1, 1].

    Raises:
        UserError: an array of another shape.
    """
    require_video(latents_BthwC, config.latent_channels, "latents_BthwC")
    step = partial(_decode_chunk, config, params["decoder"])
    return jnp.clip(in_chunks(step, latents_BthwC, 1, 1), -1, 1)


@partial(jax.jit, static_argnums=0)
def _encode_chunk(
    config: WanVAECodec, params: Params, x: Array, past: Params
) -> tuple[Array, Params]:
    new: dict[str, Any] = {}
    x, new["conv_in"] = causal_conv(config, params["conv_in"], x, past.get("conv_in"))
    for level in range(len(config.multiples)):
        name = f"down_{level}"
        x, new[name] = _level(config, params[name], x, past.get(name, {}), downsample)
    x, new["mid"] = middle(config, params["mid"], x, past.get("mid", {}))
    x = active(params["norm_out"], x)
    x, new["conv_out"] = causal_conv(config, params["conv_out"], x, past.get("conv_out"))
    return linear(params["quant"], x), new


@partial(jax.jit, static_argnums=0)
def _decode_chunk(
    config: WanVAECodec, params: Params, x: Array, past: Params
) -> tuple[Array, Params]:
    new: dict[str, Any] = {}
    x = linear(params["quant"], x)
    x, new["conv_in"] = causal_conv(config, params["conv_in"], x, past.get("conv_in"))
    x, new["mid"] = middle(config, params["mid"], x, past.get("mid", {}))
    for level in range(len(config.multiples)):
        name = f"up_{level}"
        x, new[name] = _level(config, params[name], x, past.get(name, {}), upsample)
    x = active(params["norm_out"], x)
    x, new["conv_out"] = causal_conv(config, params["conv_out"], x, past.get("conv_out"))
    return x, new


def _level(
    config: WanVAECodec, params: Params, x: Array, past: Params, resample: Any
) -> tuple[Array, Params]:
    """Run the residual blocks of a level, and change the size after them."""
    new: dict[str, Any] = {}
    for k in range(sum(name.startswith("resnet") for name in params)):
        name = f"resnet_{k}"
        x, new[name] = resnet(config, params[name], x, past.get(name, {}))
    if "resample" in params:
        x, new["resample"] = resample(params["resample"], x, past.get("resample"))
    return x, new


def norm(params: Params, x: Array) -> Array:
    """Divide the channels of each pixel by their root mean square; float32."""
    value = x.astype(jnp.float32)
    length = jnp.sqrt(jnp.square(value).sum(-1, keepdims=True))
    return value * (x.shape[-1] ** 0.5 / jnp.maximum(length, SMALLEST)) * params["scale"]


def active(params: Params, x: Array) -> Array:
    """Norm and SiLU, in x's dtype."""
    return jax.nn.silu(norm(params, x)).astype(x.dtype)


def causal_conv(
    config: WanVAECodec, params: Params, x_BTHWC: Array, past: Array | None
) -> tuple[Array, Array]:
    """Convolve causally; before the first chunk (``past`` None) there are two frames of zeros."""
    past = _two_zeros(x_BTHWC) if past is None else past
    return convolutions.convolve_causal(config.convolution, params, x_BTHWC, past)


def resnet(
    config: WanVAECodec, params: Params, x_BTHWC: Array, past: Params
) -> tuple[Array, Params]:
    """Residual block: norm, SiLU, convolution, twice; with the next chunk's past."""
    h, new = x_BTHWC, {}
    for k in "12":
        name = f"conv{k}"
        h = active(params[f"norm{k}"], h)
        h, new[name] = causal_conv(config, params[name], h, past.get(name))
    if "shortcut" in params:
        x_BTHWC = linear(params["shortcut"], x_BTHWC)
    return x_BTHWC + h, new


def middle(
    config: WanVAECodec, params: Params, x_BTHWC: Array, past: Params
) -> tuple[Array, Params]:
    """Run the bottom: residual block, attention within each frame, residual block."""
    new = {}
    for k in range(2):
        name = f"resnet_{k}"
        x_BTHWC, new[name] = resnet(config, params[name], x_BTHWC, past.get(name, {}))
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
    x = convolve_frames(params["space"], x_BTHWC, 2, AFTER)
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
        return convolve_upsampled(params["space"], x_BTHWC), None
    if past is None:
        return convolve_upsampled(params["space"], x_BTHWC), _two_zeros(x_BTHWC)
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
    return convolve_upsampled(params["space"], doubled), padded[:, -2:]


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


def _encoder(config: WanVAECodec) -> Iterator[Leaf]:
    inside, moments = config.base_width, 2 * config.latent_channels
    yield from convolution("encoder/conv_in", (3, 3, 3), config.in_channels, inside)
    for level, multiple in enumerate(config.multiples):
        where, width = f"encoder/down_{level}", multiple * config.base_width
        for k in range(config.resnets):
            yield from resnet_leaves(f"{where}/resnet_{k}", inside, width)
            inside = width
        if level < len(config.halves_time):
            yield from convolution(f"{where}/resample/space", (3, 3), width, width)
            if config.halves_time[level]:
                yield from convolution(f"{where}/resample/time", (3,), width, width)
    yield from middle_leaves("encoder/mid", inside)
    yield "encoder/norm_out/scale", (inside,)
    yield from convolution("encoder/conv_out", (3, 3, 3), inside, moments)
    yield from linear_leaves("encoder/quant", moments, moments)


def _decoder(config: WanVAECodec) -> Iterator[Leaf]:
    widths = [multiple * config.decoder_base_width for multiple in config.multiples[::-1]]
    inside, latent = widths[0], config.latent_channels
    yield from linear_leaves("decoder/quant", latent, latent)
    yield from convolution("decoder/conv_in", (3, 3, 3), latent, inside)
    yield from middle_leaves("decoder/mid", inside)
    for level, width in enumerate(widths):
        where = f"decoder/up_{level}"
        for k in range(config.resnets + 1):
            yield from resnet_leaves(f"{where}/resnet_{k}", inside, width)
            inside = width
        if level < len(config.halves_time):
            inside = width // 2
            yield from convolution(f"{where}/resample/space", (3, 3), width, inside)
            if config.halves_time[::-1][level]:
                yield from convolution(f"{where}/resample/time", (3,), width, 2 * width)
    yield "decoder/norm_out/scale", (inside,)
    yield from convolution("decoder/conv_out", (3, 3, 3), inside, config.out_channels)


def resnet_leaves(where: str, inside: int, outside: int) -> Iterator[Leaf]:
    """Yield the leaves of a residual block."""
    yield f"{where}/norm1/scale", (inside,)
    yield from convolution(f"{where}/conv1", (3, 3, 3), inside, outside)
    yield f"{where}/norm2/scale", (outside,)
    yield from convolution(f"{where}/conv2", (3, 3, 3), outside, outside)
    if inside != outside:
        yield from linear_leaves(f"{where}/shortcut", inside, outside)


def middle_leaves(where: str, width: int) -> Iterator[Leaf]:
    """Yield the leaves of the bottom: two residual blocks around an attention."""
    yield from resnet_leaves(f"{where}/resnet_0", width, width)
    yield f"{where}/attend_0/norm/scale", (width,)
    yield from linear_leaves(f"{where}/attend_0/to_qkv", width, 3 * width)
    yield from linear_leaves(f"{where}/attend_0/to_out", width, width)
    yield from resnet_leaves(f"{where}/resnet_1", width, width)
