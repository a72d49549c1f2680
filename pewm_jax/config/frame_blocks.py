"""Transformer blocks over frames: attention inside of a frame and, causally, over time."""

from __future__ import annotations

import dataclasses
from typing import Literal

from pewm_jax.errors import require, require_positive


@dataclasses.dataclass(frozen=True)
class BlocksConfig:
    """The blocks that PERSIST's networks have in common; by default as published."""

    layers: int = 12
    """Transformer blocks."""
    heads: int = 16
    """Attention heads."""
    head_dim: int = 64
    """Width of a head; even, the rotary embedding of time turns pairs of channels."""
    mlp_ratio: int = 4
    """Feed-forward width over model width."""
    context: int = 8
    """Frames that a frame attends to over time: itself and those before it."""
    gates: Literal["zero", "open"] = "zero"
    """Where the gates of the modulation begin. `zero`: every block begins as the identity, as
    published. `open`: at 1, with which small networks learn sooner."""
    attention: Literal["auto", "xla", "cudnn"] = "auto"
    """The kernel of attention inside of a frame and to pixels: `cudnn` is flash attention on NVIDIA
    GPUs in 16 bits, `xla` runs anywhere, `auto` uses cudnn if it can."""
    remat: bool = False
    """Recompute activations in the backward pass: less memory, about a third more time."""

    @property
    def width(self) -> int:
        """Model width D."""
        return self.heads * self.head_dim

    def __post_init__(self):
        """Validate."""
        require_positive(self, "blocks", "layers", "heads", "head_dim", "mlp_ratio", "context")
        require(
            self.head_dim % 2 == 0,
            f"blocks.head_dim is {self.head_dim}: use an even number, the rotary embedding of time "
            "turns pairs of channels.",
        )
        require(
            self.width % 4 == 0,
            f"blocks.heads × blocks.head_dim is {self.width}: use a multiple of 4.",
        )
