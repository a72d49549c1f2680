"""Samplers under ``lax.scan``: DDIM and SDE-DPM-Solver++ (2M), as in CogVideoX's schedulers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import DDPMConfig
from pewm_jax.diffusion import solver
from pewm_jax.types import Array

Denoiser: TypeAlias = Callable[[Array, Array], Array]
"""``(x_t, timesteps_B) -> x0``; ``schedule.to_x0`` converts predictions of v or ε."""


def ddim(config: DDPMConfig, denoise: Denoiser, noise: Array, *, every_step: bool = False) -> Array:
    """Sample by DDIM (Song et al. 2021, η = 0; ``CogVideoXDDIMScheduler``).

    Args:
        config: schedule and steps; its ``sampler`` is not looked at.
        denoise: ``(x_t, timesteps_B) -> x0``.
        noise: (B, …) standard normal start.
        every_step: return what is held after every step, (sample_steps, B, …).

    Returns:
        (B, …) the sample.
    """
    rows = solver.steps(dataclasses.replace(config, sampler="ddim"))
    return _follow(rows, _plain(denoise), noise, every_step=every_step)


def dpm(
    config: DDPMConfig,
    denoise: Denoiser,
    noise: Array,
    key: Array | None = None,
    *,
    step_noise: Array | None = None,
    every_step: bool = False,
) -> Array:
    """Sample by SDE-DPM-Solver++ (2M) (Lu et al. 2022; ``CogVideoXDPMScheduler``).

    Args:
        config: schedule and steps; its ``sampler`` is not looked at.
        denoise: ``(x_t, timesteps_B) -> x0``.
        noise: (B, …) standard normal start.
        key: randomness of the fresh noise; step k draws from ``fold_in(key, k)``.
        step_noise: (sample_steps, B, …) the fresh noise itself, in place of a key.
        every_step: return what is held after every step, (sample_steps, B, …).

    Returns:
        (B, …) the sample.

    Raises:
        ValueError: both or neither of key and step_noise are given, or step_noise has a wrong
            shape.
    """
    if (key is None) == (step_noise is None):
        raise ValueError("dpm() draws fresh noise at every step: give it a key, or step_noise.")
    shape = (config.sample_steps, *noise.shape)
    if step_noise is not None and step_noise.shape != shape:
        raise ValueError(f"dpm() got step_noise of shape {step_noise.shape}; it needs {shape}.")
    if step_noise is None:
        fresh = _draw(key, noise)
    else:
        given = jnp.asarray(step_noise)
        fresh = given.__getitem__
    rows = solver.steps(dataclasses.replace(config, sampler="dpm"))
    return _follow(rows, _plain(denoise), noise, fresh, every_step=every_step)


def sample(
    config: DDPMConfig,
    denoise: Callable[[Array, Array, Array], Array],
    noise: Array,
    key: Array | None = None,
) -> Array:
    """Sample with the configured sampler.

    Args:
        config: schedule, sampler and steps.
        denoise: ``(x_t, timesteps_B, weight) -> x0``; the last is the weight of guidance (see
            ``schedule.guidance``).
        noise: (B, …) standard normal start.
        key: randomness of the steps; only the sampler dpm needs it.

    Returns:
        (B, …) the sample.

    Raises:
        ValueError: the sampler is dpm and there is no key.
    """
    if config.sampler == "ddim":
        return _follow(solver.steps(config), denoise, noise)
    if key is None:
        raise ValueError("noise.sampler dpm draws fresh noise at every step: give it a key.")
    return _follow(solver.steps(config), denoise, noise, _draw(key, noise))


def _plain(denoise: Denoiser) -> Callable[[Array, Array, Array], Array]:
    """Make a denoiser accept, and ignore, the weight of guidance."""
    return lambda x, timesteps, _weight: denoise(x, timesteps)


def _draw(key: Array, like: Array) -> Callable[[Array], Array]:
    """Return a function from a step's number to its standard normal noise."""
    return lambda k: jax.random.normal(jax.random.fold_in(key, k), like.shape, like.dtype)


def _follow(
    rows: solver.Steps,
    denoise: Callable[[Array, Array, Array], Array],
    start: Array,
    fresh: Callable[[Array], Array] | None = None,
    *,
    every_step: bool = False,
) -> Array:
    """Scan the update of ``solver`` over its rows; ``fresh(k)`` is the noise added at step k."""

    def step(carry, inputs):
        x, earlier = carry
        row, k = inputs
        x0 = denoise(x, jnp.full((x.shape[0],), row.timestep), row.guidance).astype(jnp.float32)
        if fresh is None:
            x = row.keep * x + row.add * x0
        else:
            ahead = (1 + row.mix) * x0 - row.mix * earlier
            x = row.keep * x + row.add * ahead + row.spread * fresh(k)
            earlier = x0
        x = x.astype(start.dtype)
        return (x, earlier), x if every_step else None

    first = (start, None if fresh is None else jnp.zeros(start.shape, jnp.float32))
    inputs = (jax.tree.map(jnp.asarray, rows), np.arange(rows.timestep.shape[0]))
    (sample, _), path = jax.lax.scan(step, first, inputs)
    return path if every_step else sample
