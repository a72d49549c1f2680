"""A stranger's noise: x_t = cos(πt/2) x0 + sin(πt/2) ε with t in (0, 1), target v."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import Noise, register
from pewm_jax.diffusion.noise import spread


@dataclasses.dataclass(frozen=True)
class CosineConfig(Noise):
    sample_steps: int = 3


def draw(config, key, batch, frames):
    return jax.random.uniform(key, (batch,))


def corrupt(config, x0, noise, time_B):
    angle = jnp.pi / 2 * spread(time_B, x0.ndim)
    return jnp.cos(angle) * x0 + jnp.sin(angle) * noise


def shown(config, x_t, time_B):
    return x_t, 1000 * time_B


def target(config, x0, noise, time_B):
    return corrupt(config, noise, -x0, time_B)


def weight(config, time_B):
    return jnp.ones(time_B.shape)


def to_x0(config, prediction, x_t, time_B):
    return corrupt(config, x_t, -prediction, time_B)


def levels(config):
    return np.linspace(1, 0, config.sample_steps + 1)[:-1].astype(np.float32)


def sample(config, denoise, noise, key=None):
    x = noise
    for now, then in zip(levels(config), [*levels(config)[1:], np.float32(0)], strict=True):
        time_B = jnp.full((len(x),), now)
        x0 = denoise(x, time_B, jnp.float32(config.guidance))
        noise = (x - corrupt(config, x0, 0, time_B)) / np.sin(np.pi / 2 * now)
        x = corrupt(config, x0, noise, jnp.full((len(x),), then))
    return x


register("noise", "cosine", CosineConfig, sys.modules[__name__])
