"""Noise: every kind behind one interface, chosen by the type of its settings.

A noise is a ``Noise`` and a module (or object) with the functions below. They corrupt clean
latents at a given time, prepare the network's inputs, define its target and the weight of its
error, turn its prediction into x0, and sample.

========== ==================== ==================================== ==========================
kind       time                 x_t                                  target
========== ==================== ==================================== ==========================
ddpm       level, 0 … N − 1     √ᾱ x0 + √(1 − ᾱ) ε                   x0, v or ε
edm        σ                    x0 + σ ε                             ±(x0 − c_skip x_t) / c_out
flow       t in [0, 1]          (1 − t) x0 + t ε                     ε − x0
frame_flow t in [0, 1]          (1 − t) x0 + (s + (1 − s) t) ε       (1 − s) ε − x0
========== ==================== ==================================== ==========================

A time is one number per clip, (B,), or one per latent frame, (B, t), if the kind allows it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from pewm_jax.config import Noise, functions
from pewm_jax.types import Array

Denoiser: TypeAlias = Callable[[Array, Array, Array], Array]
"""``(x_t, time_B, weight) -> x0``; the last argument is the weight of guidance at this step."""


def draw(config: Noise, key: Array, batch: int, frames: int) -> Array:
    """Draw times for training: (B,), or (B, t) for ``frames`` latent frames."""
    return functions(config).draw(config, key, batch, frames)


def corrupt(config: Noise, x0: Array, noise: Array, time_B: Array) -> Array:
    """Return x_t, made from clean latents (B, t, …) and standard normal noise."""
    return functions(config).corrupt(config, x0, noise, time_B)


def shown(config: Noise, x_t: Array, time_B: Array) -> tuple[Array, Array]:
    """Return the network's inputs: x_t as it is preconditioned, and the time in its units."""
    return functions(config).shown(config, x_t, time_B)


def target(config: Noise, x0: Array, noise: Array, time_B: Array) -> Array:
    """Return the target of the network's prediction."""
    return functions(config).target(config, x0, noise, time_B)


def weight(config: Noise, time_B: Array) -> Array:
    """Return the loss weight of the squared error, in the shape of the times."""
    return functions(config).weight(config, time_B)


def to_x0(config: Noise, prediction: Array, x_t: Array, time_B: Array) -> Array:
    """Turn the network's prediction into clean latents."""
    return functions(config).to_x0(config, prediction, x_t, time_B)


def levels(config: Noise) -> np.ndarray:
    """Return (sample_steps,) the times that a sampler visits, from the most noise to the least."""
    return functions(config).levels(config)


def sample(config: Noise, denoise: Denoiser, noise: Array, key: Array | None = None) -> Array:
    """Draw a sample.

    Args:
        config: the noise and its sampler.
        denoise: ``(x_t, time_B, weight) -> x0``.
        noise: (B, t, …) standard normal start.
        key: randomness of the steps, if the sampler draws noise.
    """
    return functions(config).sample(config, denoise, noise, key)


def spread(time_B: Array, ndim: int) -> Array:
    """Give times (B,) or (B, t) trailing axes, so that they broadcast with (B, t, …)."""
    return time_B.reshape(*time_B.shape, *(1,) * (ndim - time_B.ndim))
