"""The learned codec: a small convolutional autoencoder, frame by frame, 8 × 8 pixels to a cell.

Space-to-depth brings 4 × 4 pixels into the channels; residual blocks of 3 × 3 convolutions work at
a quarter and at an eighth of the resolution; the decoder is the mirror image. Beside them a linear
map leads straight from a cell's pixels to its latents, and one back: by itself it soon finds the
principal components, and the networks learn what these leave. Nothing is normalised over space, so
frames of any size and number are encoded alike. Latents leave with mean 0 and
variance 1 per channel, once ``latent_mean_C`` and ``latent_scale_C`` are fitted (``worlds.codec``).
"""

from __future__ import annotations

import dataclasses
import math
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.codecs import gates
from pewm_jax.config.parts import Codec, Rules
from pewm_jax.errors import UserError, require, require_positive
from pewm_jax.nn.convolution import convolve
from pewm_jax.types import Array, Params

PATCH = 4
"""Pixels, each way, that are brought into the channels at first."""
COLOURS = 3
GATE = 65535
"""Folded into the key of the gate's parameters."""


_STATISTICS = ("latent_mean_C", "latent_scale_C")


@dataclasses.dataclass(frozen=True)
class LearnedCodecConfig(Codec):
    """8 × 8 pixels of one frame to a few channels; trained by the world `codec`.

    Depth is seen as a grey picture by the same weights. A model that has this codec starts from
    trained weights: `--train.start runs/codec --train.fresh 'memory/.*' 'backbone/.*' 'control/.*'`
    takes the codec of that run and begins all else at random.
    """

    SHARDING: ClassVar[Rules] = (
        (r"codec/.*/kernel", P(None, "fsdp")),
        (r"codec/.*/bias", P()),
        (r"codec/latent_(mean|scale)_C", P()),
    )
    """Gathered when it computes, each device its own frames."""
    DEPTH_AS_GREY: ClassVar[bool] = True
    CONVERTED: ClassVar[bool] = True
    WEIGHTS_FROM: ClassVar[str] = "train it (pewm-jax train codec)"

    latent_channels: int = 16
    """Latent channels of colour, and as many of depth."""
    fine: int = 64
    """Channels at a quarter of the resolution."""
    coarse: int = 96
    """Channels at an eighth of the resolution."""
    fine_blocks: int = 2
    """Residual blocks of two 3 × 3 convolutions at a quarter of the resolution, in the encoder and
    as many in the decoder."""
    coarse_blocks: int = 4
    """Residual blocks at an eighth of the resolution, in the encoder and as many in the decoder."""
    gate: int = 0
    """Channels of the gate, which mixes decoded frames with the rendered memory (48, say); 0 for no
    gate."""

    @property
    def spatial(self) -> int:
        """Pixels per latent cell, each way."""
        return 8

    @property
    def temporal(self) -> int:
        """Frames per latent frame after the first: every frame is encoded by itself."""
        return 1

    @property
    def rgb_channels(self) -> int:
        """Latent channels of colour."""
        return self.latent_channels

    @property
    def depth_channels(self) -> int:
        """Latent channels of depth."""
        return self.latent_channels

    def __post_init__(self):
        """Validate."""
        sizes = ("latent_channels", "fine", "coarse", "fine_blocks", "coarse_blocks")
        require_positive(self, "codec", *sizes)
        require(self.gate >= 0, f"codec.gate is {self.gate}: use 0 (no gate) or more channels.")

    def init(self, key: Array) -> Params:
        """Return random parameters; residual blocks change nothing at first."""
        params: Params = {
            "latent_mean_C": jnp.zeros((self.latent_channels,)),
            "latent_scale_C": jnp.ones((self.latent_channels,)),
        }
        for number, (path, ((side, width, out), _)) in enumerate(self.layout().items()):
            *folders, name = path.split("/")
            node = params
            for folder in folders:
                node = node.setdefault(folder, {})
            drawn = jax.random.normal(jax.random.fold_in(key, number), (side, side, width, out))
            gain = 0.0 if name == "two" else 1 / math.sqrt(side * side * width)
            node[name] = {"kernel": gain * drawn, "bias": jnp.zeros((out,))}
        if self.gate:
            params["gate"] = gates.init(self.gate, jax.random.fold_in(key, GATE))
        return params

    def encode(self, params: Params, video_BTHWC: Array, *, condition: bool = False) -> Array:
        """Encode a video (B, T, H, W, 3) to normalised latents (B, T, H/8, W/8, C).

        Raises:
            UserError: another number of colours, or a size that is no multiple of 8 pixels.
        """
        del condition
        latents = self.encode_raw(params, video_BTHWC)
        mean, scale = (params[name].astype(latents.dtype) for name in _STATISTICS)
        return (latents - mean) / scale

    def decode(self, params: Params, latents_BthwC: Array) -> Array:
        """Decode normalised latents to a video (B, T, H, W, 3), roughly in [−1, 1]."""
        mean, scale = (params[name].astype(latents_BthwC.dtype) for name in _STATISTICS)
        return self.decode_raw(params, latents_BthwC * scale + mean)

    def mix(
        self, params: Params, decoded_NHWC: Array, rendered_NHWC: Array, seen_NHW: Array
    ) -> Array:
        """Mix decoded and rendered pictures (N, H, W, 4) by the gate; see ``gates.apply``."""
        return gates.apply(params["gate"], decoded_NHWC, rendered_NHWC, seen_NHW)

    def encode_raw(self, params: Params, video_BTHWC: Array) -> Array:
        """Encode to latents that are not normalised; see ``encode``."""
        *lead, height, width, colours = video_BTHWC.shape
        cell = self.spatial
        if colours != COLOURS or height % cell or width % cell:
            raise UserError(
                f"a video of {height}×{width} pixels and {colours} colours cannot be encoded: the "
                f"learned codec needs multiples of {cell} pixels and {COLOURS} colours (depth "
                "repeated three times)."
            )
        weights = params["encoder"]
        pixels = video_BTHWC.reshape(-1, height, width, colours)
        x = _convolve(weights["into"], _gather(pixels, PATCH))
        x = _blocks(weights, "fine", self.fine_blocks, x)
        x = _convolve(weights["down"], _gather(x, 2))
        x = _blocks(weights, "coarse", self.coarse_blocks, x)
        x = _convolve(weights["out"], jax.nn.silu(x))
        x = x + _convolve(weights["direct"], _gather(pixels, cell))
        return x.reshape(*lead, *x.shape[1:])

    def decode_raw(self, params: Params, latents_BthwC: Array) -> Array:
        """Decode latents that are not normalised; see ``decode``."""
        weights, lead = params["decoder"], latents_BthwC.shape[:-3]
        latents = latents_BthwC.reshape(-1, *latents_BthwC.shape[-3:])
        x = _convolve(weights["into"], latents)
        x = _blocks(weights, "coarse", self.coarse_blocks, x)
        x = _spread(_convolve(weights["up"], x), 2)
        x = _blocks(weights, "fine", self.fine_blocks, x)
        x = _spread(_convolve(weights["out"], jax.nn.silu(x)), PATCH)
        x = x + _spread(_convolve(weights["direct"], latents), self.spatial)
        return x.reshape(*lead, *x.shape[1:])

    def layout(self) -> dict[str, tuple[tuple[int, int, int], int]]:
        """Return every convolution by path: (side, channels in, channels out), pixels per cell."""
        a, b, c, pixels = self.fine, self.coarse, self.latent_channels, COLOURS * PATCH**2

        def blocks(where: str, name: str, count: int, width: int, cell: int) -> dict:
            return {
                f"{where}/{name}_{i}/{part}": ((3, width, width), cell)
                for i in range(count)
                for part in ("one", "two")
            }

        cell = 2 * PATCH
        return {
            "encoder/direct": ((1, COLOURS * cell**2, c), cell),
            "decoder/direct": ((1, c, COLOURS * cell**2), cell),
            "encoder/into": ((3, pixels, a), PATCH),
            **blocks("encoder", "fine", self.fine_blocks, a, PATCH),
            "encoder/down": ((1, 4 * a, b), cell),
            **blocks("encoder", "coarse", self.coarse_blocks, b, cell),
            "encoder/out": ((3, b, c), cell),
            "decoder/into": ((3, c, b), cell),
            **blocks("decoder", "coarse", self.coarse_blocks, b, cell),
            "decoder/up": ((1, b, 4 * a), cell),
            **blocks("decoder", "fine", self.fine_blocks, a, PATCH),
            "decoder/out": ((3, a, pixels), PATCH),
        }


