"""How pixels become latents and back."""

from __future__ import annotations

import dataclasses
from typing import Literal

from pewm_jax.config.errors import require_positive


@dataclasses.dataclass(frozen=True)
class CodecConfig:
    """How pixels become latents and back."""

    kind: Literal["pixel"] = "pixel"
    """`pixel`: space-to-depth and temporal fold, no parameters, exactly invertible."""
    spatial: int = 4
    """Pixels per latent cell, each way."""
    temporal: int = 4
    """Frames per latent frame after the first."""

    def __post_init__(self):
        """Validate."""
        require_positive(self, "codec", "spatial", "temporal")
