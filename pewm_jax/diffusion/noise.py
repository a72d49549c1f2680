"""Noise: every kind behind one interface, chosen by the type of its settings.

A noise is a ``NoiseSettings`` and a module (or object) with the functions below: how clean latents
are corrupted at a time, what the network is shown and told then, what it is asked for, how its
answer becomes x0, what an error weighs, and which levels a sampler visits.

======= ==================== ==================================== =========================
kind    time                 x_t                                  target
======= ==================== ==================================== =========================
ddpm    level, 0 … N − 1     √ᾱ x0 + √(1 − ᾱ) ε                   x0, v or ε
edm     σ                    x0 + σ ε                             (x0 − c_skip x_t) / c_out
flow    t in [0, 1]          (1 − t) x0 + t ε                     ε − x0
======= ==================== ==================================== =========================

A time is one number for a clip, (B,), or, where the kind allows it, one for each latent frame,
(B, t).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from pewm_jax.config import NoiseSettings, functions
from pewm_jax.types import Array

Denoiser: TypeAlias = Callable[[Array, Array, Array], Array]
"""``(x_t, time_B, weight) -> x0``; the weight is that of guidance at this step."""


def draw(config: NoiseSettings, key: Array, batch: int, frames: int) -> Array:
    """Draw times for training: (B,), or (B, t) for ``frames`` latent frames."""
    return functions(config).draw(config, key, batch, frames)


def corrupt(config: NoiseSettings, x0: Array, noise: Array, time_B: Array) -> Array:
    """Return x_t of clean latents (B, t, …) and standard normal noise."""
    return functions(config).corrupt(config, x0, noise, time_B)


def shown(config: NoiseSettings, x_t: Array, time_B: Array) -> tuple[Array, Array]:
    """Return what the network is shown for x_t, and the time that it is told."""
    return functions(config).shown(config, x_t, time_B)


def target(config: NoiseSettings, x0: Array, noise: Array, time_B: Array) -> Array:
    """Return what the network is asked for."""
    return functions(config).target(config, x0, noise, time_B)


def weight(config: NoiseSettings, time_B: Array) -> Array:
    """Return what the squared error of the target weighs, of the shape of the times."""
    return functions(config).weight(config, time_B)


def to_x0(config: NoiseSettings, prediction: Array, x_t: Array, time_B: Array) -> Array:
    """Turn the network's answer into clean latents."""
    return functions(config).to_x0(config, prediction, x_t, time_B)


def levels(config: NoiseSettings) -> np.ndarray:
    """Return (sample_steps,) the times that a sampler visits, from the most noise to the least."""
    return functions(config).levels(config)


def sample(
    config: NoiseSettings, denoise: Denoiser, noise: Array, key: Array | None = None
) -> Array:
    """Draw a sample.

    Args:
        config: the noise and its sampler.
        denoise: ``(x_t, time_B, weight) -> x0``.
        noise: (B, t, …) standard normal start.
        key: randomness of the steps, where the sampler draws any.
    """
    return functions(config).sample(config, denoise, noise, key)


def spread(time_B: Array, ndim: int) -> Array:
    """Give times (B,) or (B, t) trailing axes, so that they broadcast with (B, t, …)."""
    return time_B.reshape(*time_B.shape, *(1,) * (ndim - time_B.ndim))
