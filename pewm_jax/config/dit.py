"""The diffusion transformer."""

from __future__ import annotations

import dataclasses

from pewm_jax.config.errors import require, require_positive


@dataclasses.dataclass(frozen=True)
class DiTConfig:
    """The diffusion transformer in CogVideoX's form."""

    layers: int = 4
    """Transformer blocks."""
    heads: int = 6
    """Attention heads."""
    head_dim: int = 32
    """Width of a head; a multiple of 16 (the rotary embedding splits it 1/4, 3/8, 3/8)."""
    patch: int = 2
    """Latent cells per token, each way."""
    text_length: int = 4
    """Text tokens; with no prompt they are zeros, so that the text path learns a constant."""
    text_dim: int = 32
    """Channels of a text token."""
    time_dim: int = 192
    """Width of the time embedding."""
    mlp_ratio: int = 4
    """Feed-forward width over model width."""
    remat: bool = False
    """Recompute activations in the backward pass: less memory, about a third more time."""

    @property
    def width(self) -> int:
        """Model width D."""
        return self.heads * self.head_dim

    def __post_init__(self):
        """Validate."""
        require_positive(self, "dit", "layers", "heads", "head_dim", "patch")
        require_positive(self, "dit", "text_length", "text_dim", "time_dim", "mlp_ratio")
        require(
            self.head_dim % 16 == 0,
            f"dit.head_dim is {self.head_dim}: use a multiple of 16 (16, 32, 48, 64), the rotary "
            "embedding splits a head into time, height and width parts.",
        )
