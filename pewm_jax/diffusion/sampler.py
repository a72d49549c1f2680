"""Sampling under ``lax.scan``: DDIM and SDE-DPM-Solver++ (2M) share one update rule.

    x ← keep · x + add · ((1 + mix) · x0 − mix · x0 of the step before) + spread · fresh noise

The four coefficients depend only on the noise levels. They are computed once, in float64, before
tracing. Levels without signal or without noise, where log-SNR is infinite, therefore need no
special case under ``lax.scan``. References: ``scheduling_ddim_cogvideox.py`` and
``scheduling_dpm_cogvideox.py`` in ``diffusers/schedulers/``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.types import Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Steps:
    """The coefficients of every sampling step, or of one.

    Attributes:
        timestep: (steps,) int32 noise level given to the denoiser.
        keep: (steps,) weight of the present sample.
        add: (steps,) weight of the clean sample.
        mix: (steps,) how far the clean sample is extrapolated from the step before.
        spread: (steps,) weight of fresh noise.
        guidance: (steps,) weight of guidance.
    """

    timestep: Array
    keep: Array
    add: Array
    mix: Array
    spread: Array
    guidance: Array


def steps(
    kind: str,
    levels: np.ndarray,
    now: np.ndarray,
    after: np.ndarray,
    before: np.ndarray,
    guidance: np.ndarray,
) -> Steps:
    """Return the coefficients of a sampler, float32, in the order of the steps.

    Args:
        kind: ``ddim`` or ``dpm``.
        levels: (steps,) the visited noise levels.
        now: (steps,) ᾱ of each visited level.
        after: (steps,) ᾱ of the level that each step leads to.
        before: (steps,) ᾱ of the level visited before; NaN where a step must be of first order.
        guidance: (steps,) the weights of guidance.
    """
    rows = {"ddim": _ddim, "dpm": _dpm}[kind](now, after, before)
    return Steps(levels, *(np.asarray(row, np.float32) for row in (*rows, guidance)))


Rows = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _ddim(now: np.ndarray, after: np.ndarray, _before: np.ndarray) -> Rows:
    """DDIM with η = 0 (Song et al. 2021, Eq. 12)."""
    keep = np.sqrt((1 - after) / np.maximum(1 - now, 1e-12))
    add = np.sqrt(after) - np.sqrt(now) * keep
    return keep, add, np.zeros_like(now), np.zeros_like(now)


def _dpm(now: np.ndarray, after: np.ndarray, before: np.ndarray) -> Rows:
    """SDE-DPM-Solver++ (2M) (Lu et al. 2022, arXiv 2211.01095).

    With h the increase of log-SNR/2, exp(−h) is written as a ratio that is finite for ᾱ = 0 and 1.
    """
    decay = np.sqrt(now * (1 - after) / (after * (1 - now)))
    keep = np.sqrt((1 - after) / (1 - now)) * decay
    fresh = 1 - decay**2
    mix = np.zeros_like(now)
    for i in np.flatnonzero(~np.isnan(before)):
        if before[i] > 0:  # from pure noise the step is of first order: mix is 0
            mix[i] = (_rise(now[i], after[i]) / _rise(before[i], now[i])) / 2
    return keep, fresh * np.sqrt(after), mix, np.sqrt((1 - after) * fresh)


def _rise(low: float, high: float) -> float:
    """Return the increase of log-SNR/2 between two levels."""
    return 0.5 * (np.log(high / (1 - high)) - np.log(low / (1 - low)))


def follow(
    rows: Steps,
    denoise: Callable[[Array, Array, Array], Array],
    start: Array,
    fresh: Callable[[Array], Array] | None = None,
    *,
    every_step: bool = False,
) -> Array:
    """Scan the update over the steps.

    Args:
        rows: the coefficients of all steps.
        denoise: ``(x_t, levels_B, weight) -> x0``.
        start: (B, …) standard normal.
        fresh: ``fresh(k)`` is the noise that step k adds; None for a sampler that adds none.
        every_step: return the sample after every step, (steps, B, …), and not the last one alone.
    """

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
