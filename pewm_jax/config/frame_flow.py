"""Flow matching with a time for every frame, as in PERSIST."""

from __future__ import annotations

import dataclasses
from typing import Literal

from pewm_jax.config.noise import FlowConfig
from pewm_jax.errors import require


@dataclasses.dataclass(frozen=True)
class FrameFlowConfig(FlowConfig):
    """x_t = (1 − t) x0 + (s + (1 − s) t) ε, velocity (1 − s) ε − x0.

    A little noise, s, is left at t = 0 (arXiv 2210.02747). With ``per_frame`` each frame has a time
    of its own (diffusion forcing, arXiv 2407.01392); frames that are given have some noise, too.
    ``PERSIST_VOXELS`` and ``PERSIST_PIXELS`` are the published settings.
    """

    shift: float = 3.0
    """Time shift of the sampler: t → s t / (1 + (s − 1) t)."""
    times: Literal["uniform", "logit_normal", "ends"] = "logit_normal"  # type: ignore[assignment]
    """Distribution of times in training. `ends`: half the frames at the time of those that are
    given (`context_noise`), half at 1, which is all that a sampler of one step ever meets; it needs
    `per_frame`. Not as published."""
    shifted_times: bool = False
    """Whether the times of training are shifted, too."""
    sample_steps: int = 20
    """Steps of the sampler, by Euler's method."""
    predicts: Literal["velocity", "x0"] = "velocity"
    """What the network predicts. `velocity` as published. `x0`, the clean latents, where tokens
    hold more numbers than the network is wide: noise has as many dimensions as a token, and what
    does not pass through the network stays in the sample (arXiv 2511.13720)."""
    smallest: float = 1e-5
    """The noise s that is left at t = 0."""
    context_noise: float = 0.02
    """Time of the frames that are given; published: 0.02 for voxels, 0.1 for pixels."""

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        for name in ("smallest", "context_noise"):
            value = getattr(self, name)
            require(0 <= value < 1, f"noise.{name} is {value}: use 0 or more, below 1.")
        require(
            self.times != "ends" or (self.per_frame and self.sample_steps == 1),
            f"noise.times is ends with noise.per_frame {self.per_frame} and noise.sample_steps "
            f"{self.sample_steps}: use per_frame true and 1 step, or other times.",
        )


PERSIST_VOXELS = FrameFlowConfig(per_frame=True)
"""The noise of PERSIST's voxel frames."""
PERSIST_PIXELS = FrameFlowConfig(per_frame=True, context_noise=0.1)
"""The noise of PERSIST's pictures."""
