"""Settings of Wan's video autoencoder, which Cosmos-Predict2 uses; defaults: as published."""

from __future__ import annotations

import dataclasses
from typing import Literal

from pewm_jax.errors import require, require_positive

MEAN_16 = (
    *(-0.7571, -0.7089, -0.9113, 0.1075, -0.1745, 0.9653, -0.1517, 1.5508),
    *(0.4134, -0.0715, 0.5517, -0.3632, -0.1922, -0.9497, 0.2503, -0.2921),
)
STD_16 = (
    *(2.8184, 1.4541, 2.3275, 2.6558, 1.2196, 1.7708, 2.6052, 2.0743),
    *(3.2687, 2.1526, 2.8652, 1.5579, 1.6382, 1.1253, 2.8251, 1.9160),
)


@dataclasses.dataclass(frozen=True)
class WanVAEConfig:
    """Wan 2.1's video autoencoder (arXiv 2503.20314): causal, four frames to a latent."""

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
    ``wan_vae.normalise`` and ``wan_vae.restore`` do."""
    convolution: Literal["auto", "taps", "volume", "winograd"] = "auto"
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
