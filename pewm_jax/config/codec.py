"""Codecs: how pixels become latents and back."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from pewm_jax.config.parts import Codec
from pewm_jax.errors import require_positive


@dataclasses.dataclass(frozen=True)
class PixelConfig(Codec):
    """Space-to-depth and temporal fold: no parameters, exactly invertible."""

    PIXELWISE: ClassVar[bool] = True

    spatial: int = 4
    """Pixels per latent cell, along height and along width."""
    temporal: int = 4
    """Frames per latent frame after the first."""

    @property
    def rgb_channels(self) -> int:
        """Latent channels of colour."""
        return 3 * self.depth_channels

    @property
    def depth_channels(self) -> int:
        """Latent channels of depth."""
        return self.temporal * self.spatial**2

    def __post_init__(self):
        """Validate."""
        require_positive(self, "codec", "spatial", "temporal")
