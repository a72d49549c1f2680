"""Flow matching on straight paths (arXiv 2210.02747): x_t = (1 − t) x0 + t ε, velocity ε − x0.

A time may be given for every latent frame (diffusion forcing, arXiv 2407.01392).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import FlowConfig
from pewm_jax.diffusion.noise import Denoiser, spread
from pewm_jax.types import Array


def _shifted(config: FlowConfig, time: Array) -> Array:
    """Return s t / (1 + (s − 1) t)."""
    return config.shift * time / (1 + (config.shift - 1) * time)


def draw(config: FlowConfig, key: Array, batch: int, frames: int) -> Array:
    """Draw times in [0, 1]: (B,), or (B, t) with ``noise.per_frame``."""
    shape = (batch, frames) if config.per_frame else (batch,)
    if config.times == "logit_normal":
        return _shifted(config, jax.nn.sigmoid(jax.random.normal(key, shape)))
    return _shifted(config, jax.random.uniform(key, shape))


def corrupt(config: FlowConfig, x0: Array, noise: Array, time_B: Array) -> Array:
    """Return (1 − t) x0 + t ε."""
    del config
    time = spread(time_B, x0.ndim)
    return (1 - time) * x0 + time * noise


def shown(config: FlowConfig, x_t: Array, time_B: Array) -> tuple[Array, Array]:
    """Return x_t unchanged, and the time in the network's units."""
    return x_t, time_B * config.scale


def target(config: FlowConfig, x0: Array, noise: Array, time_B: Array) -> Array:
    """Return the velocity ε − x0."""
    del config, time_B
    return noise - x0


def weight(config: FlowConfig, time_B: Array) -> Array:
    """Return 1."""
    del config
    return jnp.ones(time_B.shape)


def to_x0(config: FlowConfig, prediction: Array, x_t: Array, time_B: Array) -> Array:
    """Return x_t − t v."""
    del config
    return x_t - spread(time_B, x_t.ndim) * prediction


def levels(config: FlowConfig) -> np.ndarray:
    """Return (sample_steps,) times from 1 downwards, shifted."""
    time = np.linspace(1, 0, config.sample_steps + 1)[:-1]
    return np.asarray(config.shift * time / (1 + (config.shift - 1) * time))


def sample(config: FlowConfig, denoise: Denoiser, noise: Array, key: Array | None = None) -> Array:
    """Follow the flow from t = 1 to 0 by Euler's method."""
    del key
    times = np.asarray(levels(config), np.float32)
    after = np.append(times[1:], np.float32(0))

    def step(x: Array, row: tuple[Array, Array]) -> tuple[Array, None]:
        now, then = row
        x0 = denoise(x, jnp.full((x.shape[0],), now), jnp.float32(config.guidance))
        velocity = (x - x0) / now
        return (x + (then - now) * velocity).astype(x.dtype), None

    out, _ = jax.lax.scan(step, noise, (jnp.asarray(times), jnp.asarray(after)))
    return out
