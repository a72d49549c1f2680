"""The coefficients of a sampling step; DDIM and DPM-Solver++ share one update rule.

    x ← keep · x + add · ((1 + mix) · x0 − mix · x0 of the step before) + spread · fresh noise

The four coefficients depend only on the noise levels. They are computed once, in float64, before
tracing. Levels without signal or without noise, where log-SNR is infinite, therefore need no
special case under ``lax.scan``. References: ``scheduling_ddim_cogvideox.py`` and
``scheduling_dpm_cogvideox.py`` in ``diffusers/schedulers/``.
"""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from pewm_jax.config import DDPMConfig
from pewm_jax.diffusion import schedule
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


def steps(config: DDPMConfig) -> Steps:
    """Return the coefficients of the configured sampler, float32, in the order of the steps."""
    coefficients = {"ddim": _ddim, "dpm": _dpm}[config.sampler]
    levels = schedule.timesteps(config)
    now, after, before = signal_power(config)
    rows = coefficients(now, after, before)
    narrow = [np.asarray(row, np.float32) for row in (*rows, schedule.guidance(config))]
    return Steps(levels, *narrow)


def signal_power(config: DDPMConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (steps,) ᾱ of each visited level, of the next one, and of the previous one.

    The previous one is NaN where a step must be of first order: at the first step, and at the last
    one, which leaves the schedule.
    """
    alphas = schedule.alphas_cumprod(config)
    levels = schedule.timesteps(config)
    if config.stride == "next":
        targets = np.append(levels[1:], -1)
    else:
        targets = levels - config.train_steps // config.sample_steps
    end = 1.0 if config.set_alpha_to_one else alphas[0]
    after = np.where(targets >= 0, alphas[targets], end)
    before = np.append(np.nan, alphas[levels[:-1]])
    return alphas[levels], after, np.where(targets >= 0, before, np.nan)


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
