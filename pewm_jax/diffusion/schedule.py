"""The noise schedule and the three prediction targets.

CogVideoX's: scaled-linear betas, optional SNR shift, rescaled to zero terminal SNR
(Lin et al. 2023, arXiv 2305.08891, Alg. 1), computed in float64.
"""

from __future__ import annotations

from typing import Literal

import jax.numpy as jnp
import numpy as np

from pewm_jax.config import DiffusionConfig
from pewm_jax.types import Array


def alphas_cumprod(config: DiffusionConfig) -> np.ndarray:
    """Return (train_steps,) ᾱ from almost 1 down to exactly 0 (zero terminal SNR)."""
    root = np.linspace(config.beta_start**0.5, config.beta_end**0.5, config.train_steps)
    alphas = np.cumprod(1 - root**2)
    alphas = alphas / (config.snr_shift + (1 - config.snr_shift) * alphas)
    if config.zero_terminal_snr:
        signal = np.sqrt(alphas)
        signal = (signal - signal[-1]) * signal[0] / (signal[0] - signal[-1])
        alphas = signal**2
    return alphas


def _coefficients(config: DiffusionConfig, timesteps_B: Array, ndim: int) -> tuple[Array, Array]:
    """Return √ᾱ and √(1 − ᾱ) of shape (B, 1, …)."""
    alphas = alphas_cumprod(config)
    shape = (-1,) + (1,) * (ndim - 1)
    signal = jnp.asarray(np.sqrt(alphas), jnp.float32)[timesteps_B].reshape(shape)
    noise = jnp.asarray(np.sqrt(1 - alphas), jnp.float32)[timesteps_B].reshape(shape)
    return signal, noise


def add_noise(config: DiffusionConfig, x0: Array, noise: Array, timesteps_B: Array) -> Array:
    """Return x_t = √ᾱ x0 + √(1 − ᾱ) ε."""
    a, b = _coefficients(config, timesteps_B, x0.ndim)
    return a * x0 + b * noise


def target(config: DiffusionConfig, x0: Array, noise: Array, timesteps_B: Array) -> Array:
    """Return what the network is asked for: x0, ε, or v = √ᾱ ε − √(1 − ᾱ) x0."""
    a, b = _coefficients(config, timesteps_B, x0.ndim)
    return {"x0": x0, "eps": noise, "v": a * noise - b * x0}[config.target]


def to_x0(
    config: DiffusionConfig,
    prediction: Array,
    x_t: Array,
    timesteps_B: Array,
    kind: Literal["x0", "v", "eps"] | None = None,
) -> Array:
    """Turn a prediction into x0 (kind: the configured target if not given)."""
    a, b = _coefficients(config, timesteps_B, x_t.ndim)
    kind = kind or config.target
    if kind == "x0":
        return prediction
    if kind == "v":
        return a * x_t - b * prediction
    return (x_t - b * prediction) / a


def x0_weight(config: DiffusionConfig, timesteps_B: Array) -> Array:
    """Return (B,) min(1 / (1 − ᾱ), max_weight): the squared error of x0 becomes that of v."""
    alphas = alphas_cumprod(config)
    weight = np.minimum(1 / (1 - alphas), config.max_weight)
    return jnp.asarray(weight, jnp.float32)[timesteps_B]


def trailing_steps(config: DiffusionConfig) -> np.ndarray:
    """Return (sample_steps,) descending timesteps, the last training step first."""
    spacing = config.train_steps / config.sample_steps
    levels = config.train_steps - spacing * np.arange(config.sample_steps)
    return np.round(levels).astype(np.int32) - 1
