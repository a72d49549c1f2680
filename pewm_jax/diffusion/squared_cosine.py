"""DDPM in a few levels with cosine noise, for short vectors such as a policy's waypoints.

The levels are those of Nichol and Dhariwal 2021 (arXiv 2102.09672, Eq. 17; ``squaredcos_cap_v2`` in
diffusers). The network predicts the noise, and every level is visited once, from the noisiest down
(Ho et al. 2020, Alg. 2), with the estimate of the clean vector clipped to [−1, 1]. Equal to
``DDPMScheduler`` with ``prediction_type="epsilon"``, ``clip_sample=True`` and as many steps as
levels. ``levels`` is their number; time is an integer from 0, the least noise, to levels − 1.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config.parts import Noise
from pewm_jax.types import Array

OFFSET = 0.008
LARGEST = 0.999
"""Share of the signal that one level may take away."""


def alphas_cumprod(levels: int) -> np.ndarray:
    """Return (levels,) ᾱ, the share of the signal's variance that is left, decreasing."""
    at = np.arange(levels + 1) / levels
    whole = np.cos((at + OFFSET) / (1 + OFFSET) * np.pi / 2) ** 2
    return np.cumprod(1 - np.minimum(1 - whole[1:] / whole[:-1], LARGEST))


def corrupt(levels: int, clean: Array, noise: Array, time_B: Array) -> Array:
    """Return √ᾱ · clean + √(1 − ᾱ) · noise of (B, …) vectors at the levels (B,)."""
    alphas = alphas_cumprod(levels)
    kept, added = (jnp.asarray(np.sqrt(x), jnp.float32)[time_B] for x in (alphas, 1 - alphas))
    return Noise.expand(kept, clean.ndim) * clean + Noise.expand(added, clean.ndim) * noise


def back(levels: int, predicted: Array, noisy: Array, time: Array, noise: Array) -> Array:
    """Return the vector one level less noisy; from level 0 the clean estimate.

    ``predicted`` is the network's noise, ``noise`` fresh standard normal noise, unused at level 0.
    """
    alphas = alphas_cumprod(levels)
    before = np.append(1.0, alphas[:-1])
    step = alphas / before
    table = np.stack(
        [
            np.sqrt(alphas),
            np.sqrt(1 - alphas),
            np.sqrt(before) * (1 - step) / (1 - alphas),
            np.sqrt(step) * (1 - before) / (1 - alphas),
            np.sqrt((1 - before) / (1 - alphas) * (1 - step)),
        ],
        -1,
    )
    kept, added, of_clean, of_noisy, fresh = jnp.asarray(table, jnp.float32)[time]
    clean = jnp.clip((noisy - added * predicted) / kept, -1, 1)
    return of_clean * clean + of_noisy * noisy + fresh * noise


def sample(
    levels: int, predict: Callable[[Array, Array], Array], shape: tuple[int, ...], key: Array
) -> Array:
    """Sample a vector of a shape from noise, with ``predict(noisy, time) -> noise``."""
    start, rest = jax.random.split(key)

    def step(noisy: Array, time: Array) -> tuple[Array, None]:
        noise = jax.random.normal(jax.random.fold_in(rest, time), shape)
        return back(levels, predict(noisy, time), noisy, time, noise), None

    return jax.lax.scan(step, jax.random.normal(start, shape), jnp.arange(levels)[::-1])[0]
