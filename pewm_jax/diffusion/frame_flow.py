"""Flow matching with a time for every frame (PERSIST, arXiv 2603.03482).

x_t = (1 − t) x0 + (s + (1 − s) t) ε with the velocity (1 − s) ε − x0, which is dx_t/dt. With s = 0
this is ``flow``, from which it takes times, levels and what the network is shown. The network may
predict x0 in the place of the velocity (``noise.predicts``).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import FrameFlowConfig
from pewm_jax.diffusion import flow
from pewm_jax.diffusion.noise import Denoiser, spread
from pewm_jax.types import Array

shown = flow.shown
weight = flow.weight
levels = flow.levels


def draw(config: FrameFlowConfig, key: Array, batch: int, frames: int) -> Array:
    """Draw times in [0, 1], (B, t) or (B,); shifted only with ``noise.shifted_times``."""
    if config.times == "ends":
        ended = jax.random.bernoulli(key, shape=(batch, frames))
        return jnp.where(ended, 1.0, config.context_noise)
    drawn = config if config.shifted_times else dataclasses.replace(config, shift=1.0)
    return flow.draw(drawn, key, batch, frames)


def corrupt(config: FrameFlowConfig, x0: Array, noise: Array, time_B: Array) -> Array:
    """Return (1 − t) x0 + (s + (1 − s) t) ε."""
    time, least = spread(time_B, x0.ndim), config.smallest
    return (1 - time) * x0 + (least + (1 - least) * time) * noise


def target(config: FrameFlowConfig, x0: Array, noise: Array, time_B: Array) -> Array:
    """Return the velocity (1 − s) ε − x0, or x0 where that is predicted."""
    del time_B
    if config.predicts == "x0":
        return x0
    return (1 - config.smallest) * noise - x0


def to_x0(config: FrameFlowConfig, prediction: Array, x_t: Array, time_B: Array) -> Array:
    """Return (1 − s) (x_t − t v) − s v, or the prediction where it is x0."""
    if config.predicts == "x0":
        return prediction
    least = config.smallest
    at_zero = x_t - spread(time_B, x_t.ndim) * prediction
    return (1 - least) * at_zero - least * prediction


def velocity(config: FrameFlowConfig, x0: Array, x_t: Array, time_B: Array) -> Array:
    """Return ((1 − s) x_t − x0) / (s + (1 − s) t), the velocity that leads to x0."""
    time, least = spread(time_B, x_t.ndim), config.smallest
    return ((1 - least) * x_t - x0) / (least + (1 - least) * time)


def given(config: FrameFlowConfig, x0: Array, key: Array) -> tuple[Array, Array]:
    """Return given frames (B, T, …) with ``noise.context_noise``, and their times (B, T)."""
    times = jnp.full(x0.shape[:2], config.context_noise)
    return corrupt(config, x0, jax.random.normal(key, x0.shape, x0.dtype), times), times


def sample(
    config: FrameFlowConfig, denoise: Denoiser, noise: Array, key: Array | None = None
) -> Array:
    """Follow the flow from t = 1 by Euler's method; the end is the last step's x0, without s ε."""
    del key
    times = np.asarray(levels(config), np.float32)
    after = np.append(times[1:], np.float32(0))

    def step(held: tuple[Array, Array], row: tuple[Array, Array]) -> tuple[Any, None]:
        (x, _), (now, then) = held, row
        time_B = jnp.full((x.shape[0],), now)
        x0 = denoise(x, time_B, jnp.float32(config.guidance)).astype(x.dtype)
        return ((x + (then - now) * velocity(config, x0, x, time_B)).astype(x.dtype), x0), None

    rows = (jnp.asarray(times), jnp.asarray(after))
    (_, x0), _ = jax.lax.scan(step, (noise, noise), rows)
    return x0
