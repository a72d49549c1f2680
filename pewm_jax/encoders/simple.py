"""The image encoders without weights of their own: patch colours, and the codec's latents.

``patch_colours`` are the mean colour c of each patch, and −c. The map keeps the maximum over all
views. A cell therefore holds the largest value of each colour channel and, through −c, the smallest
one. The middle of the two is the cell's colour.

``latents`` are the codec's normalised latents of a frame's colours, at the grid of the latents;
depth gives their positions and is not encoded.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from pewm_jax.config.parts import Encoder
from pewm_jax.errors import require, require_positive
from pewm_jax.types import Array, Params


@dataclasses.dataclass(frozen=True)
class PatchColoursConfig(Encoder):
    """The mean colour of each patch and its negative: six features, no weights."""

    patch: int = 2
    """Pixels per patch, along height and along width."""

    channels: ClassVar[int] = 6

    def grid(self, clip: Any) -> tuple[int, int]:
        """Return the rows and columns of patches that a frame of a ``ClipConfig`` has."""
        return clip.height // self.patch, clip.width // self.patch

    def check(self, model: Any) -> None:
        """Refuse images that do not split into patches."""
        clip = model.clip
        require(
            clip.height % self.patch == 0 and clip.width % self.patch == 0,
            f"memory.encoder.patch {self.patch} does not divide the clip "
            f"{clip.height}×{clip.width}.",
        )

    def __post_init__(self):
        """Validate."""
        require_positive(self, "memory.encoder", "patch")

    def encode(self, params: Params, rgb_THWC: Array) -> Array:
        """Return (T, H/p, W/p, 6) features."""
        del params
        return patch_colours(rgb_THWC, self.patch)

    def preprocessing(self) -> dict[str, Any]:
        """Return the settings of the features."""
        return {"network": {}, "preprocessing": {"patch": self.patch}}

    def colours(self, features_VF: np.ndarray) -> np.ndarray:
        """Return the middle of each cell's range of colours."""
        values = np.asarray(features_VF, np.float32)
        return (values[..., :3] - values[..., 3:6]) / 2


def patch_colours(rgb_THWC: Array, patch: int) -> Array:
    """Return (T, H/p, W/p, 6): mean of each patch of p × p pixels of colours, and its negative."""
    frames, height, width, _ = rgb_THWC.shape
    grid = rgb_THWC.reshape(frames, height // patch, patch, width // patch, patch, 3)
    mean = grid.mean((2, 4))
    return jnp.concatenate([mean, -mean], -1)


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
