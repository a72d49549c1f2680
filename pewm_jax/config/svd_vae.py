"""The settings of Stable Video Diffusion's autoencoder; the defaults are the published sizes."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from pewm_jax.config.parts import Codec
from pewm_jax.config.svd_unet import GROUPS
from pewm_jax.errors import require, require_positive


@dataclasses.dataclass(frozen=True)
class SVDVAEConfig(Codec):
    """An image encoder and a decoder over space and time (arXiv 2311.15127, appendix D)."""

    DEPTH_AS_GREY: ClassVar[bool] = True
    CONVERTED: ClassVar[bool] = True

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

    @property
    def framewise(self) -> bool:
        """Whether a latent frame is decoded by itself: no, with its neighbours."""
        return False

    @property
    def rgb_channels(self) -> int:
        """Latent channels of colour."""
        return self.latent_channels

    @property
    def depth_channels(self) -> int:
        """Latent channels of depth."""
        return self.latent_channels * self.depth

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
