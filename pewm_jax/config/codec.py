"""How pixels become latents and back."""

from __future__ import annotations

import dataclasses
from typing import Literal

from pewm_jax.config.errors import require, require_positive
from pewm_jax.config.vae import VAEConfig


@dataclasses.dataclass(frozen=True)
class CodecConfig:
    """How pixels become latents and back."""

    kind: Literal["pixel", "vae"] = "pixel"
    """`pixel`: space-to-depth and temporal fold, no parameters, exactly invertible. `vae`:
    CogVideoX's autoencoder, whose weights come from a converted checkpoint."""
    spatial: int = 4
    """Pixels per latent cell, each way."""
    temporal: int = 4
    """Frames per latent frame after the first."""
    vae: VAEConfig = VAEConfig()
    """The autoencoder of kind `vae`."""

    def __post_init__(self):
        """Validate."""
        require_positive(self, "codec", "spatial", "temporal")
        if self.kind == "vae":
            have = (self.spatial, self.temporal)
            need = (self.vae.spatial, self.vae.temporal)
            require(
                have == need,
                f"codec.spatial {have[0]} and codec.temporal {have[1]}: this VAE folds {need[0]} "
                f"pixels and {need[1]} frames; set codec.spatial {need[0]} and codec.temporal "
                f"{need[1]}.",
            )
