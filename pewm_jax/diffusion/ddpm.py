"""DDPM: discrete noise levels ᾱ, as in CogVideoX."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import DDPMConfig
from pewm_jax.diffusion import sampler, schedule
from pewm_jax.types import Array

corrupt = schedule.add_noise
target = schedule.target
to_x0 = schedule.to_x0
sample = sampler.sample


def draw(config: DDPMConfig, key: Array, batch: int, frames: int) -> Array:
    """Draw (B,) levels uniformly."""
    del frames
    return jax.random.randint(key, (batch,), 0, config.train_steps)


def shown(config: DDPMConfig, x_t: Array, time_B: Array) -> tuple[Array, Array]:
    """Return x_t unchanged, and the level."""
    del config
    return x_t, time_B


def weight(config: DDPMConfig, time_B: Array) -> Array:
    """Return min(1 / (1 − ᾱ), max_weight) for the target x0, else 1."""
    if config.target == "x0":
        return schedule.x0_weight(config, time_B)
    return jnp.ones(time_B.shape)


def levels(config: DDPMConfig) -> np.ndarray:
    """Return the visited levels, descending."""
    return schedule.timesteps(config)
