"""The codec as image encoder: the memory keeps the denoiser's latents.

Features of a frame are the codec's normalised latents of its colours, at the grid of the latents;
depth gives their positions and is not encoded. There are no parameters besides the codec's.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp

from pewm_jax.config.parts import Encoder
from pewm_jax.errors import require, require_positive
from pewm_jax.types import Array, Params


@dataclasses.dataclass(frozen=True)
class LatentsConfig(Encoder):
    """The codec's latents of the colours of each frame; no other weights."""

    WEIGHTS: ClassVar[str] = "codec"

    channels: int = 16
    """Latent channels of colour that the codec has."""
    spatial: int = 8
    """Pixels per latent cell of the codec, each way."""

    def grid(self, clip: Any) -> tuple[int, int]:
        """Return the rows and columns of latents that a frame of a ``ClipConfig`` has."""
        return clip.height // self.spatial, clip.width // self.spatial

    def check(self, model: Any) -> None:
        """Refuse a codec that differs from the settings or folds frames."""
        q, channels, side = model.codec.temporal, model.codec.rgb_channels, model.codec.spatial
        require(
            q == 1,
            f"memory.encoder.kind latents takes the latents of single frames, and the codec folds "
            f"{q} frames into one (codec.temporal): use codec.kind learned, or another "
            "memory.encoder.",
        )
        require(
            (self.channels, self.spatial) == (channels, side),
            f"memory.encoder.channels is {self.channels} and memory.encoder.spatial is "
            f"{self.spatial}, and the codec's latents have {channels} channels for {side} pixels "
            "each way: set them to these.",
        )

    def __post_init__(self):
        """Validate."""
        require_positive(self, "memory.encoder", "channels", "spatial")

    def encode(self, params: Params, rgb_THWC: Array) -> Array:
        """Refuse: the codec's latents need the model; see ``features``."""
        del params, rgb_THWC
        self.require_own("cannot be made without the model")

    def features(self, model: Any, params: Params, rgb_THWC: Array) -> Array:
        """Return (T, H/s, W/s, C) latents of colours in float32."""
        video = rgb_THWC[None].astype(jnp.dtype(model.dtype))
        latents = model.codec.encode(params.get("codec", {}), video)
        return latents[0].astype(jnp.float32)
