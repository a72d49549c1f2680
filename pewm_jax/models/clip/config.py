"""The settings of CLIP's image encoder; the defaults are the one of Stable Video Diffusion."""

from __future__ import annotations

import dataclasses
from typing import Literal

from pewm_jax.errors import require, require_positive


@dataclasses.dataclass(frozen=True)
class CLIPVisionConfig:
    """A vision transformer in CLIP's form with its projection (arXiv 2103.00020): ViT-H/14."""

    layers: int = 32
    """Transformer blocks."""
    heads: int = 16
    """Attention heads."""
    width: int = 1280
    """Model width."""
    hidden: int = 5120
    """Width of the feed-forward's hidden layer."""
    projection: int = 1024
    """Channels of the embedding of an image."""
    image_size: int = 224
    """Side of an image in pixels; no other size is accepted."""
    patch: int = 14
    """Pixels per patch, along height and along width."""
    activation: Literal["gelu", "quick_gelu"] = "gelu"
    """`quick_gelu` is x·sigmoid(1.702 x), as in OpenAI's models."""
    epsilon: float = 1e-5
    """Added to the variance in layer norms."""

    @property
    def tokens(self) -> int:
        """Tokens of an image: its patches and one for the whole."""
        return 1 + (self.image_size // self.patch) ** 2

    def __post_init__(self):
        """Validate."""
        sizes = ("layers", "heads", "width", "hidden", "projection", "image_size", "patch")
        require_positive(self, "clip_vision", *sizes)
        require(
            self.width % self.heads == 0,
            f"clip_vision.width {self.width} is not a multiple of clip_vision.heads {self.heads}.",
        )
        require(
            self.image_size % self.patch == 0,
            f"clip_vision.image_size {self.image_size} is not a multiple of clip_vision.patch "
            f"{self.patch}.",
        )
        require(self.epsilon > 0, f"clip_vision.epsilon is {self.epsilon}: it must be positive.")
