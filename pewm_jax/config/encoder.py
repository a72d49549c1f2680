"""The image features that a memory keeps."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

from pewm_jax.config.dinov2 import DINOv2Config
from pewm_jax.config.errors import require, require_positive
from pewm_jax.config.kinds import Settings


class EncoderSettings(Settings):
    """What the settings of every image encoder say; see ``pewm_jax.models.encoders``.

    Attributes:
        channels: F, features of a patch.
        CONVERTED: whether the weights are not trained here but come from ``train.start``, so that
            it is large, and sees one clip after the other.
    """

    SECTION: ClassVar[str] = "encoder"
    CONVERTED: ClassVar[bool] = False
    channels: Any

    def grid(self, clip: Any) -> tuple[int, int]:
        """Return the rows and columns of patches that a frame of a ``ClipConfig`` has."""
        raise NotImplementedError


@dataclasses.dataclass(frozen=True)
class PatchColoursConfig(EncoderSettings):
    """The mean colour of each patch and its negative: six features, no weights."""

    patch: int = 2
    """Pixels per patch, each way."""

    channels: ClassVar[int] = 6

    def grid(self, clip: Any) -> tuple[int, int]:
        """Return the rows and columns of patches that a frame of a ``ClipConfig`` has."""
        return clip.height // self.patch, clip.width // self.patch

    def check(self, model: Any) -> None:
        """Refuse pictures that do not split into patches."""
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
class DINOv2EncoderConfig(EncoderSettings):
    """Patch tokens of a frozen DINOv2 (the paper); the weights come from a converted checkpoint."""

    CONVERTED: ClassVar[bool] = True

    size: int = 518
    """Side of the square picture that the network is shown, pixels; a multiple of its patch. 518
    gives 37 × 37 features."""
    network: DINOv2Config = DINOv2Config()
    """The network."""

    @property
    def channels(self) -> int:
        """Features of a patch: the network's width."""
        return self.network.width

    def grid(self, clip: Any) -> tuple[int, int]:
        """Return the rows and columns of patches that any frame has: it is resized."""
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
