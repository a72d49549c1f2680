"""The noise schedule, the prediction target and the sampler."""

from __future__ import annotations

import dataclasses
from typing import Literal

from pewm_jax.config.errors import require


@dataclasses.dataclass(frozen=True)
class DiffusionConfig:
    """The noise schedule, the prediction target and the sampler."""

    train_steps: int = 1000
    """Noise levels of the schedule."""
    beta_start: float = 0.00085
    """First β of the scaled-linear schedule."""
    beta_end: float = 0.012
    """Last β of the scaled-linear schedule."""
    snr_shift: float = 1.0
    """CogVideoX's SNR shift s: ᾱ → ᾱ / (s + (1 − s) ᾱ). 3 for its 2B model, 1 for 5B."""
    zero_terminal_snr: bool = True
    """Rescale the schedule so that the last step is pure noise."""
    target: Literal["x0", "v", "eps"] = "x0"
    """What the network predicts. x0 for the pixel codec, v for VAE latents."""
    max_weight: float = 5.0
    """Upper bound of the loss weight 1 / (1 − ᾱ) on the squared error of x0 (= MSE in v)."""
    sample_steps: int = 10
    """Evaluations of the denoiser per clip."""
    sampler: Literal["ddim", "dpm"] = "ddim"
    """`ddim`: deterministic (η = 0). `dpm`: DPM-Solver++ (2M) with fresh noise at every step."""
    spacing: Literal["trailing", "leading", "linspace"] = "trailing"
    """Which noise levels are visited. Only trailing begins at pure noise for every step count."""
    steps_offset: int = 0
    """Added to every visited level of leading spacing."""
    stride: Literal["next", "fixed"] = "next"
    """Where a step leads: to the next visited level, or train_steps // sample_steps levels down,
    as CogVideoX's schedulers do. The two differ only where sample_steps does not divide
    train_steps, and there a fixed stride misses the levels the denoiser is told."""
    set_alpha_to_one: bool = True
    """End the last step at a clean sample; False: at noise level 0, which is almost clean."""
    guidance: float = 1.0
    """Classifier-free guidance on the memory: 1 = off, above 1 pushes away from 'no memory'."""
    dynamic_guidance: bool = False
    """Let the guidance vary with the level, 1 + g (1 − cos(π ((N − t) / N)⁵)) / 2 after N =
    sample_steps and the training level t, as CogVideoX's pipelines do."""
    image_noise_mean: float = -3.0
    """Mean of log σ of the noise put on the observed first frame in training."""
    image_noise_std: float = 0.5
    """Spread of log σ of the noise put on the observed first frame in training."""

    def __post_init__(self):
        """Validate."""
        require(
            0 < self.beta_start < self.beta_end < 1,
            "diffusion.beta_start and beta_end need 0 < start < end < 1.",
        )
        require(
            1 <= self.sample_steps <= self.train_steps,
            f"diffusion.sample_steps is {self.sample_steps}: use 1 to {self.train_steps} "
            "(diffusion.train_steps).",
        )
        require(
            self.train_steps >= 2,
            f"diffusion.train_steps is {self.train_steps}: a schedule needs at least 2 noise "
            "levels; use 1000.",
        )
        stride = self.train_steps // self.sample_steps
        require(
            self.spacing != "leading"
            or 0 <= self.steps_offset < self.train_steps - stride * (self.sample_steps - 1),
            f"diffusion.steps_offset is {self.steps_offset}: with {self.sample_steps} leading "
            f"steps use 0 to {self.train_steps - 1 - stride * (self.sample_steps - 1)}, or the "
            "first step would lie outside of the schedule.",
        )
        require(self.snr_shift > 0, "diffusion.snr_shift must be above 0.")
        require(self.max_weight > 0, "diffusion.max_weight must be above 0.")
        require(self.image_noise_std >= 0, "diffusion.image_noise_std must be at least 0.")
        require(
            not (self.target == "eps" and self.zero_terminal_snr),
            "diffusion.target eps cannot be used with zero_terminal_snr: at the last step the "
            "input is pure noise and x0 cannot be recovered from ε; use v or x0, or switch "
            "zero_terminal_snr off.",
        )
