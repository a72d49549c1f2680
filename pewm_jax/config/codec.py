"""Codecs: how pixels become latents and back."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

from pewm_jax.errors import require, require_positive
from pewm_jax.registry import Settings


class CodecSettings(Settings):
    """Settings that every codec has; see ``pewm_jax.codecs.interface`` for its functions.

    Attributes:
        spatial: pixels per latent cell, along height and along width.
        temporal: frames per latent frame after the first: q·k + 1 frames become k + 1.
        rgb_channels: latent channels of colour.
        depth_channels: latent channels of depth; 0 where it encodes colour alone.
        framewise: whether every latent frame is decoded by itself.
        DEPTH_AS_GREY: whether depth is encoded as a grey image of three channels, not as one.
        PIXELWISE: whether each latent channel of depth is one pixel of one frame.
        CONVERTED: whether the weights are frozen and come from ``train.start``.
    """

    SECTION: ClassVar[str] = "codec"
    DEPTH_AS_GREY: ClassVar[bool] = False
    PIXELWISE: ClassVar[bool] = False
    CONVERTED: ClassVar[bool] = False
    spatial: Any
    temporal: Any
    rgb_channels: Any
    depth_channels: Any

    @property
    def channels(self) -> int:
        """Latent channels of colour and depth together."""
        return self.rgb_channels + self.depth_channels

    @property
    def framewise(self) -> bool:
        """Whether every latent frame is one frame, decoded by itself."""
        return self.temporal == 1

    def frames(self, count: int) -> int:
        """Return the number of latent frames for a number of frames."""
        return (count - 1) // self.temporal + 1

    def latent_shape(self, clip: Any) -> tuple[int, int, int]:
        """Return (t, h, w) of the latents of a ``ClipConfig``'s clip."""
        return self.frames(clip.frames), clip.height // self.spatial, clip.width // self.spatial

    def check(self, model: Any) -> None:
        """Refuse clips that cannot be folded, and depth that is not encoded."""
        clip, q, s = model.clip, self.temporal, self.spatial
        require(
            (clip.frames - 1) % q == 0,
            f"clip.frames is {clip.frames}: the codec folds every {q} frames after the first into "
            f"one (codec.temporal), so use {q}k + 1 frames ({q + 1}, {2 * q + 1}, …).",
        )
        require(
            clip.height % s == 0 and clip.width % s == 0,
            f"clip {clip.height}×{clip.width}: height and width must be multiples of "
            f"codec.spatial = {s}.",
        )
        require(
            self.depth_channels > 0 or not clip.depth,
            "clip.depth is true, and this codec encodes colour alone: use clip.depth false, or a "
            "codec that encodes depth too.",
        )


@dataclasses.dataclass(frozen=True)
class PixelConfig(CodecSettings):
    """Space-to-depth and temporal fold: no parameters, exactly invertible."""

    PIXELWISE: ClassVar[bool] = True

    spatial: int = 4
    """Pixels per latent cell, along height and along width."""
    temporal: int = 4
    """Frames per latent frame after the first."""

    @property
    def rgb_channels(self) -> int:
        """Latent channels of colour."""
        return 3 * self.depth_channels

    @property
    def depth_channels(self) -> int:
        """Latent channels of depth."""
        return self.temporal * self.spatial**2

    def __post_init__(self):
        """Validate."""
        require_positive(self, "codec", "spatial", "temporal")
