"""Settings of DINOv2, the encoder of the map's image features."""

from __future__ import annotations

import dataclasses
from typing import Literal

from pewm_jax.errors import ConfigError, require, require_positive

HEAD_DIM = 64
"""Width of a head in every published DINOv2."""


@dataclasses.dataclass(frozen=True)
class DINOv2Config:
    """A vision transformer in DINOv2's form; the defaults are ViT-S/14 without registers."""

    layers: int = 12
    """Transformer blocks."""
    heads: int = 6
    """Attention heads."""
    width: int = 384
    """Model width D: the number of features of a patch."""
    patch: int = 14
    """Pixels per patch, along height and along width."""
    pretrained_size: int = 518
    """Side in pixels of the images that the stored position embeddings are for; they are
    interpolated for other sizes."""
    mlp_ratio: int = 4
    """Feed-forward width over model width (SwiGLU uses two thirds of it)."""
    swiglu: bool = False
    """Gated feed-forward, as in ViT-g."""
    registers: int = 0
    """Register tokens besides the class token: 0, or 4 in the models with registers."""
    antialias: bool = False
    """Whether interpolating position embeddings to fewer patches uses antialiasing, as the
    reference does in its models with registers only."""
    epsilon: float = 1e-6
    """Added to the variance in layer norms."""

    @property
    def grid(self) -> int:
        """Stored position embeddings along each side."""
        return self.pretrained_size // self.patch

    @property
    def hidden(self) -> int:
        """Width of the feed-forward's hidden layer (SwiGLU: of its gate)."""
        width = self.width * self.mlp_ratio
        return (int(width * 2 / 3) + 7) // 8 * 8 if self.swiglu else width

    def __post_init__(self):
        """Validate."""
        require_positive(self, "dinov2", "layers", "heads", "width", "patch", "mlp_ratio")
        require_positive(self, "dinov2", "pretrained_size")
        require(
            self.width % self.heads == 0,
            f"dinov2.width {self.width} is not a multiple of dinov2.heads {self.heads}.",
        )
        require(
            self.pretrained_size >= self.patch,
            f"dinov2.pretrained_size {self.pretrained_size} is smaller than one patch of "
            f"{self.patch} pixels.",
        )
        require(
            self.registers >= 0,
            f"dinov2.registers is {self.registers}: use 0 or more (the published models: 0 or 4).",
        )
        require(self.epsilon > 0, f"dinov2.epsilon is {self.epsilon}: it must be positive.")


_SIZES = {
    "small": {"layers": 12, "heads": 6, "width": 384},
    "base": {"layers": 12, "heads": 12, "width": 768},
    "large": {"layers": 24, "heads": 16, "width": 1024},
    "giant": {"layers": 40, "heads": 24, "width": 1536, "swiglu": True},
}


def size_name(config: DINOv2Config) -> str:
    """Return the name of a network's size, such as ``small`` or ``base-registers``.

    Args:
        config: of any DINOv2; of a size that is not published the name is ``LAYERSxWIDTH``.
    """
    sizes = {(entry["layers"], entry["width"]): name for name, entry in _SIZES.items()}
    size = sizes.get((config.layers, config.width), f"{config.layers}x{config.width}")
    return f"{size}-registers" if config.registers else size


def published(
    size: Literal["small", "base", "large", "giant"], registers: bool = False
) -> DINOv2Config:
    """Return the configuration of a published model: ViT-S, B, L or g with patches of 14 pixels.

    Raises:
        ConfigError: the size does not exist.
    """
    if size not in _SIZES:
        raise ConfigError(f"There is no DINOv2 {size!r}; there is {', '.join(_SIZES)}.")
    return DINOv2Config(**_SIZES[size], registers=4 if registers else 0, antialias=registers)
