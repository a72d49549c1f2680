"""Settings of CogVideoX's two networks, the transformer and the video autoencoder."""

from __future__ import annotations

import dataclasses
from typing import Literal, Self

from pewm_jax.errors import ConfigError, require, require_positive

Positions = Literal["rope_integer", "rope_crop", "rope_learned", "sincos"]
"""How positions are encoded; see ``DiTConfig.positions``."""
Learned = Literal["exact", "interpolate", "drop", "reference"]
"""How a learned table is used for other sizes; see ``DiTConfig.learned``."""
PUBLISHED = ("2b", "5b", "5b-I2V", "1.5-5B", "1.5-5B-I2V")
"""The published CogVideoX networks, as ``published`` names them."""


@dataclasses.dataclass(frozen=True)
class DiTConfig:
    """A diffusion transformer in CogVideoX's form; see ``published`` for CogVideoX's settings."""

    layers: int = 4
    """Transformer blocks."""
    heads: int = 6
    """Attention heads."""
    head_dim: int = 32
    """Width of a head; a multiple of 16 (the rotary embedding splits it 1/4, 3/8, 3/8). With
    positions `sincos`, heads × head_dim must be a multiple of 16 instead."""
    patch: int = 2
    """Latent cells per token, along height and along width."""
    patch_t: int = 1
    """Latent frames per token: 2 in CogVideoX 1.5, else 1."""
    in_channels: int = 0
    """Input channels; 0 takes the number from codec and conditioning."""
    out_channels: int = 0
    """Output channels; 0 takes the number from the codec."""
    text_length: int = 4
    """Number of text tokens; without a prompt they are zeros, so the text path is a constant."""
    text_dim: int = 32
    """Channels of a text token."""
    prompt: Literal["zeros", "stored"] = "zeros"
    """Which text tokens: `zeros`, or a prompt's embedding that is `stored` with the weights."""
    time_dim: int = 192
    """Width of the time embedding."""
    ofs_dim: int = 0
    """Width of the second scalar's embedding (1.5-5B-I2V: 512, equal to time_dim); 0 for none."""
    mlp_ratio: int = 4
    """Feed-forward width over model width."""
    positions: Positions = "rope_integer"
    """`rope_integer`: rotary, positions 0, 1, 2 … (CogVideoX 1.5). `rope_crop`: rotary, with the
    token grid stretched to the sample size's (5b). `rope_learned`: the same and a learned table for
    the sample size (5b-I2V); see `learned`. `sincos`: a fixed sinusoid added to the tokens (2b)."""
    learned: Learned = "exact"
    """How the table of `rope_learned` is used for sizes other than the sample's. `exact`: other
    sizes are refused. `interpolate`: the table is resized linearly in time, rows and columns.
    `drop`: the table is not used at any size, only the rotary embedding. `reference`: as in
    diffusers, other numbers of frames get a fixed sinusoid instead, and other heights or widths are
    refused."""
    sample_height: int = 0
    """Latent rows that the network was trained for; 0 if positions do not depend on it. With
    rope_integer, a value above 0 is an upper bound."""
    sample_width: int = 0
    """Latent columns that the network was trained for; as sample_height."""
    sample_frames: int = 0
    """Video frames (not latent frames) that the network was trained for; used by rope_learned."""
    temporal: int = 4
    """Video frames per latent frame after the first; converts sample_frames to latent frames."""
    spatial_interpolation: float = 1.875
    """Divisor of row and column positions in `sincos`."""
    temporal_interpolation: float = 1.0
    """Divisor of time positions in `sincos`."""
    attention: Literal["auto", "xla", "cudnn", "splash", "ring"] = "auto"
    """The attention kernel: `cudnn` is flash attention on NVIDIA GPUs in 16 bits, `splash` is flash
    attention on TPUs, `xla` runs anywhere, `auto` uses the best kernel of the hardware. `ring`
    splits keys and values over `train.mesh.context`, too, for very long clips."""
    remat: bool = False
    """Recompute activations in the backward pass: less memory, about a third more time."""

    @property
    def width(self) -> int:
        """Model width D."""
        return self.heads * self.head_dim

    @property
    def sample_latents(self) -> int:
        """Number of latent frames of ``sample_frames`` video frames."""
        return (self.sample_frames - 1) // self.temporal + 1

    def __post_init__(self):
        """Validate."""
        require_positive(self, "backbone", "layers", "heads", "head_dim", "patch", "patch_t")
        require_positive(self, "backbone", "text_length", "text_dim", "time_dim", "mlp_ratio")
        require_positive(self, "backbone", "temporal")
        for name in ("in_channels", "out_channels", "ofs_dim"):
            value = getattr(self, name)
            require(value >= 0, f"backbone.{name} is {value}: use 0 or more.")
        rotary = self.positions != "sincos"
        require(
            not rotary or self.head_dim % 16 == 0,
            f"backbone.head_dim is {self.head_dim}: use a multiple of 16 (16, 32, 48, 64), the "
            "rotary embedding splits a head into time, height and width parts.",
        )
        require(
            self.width % 16 == 0,
            f"backbone.heads × head_dim is {self.width}: use a multiple of 16, the sinusoid of "
            "positions splits it into time, height and width parts.",
        )
        require(
            self.ofs_dim in (0, self.time_dim),
            f"backbone.ofs_dim is {self.ofs_dim}: its embedding is added to the time embedding, so "
            f"use backbone.time_dim ({self.time_dim}), or 0 for none.",
        )
        for name in ("spatial_interpolation", "temporal_interpolation"):
            value = getattr(self, name)
            require(value > 0, f"backbone.{name} is {value}: use a number above 0.")
        self._require_sample()

    def _require_sample(self) -> None:
        """Validate the sizes that some kinds of positions need."""
        needed = {"rope_crop": 2, "rope_learned": 3}.get(self.positions, 0)
        names = ("sample_height", "sample_width", "sample_frames")
        for index, name in enumerate(names):
            value = getattr(self, name)
            require(value >= 0, f"backbone.{name} is {value}: use 0 or more.")
            require(
                index >= needed or value > 0,
                f"backbone.{name} is 0: positions {self.positions} need the size that the network "
                "was trained for (CogVideoX: 60 × 90 latents of 49 frames).",
            )
        learned = self.positions == "rope_learned"
        require(
            learned or self.learned == "exact",
            f"backbone.learned is {self.learned}: only positions rope_learned have a table that "
            "is learned; leave it at exact.",
        )
        require(
            not learned or (self.sample_height % self.patch == self.sample_width % self.patch == 0),
            f"backbone.sample_height × sample_width {self.sample_height}×{self.sample_width}: "
            f"learned positions need multiples of backbone.patch ({self.patch}).",
        )
        require(
            self.patch_t == 1 or self.positions == "rope_integer",
            f"backbone.patch_t is {self.patch_t}: more than 1 goes with positions rope_integer "
            f"(CogVideoX 1.5), not with {self.positions}.",
        )

    @classmethod
    def published(cls, name: str) -> Self:
        """Return the configuration of a published CogVideoX network, one of ``PUBLISHED``.

        Raises:
            ConfigError: there is no such network.
        """
        common = cls(
            layers=42,
            heads=48,
            head_dim=64,
            in_channels=16,
            out_channels=16,
            text_length=226,
            text_dim=4096,
            time_dim=512,
            positions="rope_crop",
            sample_height=60,
            sample_width=90,
            sample_frames=49,
        )
        newer = {
            "patch_t": 2,
            "text_length": 224,
            "positions": "rope_integer",
            "sample_height": 300,
            "sample_width": 300,
            "sample_frames": 81,
        }
        differences = {
            "2b": {"layers": 30, "heads": 30, "positions": "sincos"},
            "5b": {},
            "5b-I2V": {"in_channels": 32, "positions": "rope_learned"},
            "1.5-5B": newer,
            "1.5-5B-I2V": {**newer, "in_channels": 32, "ofs_dim": 512},
        }
        if name not in differences:
            raise ConfigError(
                f"There is no CogVideoX {name!r}; choose one of {', '.join(PUBLISHED)}."
            )
        return dataclasses.replace(common, **differences[name])


