"""The DDPM noise schedule, the three prediction targets, and the levels a sampler visits.

The schedule is CogVideoX's: scaled-linear betas, an optional SNR shift, rescaled to zero terminal
SNR (Lin et al. 2023, arXiv 2305.08891, Alg. 1). It is computed in float64.
"""

from __future__ import annotations

from typing import Literal

import jax.numpy as jnp
import numpy as np

from pewm_jax.config import DDPMConfig
from pewm_jax.diffusion.noise import spread
from pewm_jax.types import Array


def alphas_cumprod(config: DDPMConfig) -> np.ndarray:
    """Return (train_steps,) ᾱ from almost 1 down to exactly 0 (zero terminal SNR)."""
    root = np.linspace(config.beta_start**0.5, config.beta_end**0.5, config.train_steps)
    alphas = np.cumprod(1 - root**2)
    alphas = alphas / (config.snr_shift + (1 - config.snr_shift) * alphas)
    if config.zero_terminal_snr:
        signal = np.sqrt(alphas)
        signal = (signal - signal[-1]) * signal[0] / (signal[0] - signal[-1])
        alphas = signal**2
    return alphas


def _coefficients(config: DDPMConfig, timesteps_B: Array, ndim: int) -> tuple[Array, Array]:
    """Return √ᾱ and √(1 − ᾱ) of shape (B, 1, …), or (B, t, 1, …)."""
    alphas = alphas_cumprod(config)
    signal = jnp.asarray(np.sqrt(alphas), jnp.float32)[timesteps_B]
    noise = jnp.asarray(np.sqrt(1 - alphas), jnp.float32)[timesteps_B]
    return spread(signal, ndim), spread(noise, ndim)


def add_noise(config: DDPMConfig, x0: Array, noise: Array, timesteps_B: Array) -> Array:
    """Return x_t = √ᾱ x0 + √(1 − ᾱ) ε."""
    a, b = _coefficients(config, timesteps_B, x0.ndim)
    return a * x0 + b * noise


def target(config: DDPMConfig, x0: Array, noise: Array, timesteps_B: Array) -> Array:
    """Return the target of the prediction: x0, ε, or v = √ᾱ ε − √(1 − ᾱ) x0."""
    a, b = _coefficients(config, timesteps_B, x0.ndim)
    return {"x0": x0, "eps": noise, "v": a * noise - b * x0}[config.target]


def to_x0(
    config: DDPMConfig,
    prediction: Array,
    x_t: Array,
    timesteps_B: Array,
    kind: Literal["x0", "v", "eps"] | None = None,
) -> Array:
    """Turn a prediction of ``kind`` (by default the configured target) into x0."""
    a, b = _coefficients(config, timesteps_B, x_t.ndim)
    kind = kind or config.target
    if kind == "x0":
        return prediction
    if kind == "v":
        return a * x_t - b * prediction
    return (x_t - b * prediction) / a


def x0_weight(config: DDPMConfig, timesteps_B: Array) -> Array:
    """Return (B,) min(1 / (1 − ᾱ), max_weight): weights that turn errors of x0 into those of v."""
    alphas = alphas_cumprod(config)
    weight = np.minimum(1 / (1 - alphas), config.max_weight)
    return jnp.asarray(weight, jnp.float32)[timesteps_B]


def timesteps(config: DDPMConfig) -> np.ndarray:
    """Return (sample_steps,) int32 visited levels, descending (Lin et al. 2023, Table 2).

    Trailing spacing begins at the last training level. The result always has ``sample_steps``
    levels. (In the reference, rounding adds a further level, −1, for 62 of 1000 counts.)
    """
    count, total = config.sample_steps, config.train_steps
    if config.spacing == "linspace":
        levels = np.round(np.linspace(0, total - 1, count))[::-1]
    elif config.spacing == "leading":
        levels = np.arange(count)[::-1] * (total // count) + config.steps_offset
    else:
        levels = np.round(np.arange(total, 0, -total / count)[:count]) - 1
    return levels.astype(np.int32)


def guidance(config: DDPMConfig) -> np.ndarray:
    """Return the (sample_steps,) weights of guidance at the visited levels.

    They are constant or, with ``dynamic_guidance``, CogVideoX's
    1 + g (1 − cos(π ((N − t) / N)⁵)) / 2
    (``diffusers/pipelines/cogvideo/pipeline_cogvideox.py``). There, as here, N counts sampling
    steps but t is a training level, so the weight jumps between 1 and 1 + g from step to step.
    """
    count = config.sample_steps
    if not config.dynamic_guidance:
        return np.full(count, config.guidance)
    share = (count - timesteps(config).astype(np.float64)) / count
    return 1 + config.guidance * (1 - np.cos(np.pi * share**5)) / 2
