"""The learned codec: a small image autoencoder of our own, frame by frame."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from pewm_jax.config.parts import Codec
from pewm_jax.errors import require, require_positive


@dataclasses.dataclass(frozen=True)
class LearnedCodecConfig(Codec):
    """8 × 8 pixels of one frame to a few channels; trained by the world `codec`.

    Depth is seen as a grey picture by the same weights. A model that has this codec starts from
    trained weights: `--train.start runs/codec --train.fresh 'memory/.*' 'backbone/.*' 'control/.*'`
    takes the codec of that run and begins all else at random.
    """

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
