"""Settings of Stable Video Diffusion's networks; the defaults are the published sizes."""

from __future__ import annotations

import dataclasses

from pewm_jax.errors import require, require_positive
from pewm_jax.models.clip.config import CLIPVisionConfig

GROUPS = 32
"""Groups of every group norm in the reference."""


@dataclasses.dataclass(frozen=True)
class SVDUNetConfig:
    """A U-Net over space and time in the form of Stable Video Diffusion (arXiv 2311.15127).

    As a backbone it takes any number of channels: those that codec and control have. It has no
    place where a memory could be read.
    """

    in_channels: int = 8
    """Channels of the input: noisy latents and the latents of the image, joined. A world model
    takes its own number."""
    out_channels: int = 4
    """Channels of the prediction. A world model takes its own number."""
    widths: tuple[int, ...] = (320, 640, 1280, 1280)
    """Channels of each level; each level but the last halves height and width."""
    heads: tuple[int, ...] = (5, 10, 20, 20)
    """Attention heads of each level; the bottom has those of the last level."""
    attends: tuple[bool, ...] = (True, True, True, False)
    """Whether a level has attention; the bottom always has."""
    resnets: tuple[int, ...] = (2, 2, 2, 2)
    """Residual blocks of each level on the way down; one more on the way up."""
    layers: tuple[int, ...] = (1, 1, 1, 1)
    """Transformer layers per attention of each level; the bottom has those of the last level."""
    image_dim: int = 1024
    """Channels of the image embedding."""
    added: int = 3
    """Scalars besides the noise level: frames per second, motion bucket, noise of the image."""
    added_dim: int = 256
    """Channels of the sinusoid of each of these scalars; even."""
    image: CLIPVisionConfig = CLIPVisionConfig()
    """The encoder of the image that is attended to; frozen. Its embedding has `image_dim`
    channels."""
    fps: float = 7.0
    """Frames per second in the network's conditioning."""
    motion_bucket: float = 127.0
    """The amount of motion in the network's conditioning."""
    remat: bool = False
    """Recompute the activations of each residual block and attention in the backward pass: less
    memory, more work."""

    @property
    def time_dim(self) -> int:
        """Channels of the time embedding, to which a modulation is added."""
        return 4 * self.widths[0]

    def __post_init__(self):
        """Validate."""
        require(
            len(self.widths) > 0, "backbone.widths is empty: name at least one level's channels."
        )
        require_positive(self, "backbone", "in_channels", "out_channels", "image_dim", "added")
        for name in ("heads", "attends", "resnets", "layers"):
            values = getattr(self, name)
            require(
                len(values) == len(self.widths),
                f"backbone.{name} names {len(values)} levels and backbone.widths "
                f"{len(self.widths)}: name one value per level.",
            )
            require(
                name == "attends" or min(values) >= 1,
                f"backbone.{name} holds {min(values)}: use at least 1.",
            )
        for width, heads in zip(self.widths, self.heads, strict=True):
            require(
                width >= 1 and width % GROUPS == 0 and width % heads == 0,
                f"backbone.widths holds {width}, which is not a multiple of {GROUPS} groups and of "
                f"the level's {heads} heads.",
            )
        require(
            self.added_dim >= 2 and self.added_dim % 2 == 0,
            f"backbone.added_dim is {self.added_dim}: use an even number.",
        )
        require(self.fps > 0, f"backbone.fps is {self.fps}: use a number above 0.")


@dataclasses.dataclass(frozen=True)
class SVDVAEConfig:
    """An image encoder and a decoder over space and time (arXiv 2311.15127, appendix D)."""

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
