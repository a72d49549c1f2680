"""DDIM sampling under ``lax.scan`` (Song et al. 2021, η = 0; CogVideoX's trailing spacing)."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import Config, DiffusionConfig
from pewm_jax.diffusion import schedule
from pewm_jax.models import world_model
from pewm_jax.types import Array, MapTokens, Params


def ddim(config: DiffusionConfig, denoise: Callable[[Array, Array], Array], noise: Array) -> Array:
    """Sample by DDIM.

    Args:
        config: schedule and number of steps.
        denoise: ``(x_t, timesteps_B) -> x0``.
        noise: (B, …) standard normal start.

    Returns:
        (B, …) the sample.
    """
    alphas = schedule.alphas_cumprod(config)
    steps = schedule.trailing_steps(config)
    now = alphas[steps]
    after = np.append(alphas[steps[1:]], 1.0)
    keep = np.sqrt((1 - after) / np.maximum(1 - now, 1e-12))
    add = np.sqrt(after) - np.sqrt(now) * keep
    rows = (jnp.asarray(steps), jnp.asarray(keep, jnp.float32), jnp.asarray(add, jnp.float32))

    def step(x, row):
        timestep, keep, add = row
        x0 = denoise(x, jnp.full((x.shape[0],), timestep))
        return keep * x + add * x0, None

    sample, _ = jax.lax.scan(step, noise, rows)
    return sample


def sample(
    config: Config,
    params: Params,
    conditioning: world_model.Conditioning,
    tokens: MapTokens | None,
    noise_BthwC: Array,
) -> Array:
    """Sample one batch of clips' latents.

    With ``diffusion.guidance`` g ≠ 1 the prediction is x0(no map) + g·(x0(map) − x0(no map)).

    Args:
        config: the experiment.
        params: the world model's parameters.
        conditioning: observed frame, cameras, text.
        tokens: map tokens, or None for no memory.
        noise_BthwC: standard normal start.

    Returns:
        (B, t, h, w, C) latents.
    """
    guidance = config.diffusion.guidance

    def x0(x, timesteps, tokens):
        out = world_model.apply(config, params, x, conditioning, timesteps, tokens)
        return schedule.to_x0(config.diffusion, out, x, timesteps)

    def denoise(x, timesteps):
        with_map = x0(x, timesteps, tokens)
        if tokens is None or guidance == 1:
            return with_map
        without = x0(x, timesteps, None)
        return without + guidance * (with_map - without)

    return ddim(config.diffusion, denoise, noise_BthwC)
