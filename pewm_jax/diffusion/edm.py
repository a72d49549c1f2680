"""EDM: continuous noise σ with preconditioning (Karras et al. 2022, arXiv 2206.00364).

The network F gets c_in x and log σ / 4. Clean latents are c_skip x + c_out F (Eq. 7 and Table 1
there), so input and target have unit variance at every σ. A network may predict v = −F instead.

With the target ``flow`` all of this is flow matching at the time τ = σ / (1 + σ): the network gets
x / (1 + σ) = (1 − τ) x0 + τ ε and τ, and predicts ε − x0.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config.parts import Denoiser, Noise
from pewm_jax.errors import require, require_positive
from pewm_jax.types import Array


@dataclasses.dataclass(frozen=True)
class EDMConfig(Noise):
    """Continuous noise σ with preconditioning (Karras et al. 2022, arXiv 2206.00364)."""

    STARTS: ClassVar[bool] = True

    sigma_data: float = 0.5
    """Standard deviation of clean latents: about 1 for the codec `learned`, of which
    `pewm-jax evaluate` prints it."""
    sigma_min: float = 0.002
    """Smallest σ in sampling."""
    sigma_max: float = 80.0
    """Largest σ in sampling."""
    rho: float = 7.0
    """Exponent of the sampler's steps; larger values place more of them at small σ."""
    log_mean: float = -1.2
    """Mean of log σ in training."""
    log_std: float = 1.2
    """Standard deviation of log σ in training."""
    target: Literal["edm", "v", "flow"] = "edm"
    """What the network predicts. `edm`: F of the paper; `v`: −F, as in Stable Video Diffusion
    (with sigma_data 1 it is v of DDPM). Samples then start with deviation √(σ_max² + sigma_data²),
    that of noisy latents, instead of σ_max. `flow`: the velocity ε − x0 of latents x / (1 + σ), at
    time σ / (1 + σ), as in Cosmos-Predict2; sigma_data is 1."""
    sample_steps: int = 18
    """Steps of the sampler."""
    ends: Literal["clean", "sigma_min"] = "clean"
    """Where the sampler ends: at clean latents, or as in Cosmos-Predict2 at latents with the noise
    sigma_min, one evaluation of the network less."""
    sampler: Literal["euler", "heun"] = "euler"
    """`euler`: first order, one evaluation of the denoiser per step. `heun`: second order, two."""
    rendered_until: float = 0.0
    """σ down to which sampling keeps the latents that the rendered memory covers at those of the
    rendering, with the noise of each level; below it they are free. Holes start from pure noise. 0:
    everything starts from pure noise. Training does not depend on it. About 1 lets the model revise
    what the memory shows but not move it."""
    temperature: float = 1.0
    """Factor of the noise that the sampler starts from; below 1 samples vary less and are more
    likely ones (reduced temperature, arXiv 1807.03039)."""
    guidance: float = 1.0
    """Classifier-free guidance on the memory (in the world egowm: on the observed image, or on the
    text of Cosmos): 1 = off, above 1 pushes away from 'no memory'."""

    def __post_init__(self):
        """Validate."""
        require_positive(self, "noise", "sample_steps")
        require(
            0 < self.sigma_min < self.sigma_max,
            f"noise.sigma_min {self.sigma_min} and noise.sigma_max {self.sigma_max} need "
            "0 < min < max.",
        )
        require(
            min(self.sigma_data, self.rho) > 0 and self.log_std >= 0,
            "noise.sigma_data and noise.rho must be above 0, and noise.log_std at least 0.",
        )
        require(
            0 <= self.temperature <= 1,
            f"noise.temperature is {self.temperature}: use a factor from 0 to 1.",
        )
        require(
            self.rendered_until >= 0,
            f"noise.rendered_until is {self.rendered_until}: use a σ above 0, or 0 for never.",
        )
        require(
            self.target != "flow" or self.sigma_data == 1,
            f"noise.sigma_data is {self.sigma_data}: noise.target flow goes with 1.",
        )
        require(
            self.ends != "sigma_min" or self.sample_steps >= 2,
            "noise.sample_steps is 1: with noise.ends sigma_min use at least 2, or nothing is "
            "denoised.",
        )

    def check(self, model: Any) -> None:
        """Refuse to keep latents of a memory that is not rendered in colours."""
        super().check(model)
        memory = model.memory
        require(
            not self.rendered_until
            or (memory.REMEMBERS and not memory.KEEPS_FEATURES and memory.reader.READS_VIEW),
            f"noise.rendered_until is {self.rendered_until}, and this model's memory is not "
            "rendered in colours: use memory.kind surfels with memory.reader.kind render, or 0.",
        )

    @property
    def velocity_in_unit_time(self) -> bool:
        """Whether the network gets times from 0 to 1 and predicts the velocity ε − x0."""
        return self.target == "flow"

    def draw(self, key: Array, batch: int, frames: int) -> Array:
        """Draw (B,) σ, log-normal."""
        del frames
        return jnp.exp(self.log_mean + self.log_std * jax.random.normal(key, (batch,)))

    def corrupt(self, x0: Array, noise: Array, time_B: Array) -> Array:
        """Return x0 + σ ε."""
        return x0 + self.expand(time_B, x0.ndim) * noise

    def precondition(self, x_t: Array, time_B: Array) -> tuple[Array, Array]:
        """Return c_in x and log σ / 4, or σ / (1 + σ)."""
        _, _, scale = self._scales(self.expand(time_B, x_t.ndim))
        time = time_B / (1 + time_B) if self.target == "flow" else jnp.log(time_B) / 4
        return scale * x_t, time

    def prediction_target(self, x0: Array, noise: Array, time_B: Array) -> Array:
        """Return F = (x0 − c_skip x_t) / c_out, or −F."""
        skip, out, _ = self._scales(self.expand(time_B, x0.ndim))
        return self._sign() * (x0 - skip * self.corrupt(x0, noise, time_B)) / out

    def weight(self, time_B: Array) -> Array:
        """Return 1: λ(σ) c_out² = 1 in the weighting of the error of x0 that the papers use."""
        return jnp.ones(time_B.shape)

    def to_x0(self, prediction: Array, x_t: Array, time_B: Array) -> Array:
        """Return c_skip x + c_out F, where F is the prediction or, of v and flow, its negative."""
        skip, out, _ = self._scales(self.expand(time_B, x_t.ndim))
        return skip * x_t + self._sign() * out * prediction

    def levels(self) -> np.ndarray:
        """Return (sample_steps,) σ from sigma_max to sigma_min (Eq. 5 of the paper)."""
        high, low = self.sigma_max ** (1 / self.rho), self.sigma_min ** (1 / self.rho)
        share = np.linspace(0, 1, self.sample_steps)
        return (high + share * (low - high)) ** self.rho

    def sample(
        self,
        denoise: Denoiser,
        noise: Array,
        key: Array | None = None,
        *,
        held: tuple[Array, Array] | None = None,
        start: Array | None = None,
    ) -> Array:
        """Follow the probability-flow ODE by Euler's or Heun's method (Alg. 1).

        Sampling starts from noise times ``temperature``, added to the latents ``start``, if given
        (SDEdit, Meng et al. 2022, arXiv 2108.01073).

        The ODE is dx/dσ = (x − x0) / σ. ``held`` is (B, t, …) latents and a mask that broadcasts
        with them: where it is True, x is latents + σ · noise at every σ ≥ ``rendered_until``. As
        the level is that of the whole clip, the network gets inputs as in training.
        """
        del key
        sigmas = np.asarray(self.levels(), np.float32)
        if self.temperature != 1:
            noise = noise * self.temperature

        def kept(x: Array, sigma: Array | float) -> Array:
            if held is None:
                return x
            latents, covered = held
            there = covered & (sigma >= self.rendered_until)
            return jnp.where(there, latents + sigma * noise, x).astype(x.dtype)

        def slope(x: Array, sigma: Array | float) -> Array:
            x0 = denoise(x, jnp.full((x.shape[0],), sigma), jnp.float32(self.guidance))
            return (x - x0) / sigma

        def step(x: Array, row: tuple[Array, Array]) -> tuple[Array, None]:
            now, then = row
            first = slope(x, now)
            moved = x + (then - now) * first
            if self.sampler == "heun":
                moved = x + (then - now) * (first + slope(kept(moved, then), then)) / 2
            return kept(moved.astype(x.dtype), then), None

        deviation = sigmas[0]
        if self.target == "v":
            deviation = np.sqrt(deviation**2 + np.float32(self.sigma_data) ** 2)
        first = noise * deviation if start is None else start + noise * deviation
        first = kept(first.astype(noise.dtype), sigmas[0])
        x, _ = jax.lax.scan(step, first, (jnp.asarray(sigmas[:-1]), jnp.asarray(sigmas[1:])))
        if self.ends == "sigma_min":
            return x
        return (x - sigmas[-1] * slope(x, sigmas[-1])).astype(noise.dtype)  # Euler's, to σ = 0

    def _scales(self, sigma: Array) -> tuple[Array, Array, Array]:
        """Return c_skip, c_out and c_in."""
        data = self.sigma_data
        if self.target == "flow":
            return 1 / (1 + sigma), sigma / (1 + sigma), 1 / (1 + sigma)
        total = sigma**2 + data**2
        return data**2 / total, sigma * data / jnp.sqrt(total), 1 / jnp.sqrt(total)

    def _sign(self) -> int:
        """Return the factor between F and what the network predicts."""
        return {"edm": 1, "v": -1, "flow": -1}[self.target]
