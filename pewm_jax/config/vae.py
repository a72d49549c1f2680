"""The video autoencoder's settings, and CogVideoX's published ones."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Literal

from pewm_jax.config.parts import Codec
from pewm_jax.errors import ConfigError, require, require_positive


@dataclasses.dataclass(frozen=True)
class VAEConfig(Codec):
    """The video autoencoder in CogVideoX's form: causal 3D convolutions, encoded in chunks.

    The defaults are the published sizes; ``VAEConfig.published`` returns the variants. Weights come
    from a converted checkpoint.
    """

    DEPTH_AS_GREY: ClassVar[bool] = True
    CONVERTED: ClassVar[bool] = True

    in_channels: int = 3
    """Channels of an input frame."""
    out_channels: int = 3
    """Channels of an output frame."""
    latent_channels: int = 16
    """Channels of a latent."""
    widths: tuple[int, ...] = (128, 256, 256, 512)
    """Channels of each level of the encoder, in order; each level but the last halves height and
    width."""
    resnets: int = 3
    """Residual blocks per level of the encoder; the decoder has one more."""
    groups: int = 32
    """Groups of the group norms; divides every width."""
    eps: float = 1e-6
    """Added to the variance in the encoder's residual blocks."""
    temporal: int = 4
    """Frames per latent: 1, 2, 4 or 8."""
    sample_height: int = 480
    """Height that the weights were trained for; half of it is the height of a tile."""
    sample_width: int = 720
    """Width that the weights were trained for; half of it is the width of a tile."""
    scaling_factor: float = 1.15258426
    """Factor that gives latents unit variance for the diffusion model. The codec applies it;
    ``vae.encode`` and ``vae.decode`` do not."""
    invert_scale_latents: bool = False
    """Whether the latents of a conditioning image are divided by the factor instead of multiplied,
    as in the published 1.5-5B-I2V."""
    tiling: bool = False
    """Process frames larger than a tile in overlapping tiles: less memory, and a slightly different
    result."""
    tile_height: int = 0
    """Height of a tile in pixels; 0 is half of ``sample_height``."""
    tile_width: int = 0
    """Width of a tile in pixels; 0 is half of ``sample_width``."""
    tile_overlap_height: float = 1 / 6
    """Share of a tile's height that overlaps with the next tile."""
    tile_overlap_width: float = 1 / 5
    """Share of a tile's width that overlaps with the next tile."""
    convolution: Literal["auto", "taps", "volume", "winograd"] = "auto"
    """`volume`: 3D convolutions; `taps`: the same as sums of 2D convolutions, faster on XLA's CPU
    backend; `winograd`: half as many 2D convolutions; `auto`: on a CPU `winograd` in float32 and
    `taps` in 16 bits, elsewhere `volume`."""

    @property
    def spatial(self) -> int:
        """Pixels per latent cell, along height and along width."""
        return 2 ** (len(self.widths) - 1)

    @property
    def rgb_channels(self) -> int:
        """Latent channels of colour."""
        return self.latent_channels

    @property
    def depth_channels(self) -> int:
        """Latent channels of depth, which is encoded as a grey image."""
        return self.latent_channels

    def check(self, model: Any) -> None:
        """Refuse clips that cannot be encoded, or decode to another number of frames."""
        super().check(model)
        require(
            self.frames(model.clip.frames) % 2 == 1,
            f"clip.frames {model.clip.frames}: the VAE decodes an even number of latent frames "
            "without its first-frame rule (2 latent frames become 8 frames, not 5); use 8k + 1 "
            "frames (9, 17, 25, …).",
        )

    @property
    def tile_pixels(self) -> tuple[int, int]:
        """Height and width of a tile in pixels."""
        return (
            self.tile_height or self.sample_height // 2,
            self.tile_width or self.sample_width // 2,
        )

    def __post_init__(self):
        """Validate."""
        require(len(self.widths) > 0, "codec.widths is empty: name at least one level's channels.")
        sizes = ("in_channels", "out_channels", "latent_channels", "resnets", "groups")
        require_positive(self, "codec", *sizes, "sample_height", "sample_width")
        for width in self.widths:
            require(
                width >= 1 and width % self.groups == 0,
                f"codec.widths holds {width}, which codec.groups {self.groups} does not divide: "
                "use multiples of the groups.",
            )
        require(self.eps > 0, f"codec.eps is {self.eps}: use a small positive number, as 1e-6.")
        require(
            self.temporal in {1, 2, 4, 8},
            f"codec.temporal is {self.temporal}: use 1, 2, 4 or 8 (published weights have 4).",
        )
        require(
            self.temporal <= self.spatial,
            f"codec.temporal {self.temporal} needs as many halvings as codec.widths has steps "
            f"between levels ({len(self.widths) - 1}): add levels or lower codec.temporal.",
        )
        require(
            self.scaling_factor > 0,
            f"codec.scaling_factor is {self.scaling_factor}: use the checkpoint's positive factor "
            "(1.15258426 for 2b, 0.7 for the others).",
        )
        self._validate_tiles()

    def _validate_tiles(self):
        """Refuse tiles that hold no latent, or that never advance."""
        shares = (self.tile_overlap_height, self.tile_overlap_width)
        for name, pixels, share in zip(("height", "width"), self.tile_pixels, shares, strict=True):
            require(
                0 <= share < 1,
                f"codec.tile_overlap_{name} is {share}: use a share of the tile from 0 to below 1.",
            )
            require(
                not self.tiling or int(pixels // self.spatial * (1 - share)) >= 1,
                f"tiles of {pixels} pixels with codec.tile_overlap_{name} {share:.3g} advance by "
                f"no latent: use a larger codec.tile_{name} or less overlap.",
            )

    @classmethod
    def published(cls, variant: str) -> VAEConfig:
        """Return the autoencoder of a published CogVideoX.

        Args:
            variant: ``2b``, ``5b``, ``5b-I2V``, ``1.5-5B`` or ``1.5-5B-I2V``.

        Raises:
            ConfigError: another name.
        """
        if variant not in _SCALES:
            raise ConfigError(
                f"no CogVideoX is called {variant!r}; choose one of {', '.join(_SCALES)}."
            )
        scale, inverted = _SCALES[variant]
        return cls(scaling_factor=scale, invert_scale_latents=inverted)


_SCALES = {
    "2b": (1.15258426, False),
    "5b": (0.7, False),
    "5b-I2V": (0.7, False),
    "1.5-5B": (0.7, False),
    "1.5-5B-I2V": (0.7, True),
}
"""Variant → scaling factor, and whether images are divided by it."""
