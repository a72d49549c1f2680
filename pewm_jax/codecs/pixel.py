"""The pixel codec: exactly invertible, without parameters but those of an optional gate.

Space-to-depth of s × s pixels, and q frames folded into one latent frame, with CogVideoX's frame
rule: q·k + 1 frames become k + 1 latent frames, the first of which holds q copies of frame 0.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.codecs import gates
from pewm_jax.config.parts import Codec, Rules
from pewm_jax.errors import require, require_positive
from pewm_jax.geometry.cameras import fold_frames
from pewm_jax.types import Array, Params


@dataclasses.dataclass(frozen=True)
class PixelConfig(Codec):
    """Space-to-depth and temporal fold: no parameters, exactly invertible."""

    SHARDING: ClassVar[Rules] = (
        (r"codec/gate/.*/kernel", P(None, "fsdp")),
        (r"codec/gate/.*/bias", P()),
    )
    PIXELWISE: ClassVar[bool] = True

    spatial: int = 4
    """Pixels per latent cell, along height and along width."""
    temporal: int = 4
    """Frames per latent frame after the first."""
    gate: int = 0
    """Channels of the gate, which blends frames with the rendered memory (such as 48); 0 for no
    gate. Stage `gate` trains it; at first it prefers the memory."""

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
        require(self.gate >= 0, f"codec.gate is {self.gate}: use 0 (no gate) or more channels.")

    def check(self, model: Any) -> None:
        """Refuse an odd height or width with a gate, besides what every codec refuses."""
        super().check(model)
        clip = model.clip
        require(
            not self.gate or clip.height % gates.FOLD == clip.width % gates.FOLD == 0,
            f"clip is {clip.height}×{clip.width}: codec.gate needs an even height and width; "
            "change the clip's size, or use codec.gate 0.",
        )

    def init(self, key: Array) -> Params:
        """Return random parameters of the gate, if there is one."""
        return {"gate": gates.init(self.gate, key)} if self.gate else {}

    def mix(
        self, params: Params, decoded_NHWC: Array, rendered_NHWC: Array, seen_NHW: Array
    ) -> Array:
        """Blend decoded and rendered frames (N, H, W, 4) by the gate; see ``gates.apply``."""
        return gates.apply(params["gate"], decoded_NHWC, rendered_NHWC, seen_NHW)

    def encode(self, params: Params, video_BTHWC: Array, *, condition: bool = False) -> Array:
        """Encode a video (B, q·k + 1, H, W, C); see ``fold``."""
        del params, condition
        return fold(video_BTHWC, self.spatial, self.temporal)

    def decode(self, params: Params, latents_BthwC: Array) -> Array:
        """Invert ``encode``; the q copies of the first frame are averaged."""
        del params
        batch, latent_frames, h, w, width = latents_BthwC.shape
        s, q = self.spatial, self.temporal
        grid = latents_BthwC.reshape(batch, latent_frames, h, w, q, s, s, width // (q * s * s))
        grid = grid.transpose(0, 1, 4, 2, 5, 3, 6, 7)
        video = grid.reshape(batch, latent_frames, q, h * s, w * s, -1)
        rest = video[:, 1:].reshape(batch, -1, *video.shape[3:])
        return jnp.concatenate([video[:, :1].mean(2), rest], 1)


def fold(video_BTHWC: Array, spatial: int, temporal: int) -> Array:
    """Move s × s pixels of q frames into the channels of one latent cell.

    (B, q·k + 1, H, W, C) becomes (B, k + 1, H/s, W/s, q·s·s·C).

    Raises:
        ValueError: the frame count is not q·k + 1, or s does not divide the image.
    """
    batch, frames, height, width, channels = video_BTHWC.shape
    s, q = spatial, temporal
    if (frames - 1) % q or height % s or width % s:
        raise ValueError(
            f"a video of {frames}×{height}×{width} cannot be folded: the codec needs {q}k + 1 "
            f"frames and multiples of {s} pixels."
        )
    folded = jax.vmap(lambda video: fold_frames(video, q))(video_BTHWC)
    grid = folded.reshape(batch, -1, q, height // s, s, width // s, s, channels)
    grid = grid.transpose(0, 1, 3, 5, 2, 4, 6, 7)
    return grid.reshape(*grid.shape[:4], q * s * s * channels)
