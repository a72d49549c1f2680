"""Noise: how latents are corrupted, what the network predicts, how samples are drawn."""

from __future__ import annotations

import dataclasses
from typing import Literal

from pewm_jax.config.parts import Noise
from pewm_jax.errors import require, require_positive


@dataclasses.dataclass(frozen=True)
class DDPMConfig(Noise):
    """Discrete noise levels ᾱ, as in CogVideoX: schedule, prediction target and sampler."""

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
    """Which noise levels are visited. Only trailing starts at pure noise for any sample_steps."""
    steps_offset: int = 0
    """Number added to every visited level, with leading spacing."""
    stride: Literal["next", "fixed"] = "next"
    """Where a step leads: to the `next` visited level, or by a `fixed` train_steps // sample_steps
    levels down, as in CogVideoX's schedulers. They differ only if sample_steps does not divide
    train_steps; then a fixed stride does not land on the levels that the denoiser gets."""
    set_alpha_to_one: bool = True
    """Whether the last step ends at a clean sample, or at noise level 0, which is almost clean."""
    guidance: float = 1.0
    """Classifier-free guidance on the memory (in the world egowm: on the observed image, or on the
    text of Cosmos): 1 = off, above 1 pushes away from 'no memory'."""
    dynamic_guidance: bool = False
    """Vary the guidance with the training level t, as CogVideoX's pipelines do:
    1 + g (1 − cos(π ((N − t) / N)⁵)) / 2 with N = sample_steps."""

    def __post_init__(self):
        """Validate."""
        require(
            0 < self.beta_start < self.beta_end < 1,
            "noise.beta_start and beta_end need 0 < start < end < 1.",
        )
        require(
            1 <= self.sample_steps <= self.train_steps,
            f"noise.sample_steps is {self.sample_steps}: use 1 to {self.train_steps} "
            "(noise.train_steps).",
        )
        require(
            self.train_steps >= 2,
            f"noise.train_steps is {self.train_steps}: a schedule needs at least 2 noise "
            "levels; use 1000.",
        )
        stride = self.train_steps // self.sample_steps
        require(
            self.spacing != "leading"
            or 0 <= self.steps_offset < self.train_steps - stride * (self.sample_steps - 1),
            f"noise.steps_offset is {self.steps_offset}: with {self.sample_steps} leading "
            f"steps use 0 to {self.train_steps - 1 - stride * (self.sample_steps - 1)}, or the "
            "first step would lie outside of the schedule.",
        )
        require(self.snr_shift > 0, "noise.snr_shift must be above 0.")
        require(self.max_weight > 0, "noise.max_weight must be above 0.")
        require(
            not (self.target == "eps" and self.zero_terminal_snr),
            "noise.target eps cannot be used with zero_terminal_snr: at the last step the "
            "input is pure noise and x0 cannot be recovered from ε; use v or x0, or switch "
            "zero_terminal_snr off.",
        )


@dataclasses.dataclass(frozen=True)
class EDMConfig(Noise):
    """Continuous noise σ with preconditioning (Karras et al. 2022, arXiv 2206.00364)."""

    sigma_data: float = 0.5
    """Standard deviation of clean latents."""
    sigma_min: float = 0.002
    """Smallest σ in sampling."""
    sigma_max: float = 80.0
    """Largest σ in sampling."""
    rho: float = 7.0
    """Exponent of the sampler's steps; larger values place more of them at small σ."""
    log_mean: float = -1.2
    """Mean of log σ in training."""
    log_std: float = 1.2
    """Standard deviation of log σ in training."""
    target: Literal["edm", "v", "flow"] = "edm"
    """What the network predicts. `edm`: F of the paper; `v`: −F, as in Stable Video Diffusion
    (with sigma_data 1 it is v of DDPM). Samples then start with deviation √(σ_max² + sigma_data²),
    that of noisy latents, instead of σ_max. `flow`: the velocity ε − x0 of latents x / (1 + σ), at
    time σ / (1 + σ), as in Cosmos-Predict2; sigma_data is 1."""
    sample_steps: int = 18
    """Steps of the sampler."""
    ends: Literal["clean", "sigma_min"] = "clean"
    """Where the sampler ends: at clean latents, or as in Cosmos-Predict2 at latents with the noise
    sigma_min, one evaluation of the network less."""
    sampler: Literal["euler", "heun"] = "euler"
    """`euler`: first order, one evaluation of the denoiser per step. `heun`: second order, two."""
    guidance: float = 1.0
    """Classifier-free guidance on the memory (in the world egowm: on the observed image, or on the
    text of Cosmos): 1 = off, above 1 pushes away from 'no memory'."""

    def __post_init__(self):
        """Validate."""
        require_positive(self, "noise", "sample_steps")
        require(
            0 < self.sigma_min < self.sigma_max,
            f"noise.sigma_min {self.sigma_min} and noise.sigma_max {self.sigma_max} need "
            "0 < min < max.",
        )
        require(
            min(self.sigma_data, self.rho) > 0 and self.log_std >= 0,
            "noise.sigma_data and noise.rho must be above 0, and noise.log_std at least 0.",
        )
        require(
            self.target != "flow" or self.sigma_data == 1,
            f"noise.sigma_data is {self.sigma_data}: noise.target flow goes with 1.",
        )
        require(
            self.ends != "sigma_min" or self.sample_steps >= 2,
            "noise.sample_steps is 1: with noise.ends sigma_min use at least 2, or nothing is "
            "denoised.",
        )


@dataclasses.dataclass(frozen=True)
class FlowConfig(Noise):
    """Flow matching on straight paths: x_t = (1 − t) x0 + t ε, velocity ε − x0 (arXiv 2210.02747).

    Each latent frame may have its own time (diffusion forcing, arXiv 2407.01392).
    """

    shift: float = 1.0
    """Time shift s: t → s t / (1 + (s − 1) t); above 1 spends more steps near pure noise."""
    times: Literal["uniform", "logit_normal"] = "uniform"
    """Distribution of times in training."""
    per_frame: bool = False
    """Whether training draws one time per latent frame instead of one per clip."""
    scale: float = 1000.0
    """Factor of t in the network's time input."""
    sample_steps: int = 10
    """Steps of the sampler, by Euler's method."""
    guidance: float = 1.0
    """Classifier-free guidance on the memory (in the world egowm: on the observed image, or on the
    text of Cosmos): 1 = off, above 1 pushes away from 'no memory'."""

    def __post_init__(self):
        """Validate."""
        require_positive(self, "noise", "sample_steps")
        require(
            self.shift > 0 and self.scale > 0,
            f"noise.shift is {self.shift} and noise.scale {self.scale}: use numbers above 0.",
        )
