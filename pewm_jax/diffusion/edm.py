"""EDM: continuous noise σ with preconditioning (Karras et al. 2022, arXiv 2206.00364).

The network F gets c_in x and log σ / 4. Clean latents are c_skip x + c_out F (Eq. 7 and Table 1
there), so input and target have unit variance at every σ. A network may predict v = −F instead.

With the target ``flow`` all of this is flow matching at the time τ = σ / (1 + σ): the network gets
x / (1 + σ) = (1 − τ) x0 + τ ε and τ, and predicts ε − x0.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import EDMConfig
from pewm_jax.diffusion.noise import Denoiser, spread
from pewm_jax.types import Array


def draw(config: EDMConfig, key: Array, batch: int, frames: int) -> Array:
    """Draw (B,) σ, log-normal."""
    del frames
    return jnp.exp(config.log_mean + config.log_std * jax.random.normal(key, (batch,)))


def corrupt(config: EDMConfig, x0: Array, noise: Array, time_B: Array) -> Array:
    """Return x0 + σ ε."""
    del config
    return x0 + spread(time_B, x0.ndim) * noise


def _scales(config: EDMConfig, sigma: Array) -> tuple[Array, Array, Array]:
    """Return c_skip, c_out and c_in."""
    data = config.sigma_data
    if config.target == "flow":
        return 1 / (1 + sigma), sigma / (1 + sigma), 1 / (1 + sigma)
    total = sigma**2 + data**2
    return data**2 / total, sigma * data / jnp.sqrt(total), 1 / jnp.sqrt(total)


def shown(config: EDMConfig, x_t: Array, time_B: Array) -> tuple[Array, Array]:
    """Return c_in x and log σ / 4, or σ / (1 + σ)."""
    _, _, scale = _scales(config, spread(time_B, x_t.ndim))
    told = time_B / (1 + time_B) if config.target == "flow" else jnp.log(time_B) / 4
    return scale * x_t, told


def target(config: EDMConfig, x0: Array, noise: Array, time_B: Array) -> Array:
    """Return F = (x0 − c_skip x_t) / c_out, or −F."""
    skip, out, _ = _scales(config, spread(time_B, x0.ndim))
    return _sign(config) * (x0 - skip * corrupt(config, x0, noise, time_B)) / out


def weight(config: EDMConfig, time_B: Array) -> Array:
    """Return 1: λ(σ) c_out² = 1 in the weighting of the error of x0 that the papers use."""
    del config
    return jnp.ones(time_B.shape)


def to_x0(config: EDMConfig, prediction: Array, x_t: Array, time_B: Array) -> Array:
    """Return c_skip x + c_out F, where F is the prediction or, of v and flow, its negative."""
    skip, out, _ = _scales(config, spread(time_B, x_t.ndim))
    return skip * x_t + _sign(config) * out * prediction


def _sign(config: EDMConfig) -> int:
    """Return the factor between F and what the network predicts."""
    return {"edm": 1, "v": -1, "flow": -1}[config.target]


def levels(config: EDMConfig) -> np.ndarray:
    """Return (sample_steps,) σ from sigma_max to sigma_min (Eq. 5 of the paper)."""
    high, low = config.sigma_max ** (1 / config.rho), config.sigma_min ** (1 / config.rho)
    share = np.linspace(0, 1, config.sample_steps)
    return (high + share * (low - high)) ** config.rho


def sample(config: EDMConfig, denoise: Denoiser, noise: Array, key: Array | None = None) -> Array:
    """Follow the probability-flow ODE dx/dσ = (x − x0)/σ by Euler's or Heun's method (Alg. 1)."""
    del key
    sigmas = np.asarray(levels(config), np.float32)

    def slope(x: Array, sigma: Array | float) -> Array:
        x0 = denoise(x, jnp.full((x.shape[0],), sigma), jnp.float32(config.guidance))
        return (x - x0) / sigma

    def step(x: Array, row: tuple[Array, Array]) -> tuple[Array, None]:
        now, then = row
        first = slope(x, now)
        moved = x + (then - now) * first
        if config.sampler == "heun":
            moved = x + (then - now) * (first + slope(moved, then)) / 2
        return moved.astype(x.dtype), None

    deviation = sigmas[0]
    if config.target == "v":
        deviation = np.sqrt(deviation**2 + np.float32(config.sigma_data) ** 2)
    start = (noise * deviation).astype(noise.dtype)
    x, _ = jax.lax.scan(step, start, (jnp.asarray(sigmas[:-1]), jnp.asarray(sigmas[1:])))
    if config.ends == "sigma_min":
        return x
    return (x - sigmas[-1] * slope(x, sigmas[-1])).astype(noise.dtype)  # Euler's, to σ = 0
