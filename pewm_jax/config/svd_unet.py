"""The settings of Stable Video Diffusion's U-Net; the defaults are the published sizes."""

from __future__ import annotations

import dataclasses
from typing import Any

from pewm_jax.config.clip_vision import CLIPVisionConfig
from pewm_jax.config.parts import Backbone
from pewm_jax.errors import require, require_positive

GROUPS = 32
"""Groups of every group norm in the reference."""


@dataclasses.dataclass(frozen=True)
class SVDUNetConfig(Backbone):
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
    """Scalars beside the noise level: frames per second, motion bucket, noise of the image."""
    added_dim: int = 256
    """Channels of the sinusoid of each of these scalars; even."""
    image: CLIPVisionConfig = CLIPVisionConfig()
    """The encoder of the image that is attended to; frozen. Its embedding has `image_dim`
    channels."""
    fps: float = 7.0
    """Frames per second that the network is told."""
    motion_bucket: float = 127.0
    """How much motion the network is told that there is."""
    remat: bool = False
    """Recompute the activations of each residual block and attention in the backward pass: less
    memory, more work."""

    def check(self, model: Any) -> None:
        """Refuse a model around it that gives it what it cannot take; any size will do."""
        require(
            self.added == 3,
            f"backbone.added is {self.added}: a world model gives three scalars, frames per "
            "second, motion bucket and the noise of the image; use 3.",
        )
        require(
            self.image.projection == self.image_dim,
            f"backbone.image.projection is {self.image.projection} and backbone.image_dim is "
            f"{self.image_dim}: the image's embedding is attended to, so use the same.",
        )
        require(
            not model.noise.per_frame,
            "noise.per_frame is true, and this backbone takes one noise level for a clip: use "
            "false.",
        )

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
