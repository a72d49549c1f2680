"""The shape of a clip, and the effect of an action."""

from __future__ import annotations

import dataclasses
from typing import Literal

from pewm_jax.errors import require

SMALLEST = 12
"""Smallest side of a clip in pixels: the evaluation's SSIM slides a window of 11 over the image."""


@dataclasses.dataclass(frozen=True)
class ClipConfig:
    """The shape of a clip: the frames that are imagined at once."""

    frames: int = 9
    """Frames of a clip: the first is observed, the rest are generated. The codec folds them in
    time: with `codec.temporal` 4, use 4k + 1 frames."""
    height: int = 64
    """Image height in pixels."""
    width: int = 64
    """Image width in pixels."""
    near_m: float = 0.1
    """Depth that maps to −1, metres; nearer depths are clipped."""
    far_m: float = 12.0
    """Depth that maps to +1, metres; farther depths are clipped."""
    depth_scale: Literal["linear", "log"] = "log"
    """How metres map to [−1, 1] between near and far."""
    depth: bool = True
    """Whether the denoiser generates depth; without it only observed frames can be remembered."""

    def __post_init__(self):
        """Validate."""
        require(
            self.frames >= 2,
            f"clip.frames is {self.frames}: a clip has an observed frame and at least one to be "
            "imagined; use 9.",
        )
        require(
            0 < self.near_m < self.far_m,
            f"clip.near_m {self.near_m} and clip.far_m {self.far_m}: near must be above 0 and "
            "below far.",
        )
        require(
            min(self.height, self.width) >= SMALLEST,
            f"clip.height {self.height} and clip.width {self.width} must be at least {SMALLEST} "
            "pixels: the structural similarity of the evaluation looks through a window of 11; "
            "use 16 or more.",
        )


@dataclasses.dataclass(frozen=True)
class ActionConfig:
    """What one discrete action does to the agent."""

    step_m: float = 0.25
    """Length of one forward step, metres."""
    turn_deg: float = 30.0
    """Angle of one turn, degrees."""

    def __post_init__(self):
        """Validate."""
        require(self.step_m > 0, f"actions.step_m is {self.step_m}: it must be above 0 metres.")
        require(
            0 < self.turn_deg <= 180,
            f"actions.turn_deg is {self.turn_deg}: use an angle above 0 and up to 180 degrees.",
        )
