"""DDPM: discrete noise levels ᾱ, as in CogVideoX.

The schedule is CogVideoX's: scaled-linear betas, an optional SNR shift, rescaled to zero terminal
SNR (Lin et al. 2023, arXiv 2305.08891, Alg. 1). DDIM and SDE-DPM-Solver++ (2M) share one update::

    x ← keep · x + add · ((1 + mix) · x0 − mix · x0 of the step before) + spread · fresh noise

Schedule and coefficients depend on the noise levels only. They are computed in float64 before
tracing, so that levels without signal or without noise, whose log-SNR is infinite, need no special
case under ``lax.scan``. References: ``scheduling_ddim_cogvideox.py`` and
``scheduling_dpm_cogvideox.py`` in ``diffusers/schedulers/``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config.parts import Denoiser, Noise
from pewm_jax.errors import require
from pewm_jax.types import Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Steps:
    """The coefficients of every sampling step, or of one.

    Attributes:
        timestep: (steps,) int32 noise level given to the denoiser.
        keep: (steps,) weight of the present sample.
        add: (steps,) weight of the clean sample.
        mix: (steps,) extrapolation of the clean sample from the step before.
        spread: (steps,) weight of fresh noise.
        guidance: (steps,) weight of guidance.
    """

    timestep: Array
    keep: Array
    add: Array
    mix: Array
    spread: Array
    guidance: Array


@dataclasses.dataclass(frozen=True)
class DDPMConfig(Noise):
    """Discrete noise levels ᾱ, as in CogVideoX: schedule, prediction target and sampler."""

    train_steps: int = 1000
    """Noise levels of the schedule."""
    beta_start: float = 0.00085
    """First β of the scaled-linear schedule."""
    beta_end: float = 0.012
    """Last β of the scaled-linear schedule."""
    snr_shift: float = 1.0
    """CogVideoX's SNR shift s: ᾱ → ᾱ / (s + (1 − s) ᾱ). 3 for its 2B model, 1 for 5B."""
    zero_terminal_snr: bool = True
    """Rescale the schedule so that the last step is pure noise."""
    target: Literal["x0", "v", "eps"] = "x0"
    """What the network predicts. x0 for the pixel codec, v for VAE latents."""
    max_weight: float = 5.0
    """Upper bound of the loss weight 1 / (1 − ᾱ) on the squared error of x0 (= MSE in v)."""
    sample_steps: int = 10
    """Evaluations of the denoiser per clip."""
    sampler: Literal["ddim", "dpm"] = "ddim"
    """`ddim`: deterministic (η = 0). `dpm`: DPM-Solver++ (2M) with fresh noise at every step."""
    spacing: Literal["trailing", "leading", "linspace"] = "trailing"
    """Which noise levels are visited. Only trailing starts at pure noise for any sample_steps."""
    steps_offset: int = 0
    """Number added to every visited level, with leading spacing."""
    stride: Literal["next", "fixed"] = "next"
    """Where a step leads: to the `next` visited level, or by a `fixed` train_steps // sample_steps
    levels down, as in CogVideoX's schedulers. They differ only if sample_steps does not divide
    train_steps; then a fixed stride does not land on the levels that the denoiser gets."""
    set_alpha_to_one: bool = True
    """Whether the last step ends at a clean sample, or at noise level 0, which is almost clean."""
    guidance: float = 1.0
    """Classifier-free guidance on the memory (in the world egowm: on the observed image, or on the
    text of Cosmos): 1 = off, above 1 pushes away from 'no memory'."""
    dynamic_guidance: bool = False
    """Vary the guidance with the training level t, as CogVideoX's pipelines do:
    1 + g (1 − cos(π ((N − t) / N)⁵)) / 2 with N = sample_steps."""

    def __post_init__(self):
        """Validate."""
        require(
            0 < self.beta_start < self.beta_end < 1,
            "noise.beta_start and beta_end need 0 < start < end < 1.",
        )
        require(
            1 <= self.sample_steps <= self.train_steps,
            f"noise.sample_steps is {self.sample_steps}: use 1 to {self.train_steps} "
            "(noise.train_steps).",
        )
        require(
            self.train_steps >= 2,
            f"noise.train_steps is {self.train_steps}: a schedule needs at least 2 noise "
            "levels; use 1000.",
        )
        stride = self.train_steps // self.sample_steps
        require(
            self.spacing != "leading"
            or 0 <= self.steps_offset < self.train_steps - stride * (self.sample_steps - 1),
            f"noise.steps_offset is {self.steps_offset}: with {self.sample_steps} leading "
            f"steps use 0 to {self.train_steps - 1 - stride * (self.sample_steps - 1)}, or the "
            "first step would lie outside of the schedule.",
        )
        require(self.snr_shift > 0, "noise.snr_shift must be above 0.")
        require(self.max_weight > 0, "noise.max_weight must be above 0.")
        require(
            not (self.target == "eps" and self.zero_terminal_snr),
            "noise.target eps cannot be used with zero_terminal_snr: at the last step the "
            "input is pure noise and x0 cannot be recovered from ε; use v or x0, or switch "
            "zero_terminal_snr off.",
        )

    def draw(self, key: Array, batch: int, frames: int) -> Array:
        """Draw (B,) levels uniformly."""
        del frames
        return jax.random.randint(key, (batch,), 0, self.train_steps)

    def corrupt(self, x0: Array, noise: Array, time_B: Array) -> Array:
        """Return x_t = √ᾱ x0 + √(1 − ᾱ) ε."""
        a, b = self._coefficients(time_B, x0.ndim)
        return a * x0 + b * noise

    def precondition(self, x_t: Array, time_B: Array) -> tuple[Array, Array]:
        """Return x_t unchanged, and the level."""
        return x_t, time_B

    def prediction_target(self, x0: Array, noise: Array, time_B: Array) -> Array:
        """Return x0, ε, or v = √ᾱ ε − √(1 − ᾱ) x0."""
        a, b = self._coefficients(time_B, x0.ndim)
        return {"x0": x0, "eps": noise, "v": a * noise - b * x0}[self.target]

    def weight(self, time_B: Array) -> Array:
        """Return min(1 / (1 − ᾱ), max_weight) for the target x0, else 1.

        With these weights the error of x0 equals the error of v.
        """
        if self.target != "x0":
            return jnp.ones(time_B.shape)
        weight = np.minimum(1 / (1 - self.alphas_cumprod()), self.max_weight)
        return jnp.asarray(weight, jnp.float32)[time_B]

    def to_x0(self, prediction: Array, x_t: Array, time_B: Array) -> Array:
        """Turn a prediction of the configured target into x0."""
        a, b = self._coefficients(time_B, x_t.ndim)
        if self.target == "x0":
            return prediction
        if self.target == "v":
            return a * x_t - b * prediction
        return (x_t - b * prediction) / a

    def levels(self) -> np.ndarray:
        """Return (sample_steps,) int32 visited levels, descending (Lin et al. 2023, Table 2).

        Trailing spacing begins at the last training level. (In the reference, rounding adds a
        further level, −1, for 62 of 1000 counts.)
        """
        count, total = self.sample_steps, self.train_steps
        if self.spacing == "linspace":
            levels = np.round(np.linspace(0, total - 1, count))[::-1]
        elif self.spacing == "leading":
            levels = np.arange(count)[::-1] * (total // count) + self.steps_offset
        else:
            levels = np.round(np.arange(total, 0, -total / count)[:count]) - 1
        return levels.astype(np.int32)

    def sample(
        self,
        denoise: Denoiser,
        noise: Array,
        key: Array | None = None,
        *,
        step_noise: Array | None = None,
        every_step: bool = False,
    ) -> Array:
        """Sample with the configured sampler; see ``Noise.sample``.

        Args:
            denoise: ``(x_t, levels_B, weight) -> x0``; the weights are ``guidance_weights``.
            noise: (B, …) standard normal start.
            key: randomness of the fresh noise of ``dpm``; step k draws from ``fold_in(key, k)``.
            step_noise: (sample_steps, B, …) the fresh noise itself, instead of a key.
            every_step: return the sample after every step, (sample_steps, B, …).

        Raises:
            ValueError: the sampler is dpm and both or neither of key and step_noise are given, or
                step_noise has another shape.
        """
        if self.sampler == "ddim":
            return follow(self.steps(), denoise, noise, every_step=every_step)
        if (key is None) == (step_noise is None):
            raise ValueError(
                "noise.sampler dpm draws fresh noise at every step: give it a key, or step_noise."
            )
        shape = (self.sample_steps, *noise.shape)
        if step_noise is not None and step_noise.shape != shape:
            raise ValueError(f"step_noise has the shape {step_noise.shape}; it needs {shape}.")

        def drawn(k: Array) -> Array:
            assert key is not None
            return jax.random.normal(jax.random.fold_in(key, k), noise.shape, noise.dtype)

        fresh = drawn if step_noise is None else jnp.asarray(step_noise).__getitem__
        return follow(self.steps(), denoise, noise, fresh, every_step=every_step)

    def alphas_cumprod(self) -> np.ndarray:
        """Return (train_steps,) ᾱ from almost 1 down to exactly 0 (zero terminal SNR)."""
        root = np.linspace(self.beta_start**0.5, self.beta_end**0.5, self.train_steps)
        alphas = np.cumprod(1 - root**2)
        alphas = alphas / (self.snr_shift + (1 - self.snr_shift) * alphas)
        if self.zero_terminal_snr:
            signal = np.sqrt(alphas)
            signal = (signal - signal[-1]) * signal[0] / (signal[0] - signal[-1])
            alphas = signal**2
        return alphas

    def guidance_weights(self) -> np.ndarray:
        """Return (sample_steps,) the weights of guidance at the visited levels.

        They are constant or, with ``dynamic_guidance``, CogVideoX's
        1 + g (1 − cos(π ((N − t) / N)⁵)) / 2
        (``diffusers/pipelines/cogvideo/pipeline_cogvideox.py``). There, as here, N counts sampling
        steps but t is a training level, so the weight jumps between 1 and 1 + g from step to step.
        """
        count = self.sample_steps
        if not self.dynamic_guidance:
            return np.full(count, self.guidance)
        share = (count - self.levels().astype(np.float64)) / count
        return 1 + self.guidance * (1 - np.cos(np.pi * share**5)) / 2

    def steps(self) -> Steps:
        """Return the float32 coefficients of the configured sampler, in the order of the steps."""
        levels = self.levels()
        rows = {"ddim": _ddim, "dpm": _dpm}[self.sampler](*self.signal_power())
        weights = (*rows, self.guidance_weights())
        return Steps(levels, *(np.asarray(row, np.float32) for row in weights))

    def signal_power(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (steps,) ᾱ of each visited level, of the next one, and of the previous one.

        The previous one is NaN where a step must be of first order: at the first step, and at the
        last one, which leaves the schedule.
        """
        alphas = self.alphas_cumprod()
        levels = self.levels()
        if self.stride == "next":
            targets = np.append(levels[1:], -1)
        else:
            targets = levels - self.train_steps // self.sample_steps
        end = 1.0 if self.set_alpha_to_one else alphas[0]
        after = np.where(targets >= 0, alphas[targets], end)
        before = np.append(np.nan, alphas[levels[:-1]])
        return alphas[levels], after, np.where(targets >= 0, before, np.nan)

    def _coefficients(self, time_B: Array, ndim: int) -> tuple[Array, Array]:
        """Return √ᾱ and √(1 − ᾱ) of shape (B, 1, …), or (B, t, 1, …)."""
        alphas = self.alphas_cumprod()
        signal = jnp.asarray(np.sqrt(alphas), jnp.float32)[time_B]
        noise = jnp.asarray(np.sqrt(1 - alphas), jnp.float32)[time_B]
        return self.expand(signal, ndim), self.expand(noise, ndim)


Rows = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _ddim(now: np.ndarray, after: np.ndarray, _before: np.ndarray) -> Rows:
    """DDIM with η = 0 (Song et al. 2021, Eq. 12)."""
    keep = np.sqrt((1 - after) / np.maximum(1 - now, 1e-12))
    add = np.sqrt(after) - np.sqrt(now) * keep
    return keep, add, np.zeros_like(now), np.zeros_like(now)


def _dpm(now: np.ndarray, after: np.ndarray, before: np.ndarray) -> Rows:
    """SDE-DPM-Solver++ (2M) (Lu et al. 2022, arXiv 2211.01095), finite at ᾱ = 0 and 1."""
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
    denoise: Denoiser,
    start: Array,
    fresh: Callable[[Array], Array] | None = None,
    *,
    every_step: bool = False,
) -> Array:
    """Scan the update over all steps from (B, …) standard normal noise.

    ``denoise`` is ``(x_t, levels_B, weight) -> x0``; ``fresh(k)`` is the noise that step k adds,
    None for a sampler that adds none. ``every_step`` returns (steps, B, …), the sample after every
    step.
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
