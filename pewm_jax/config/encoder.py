"""Image encoders, whose features a memory keeps."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

from pewm_jax.config.dinov2 import DINOv2Config
from pewm_jax.config.parts import Encoder
from pewm_jax.errors import require, require_positive


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


@dataclasses.dataclass(frozen=True)
class LatentsConfig(Encoder):
    """The colours' latents of each frame, as the model's own codec makes them; no other weights."""

    WEIGHTS: ClassVar[str] = "codec"

    channels: int = 16
    """Latent channels of colour that the codec has."""
    spatial: int = 8
    """Pixels per latent cell of the codec, each way."""

    def grid(self, clip: Any) -> tuple[int, int]:
        """Return the rows and columns of latents that a frame of a ``ClipConfig`` has."""
        return clip.height // self.spatial, clip.width // self.spatial

    def check(self, model: Any) -> None:
        """Refuse another codec than the settings describe, and one that folds frames."""
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


@dataclasses.dataclass(frozen=True)
class DINOv2EncoderConfig(Encoder):
    """Patch tokens of a frozen DINOv2 (the paper); the weights come from a converted checkpoint."""

    CONVERTED: ClassVar[bool] = True

    size: int = 518
    """Side in pixels of the square that images are resized to; a multiple of the patch. 518 gives
    37 × 37 patches."""
    network: DINOv2Config = DINOv2Config()
    """The network."""

    @property
    def channels(self) -> int:
        """Number of features of a patch: the network's width."""
        return self.network.width

    def grid(self, clip: Any) -> tuple[int, int]:
        """Return the rows and columns of patches, equal for all frames, which are resized."""
        del clip
        return self.size // self.network.patch, self.size // self.network.patch

    def __post_init__(self):
        """Validate."""
        require_positive(self, "memory.encoder", "size")
        require(
            self.size % self.network.patch == 0,
            f"memory.encoder.size is {self.size}: use a multiple of memory.encoder.network.patch "
            f"{self.network.patch}, 518 for the paper's 37 × 37 features.",
        )