@dataclasses.dataclass(frozen=True)
class VAEConfig:
    """The video autoencoder in CogVideoX's form: causal 3D convolutions, encoded in chunks.

    The defaults are the published sizes; ``VAEConfig.published`` returns the variants. Weights come
    from a converted checkpoint.
    """

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
    convolution: Literal["auto", "frames", "stacked", "taps", "volume", "winograd"] = "auto"
    """`volume`: 3D convolutions; `stacked`: 2D convolutions of three frames at once; `frames`: the
    same, one frame after the other, with the least memory; `taps`: sums of 2D convolutions, faster
    on XLA's CPU backend; `winograd`: half as many 2D convolutions; `auto`: on a CPU `winograd` in
    float32 and `taps` in 16 bits, on TPUs `frames` to decode and `stacked` to encode several
    videos, elsewhere `volume`."""

    @property
    def spatial(self) -> int:
        """Pixels per latent cell, along height and along width."""
        return 2 ** (len(self.widths) - 1)

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
    def published(cls, variant: str) -> Self:
        """Return the autoencoder of a published CogVideoX, one of ``PUBLISHED``.

        Raises:
            ConfigError: another name.
        """
        if variant not in PUBLISHED:
            raise ConfigError(
                f"no CogVideoX is called {variant!r}; choose one of {', '.join(PUBLISHED)}."
            )
        scale = 1.15258426 if variant == "2b" else 0.7
        return cls(scaling_factor=scale, invert_scale_latents=variant == "1.5-5B-I2V")
