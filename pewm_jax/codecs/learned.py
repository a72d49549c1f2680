"""The learned codec: a small convolutional autoencoder of single frames, 8 × 8 pixels per cell.

Space-to-depth moves 4 × 4 pixels into the channels. Residual blocks of 3 × 3 convolutions follow at
a quarter and at an eighth of the resolution; the decoder is the mirror image. A linear map from a
cell's pixels to its latents, and one back, run in parallel: they learn the principal components,
and the networks learn the rest. Nothing is normalised over space, so frames of any size and number
are encoded alike. Latents have mean 0 and variance 1 per channel once ``latent_mean_C`` and
``latent_scale_C`` are fitted (``worlds.codec``).
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.codecs import gates
from pewm_jax.codecs.gates import (
    depth_to_space,
    residual_block,
    space_to_depth,
)
from pewm_jax.config.parts import Codec, Rules
from pewm_jax.errors import UserError, require, require_positive
from pewm_jax.nn.convolution import convolve_layer
from pewm_jax.types import Array, Params

PATCH = 4
"""Pixels, along each axis, that are first moved into the channels."""
COLOURS = 3
GATE = 65535
"""Number that is folded into the key of the gate's parameters."""


_STATISTICS = ("latent_mean_C", "latent_scale_C")


@dataclasses.dataclass(frozen=True)
class LearnedCodecConfig(Codec):
    """8 × 8 pixels of one frame to a few channels; trained by the world `codec`.

    Depth is encoded as a grey image by the same weights. A model with this codec starts from
    trained weights: `--train.start runs/codec --train.fresh 'memory/.*' 'backbone/.*' 'control/.*'`
    takes the codec of that run and initializes all other parameters at random.
    """

    SHARDING: ClassVar[Rules] = (
        (r"codec/.*/kernel", P(None, "fsdp")),
        (r"codec/.*/bias", P()),
        (r"codec/latent_(mean|scale)_C", P()),
    )
    """Weights are gathered for computation; each device has its own frames."""
    DEPTH_AS_GREY: ClassVar[bool] = True
    CONVERTED: ClassVar[bool] = True
    WEIGHTS_FROM: ClassVar[str] = "train it (pewm-jax train codec)"
    spatial: ClassVar[int] = 8
    temporal: ClassVar[int] = 1

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
    """Channels of the gate, which blends decoded frames with the rendered memory (such as 48); 0
    for no gate."""

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
            **gates.init_convolutions(self.layout(), key, zero=("two",)),
        }
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
        """Blend decoded and rendered frames (N, H, W, 4) by the gate; see ``gates.apply``."""
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
        x = convolve_layer(weights["into"], space_to_depth(pixels, PATCH))
        x = _blocks(weights, "fine", self.fine_blocks, x)
        x = convolve_layer(weights["down"], space_to_depth(x, 2))
        x = _blocks(weights, "coarse", self.coarse_blocks, x)
        x = convolve_layer(weights["out"], jax.nn.silu(x))
        x = x + convolve_layer(weights["direct"], space_to_depth(pixels, cell))
        return x.reshape(*lead, *x.shape[1:])

    def decode_raw(self, params: Params, latents_BthwC: Array) -> Array:
        """Decode latents that are not normalised; see ``decode``."""
        weights, lead = params["decoder"], latents_BthwC.shape[:-3]
        latents = latents_BthwC.reshape(-1, *latents_BthwC.shape[-3:])
        x = convolve_layer(weights["into"], latents)
        x = _blocks(weights, "coarse", self.coarse_blocks, x)
        x = depth_to_space(convolve_layer(weights["up"], x), 2)
        x = _blocks(weights, "fine", self.fine_blocks, x)
        x = depth_to_space(convolve_layer(weights["out"], jax.nn.silu(x)), PATCH)
        x = x + depth_to_space(convolve_layer(weights["direct"], latents), self.spatial)
        return x.reshape(*lead, *x.shape[1:])

    def layout(self) -> gates.Layout:
        """Return the layout of every convolution."""
        a, b, c, pixels = self.fine, self.coarse, self.latent_channels, COLOURS * PATCH**2

        def blocks(where: str, name: str, count: int, width: int) -> gates.Layout:
            return {
                f"{where}/{name}_{i}/{part}": (3, width, width)
                for i in range(count)
                for part in ("one", "two")
            }

        return {
            "encoder/direct": (1, COLOURS * self.spatial**2, c),
            "decoder/direct": (1, c, COLOURS * self.spatial**2),
            "encoder/into": (3, pixels, a),
            **blocks("encoder", "fine", self.fine_blocks, a),
            "encoder/down": (1, 4 * a, b),
            **blocks("encoder", "coarse", self.coarse_blocks, b),
            "encoder/out": (3, b, c),
            "decoder/into": (3, c, b),
            **blocks("decoder", "coarse", self.coarse_blocks, b),
            "decoder/up": (1, b, 4 * a),
            **blocks("decoder", "fine", self.fine_blocks, a),
            "decoder/out": (3, a, pixels),
        }


def _blocks(weights: Params, name: str, count: int, x_NHWC: Array) -> Array:
    """Apply the residual blocks of a name, one after the other."""
    for i in range(count):
        x_NHWC = residual_block(weights[f"{name}_{i}"], x_NHWC)
    return x_NHWC