def with_statistics(params: Params, mean_C: Array, scale_C: Array) -> Params:
    """Return the codec's parameters with the mean and the standard deviation of its latents."""
    return {**params, "latent_mean_C": mean_C, "latent_scale_C": scale_C}


def _blocks(weights: Params, name: str, count: int, x_NHWC: Array) -> Array:
    for i in range(count):
        block = weights[f"{name}_{i}"]
        inner = _convolve(block["one"], jax.nn.silu(x_NHWC))
        x_NHWC = x_NHWC + _convolve(block["two"], jax.nn.silu(inner))
    return x_NHWC


def _convolve(weights: Params, x_NHWC: Array) -> Array:
    """Convolve, with zeros around the frame."""
    kernel, bias = (weights[name].astype(x_NHWC.dtype) for name in ("kernel", "bias"))
    if kernel.shape[0] == 1:
        return x_NHWC @ kernel[0, 0] + bias
    return convolve(x_NHWC, kernel) + bias


def _gather(x_NHWC: Array, s: int) -> Array:
    """Bring s × s cells into the channels of one."""
    n, height, width, c = x_NHWC.shape
    x = x_NHWC.reshape(n, height // s, s, width // s, s, c).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(n, height // s, width // s, s * s * c)


def _spread(x_NHWC: Array, s: int) -> Array:
    """Invert ``_gather``."""
    n, h, w, c = x_NHWC.shape
    x = x_NHWC.reshape(n, h, w, s, s, c // (s * s)).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(n, h * s, w * s, c // (s * s))
