"""Flow matching on straight paths (arXiv 2210.02747), with one time per clip or per latent frame.

``FlowConfig`` is x_t = (1 − t) x0 + t ε. ``FrameFlowConfig`` (PERSIST, arXiv 2603.03482) leaves a
little noise at t = 0 and may predict x0. A time per frame is diffusion forcing (arXiv 2407.01392).
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config.parts import Denoiser, Noise
from pewm_jax.errors import require, require_fields, require_positive
from pewm_jax.types import Array


@dataclasses.dataclass(frozen=True)
class FlowConfig(Noise):
    """Flow matching on straight paths: x_t = (1 − t) x0 + t ε, velocity ε − x0 (arXiv 2210.02747).

    Each latent frame may have its own time (diffusion forcing, arXiv 2407.01392).
    """

    shift: float = 1.0
    """Time shift s: t → s t / (1 + (s − 1) t); above 1 spends more steps near pure noise."""
    times: Literal["uniform", "logit_normal"] = "uniform"
    """Distribution of times in training."""
    per_frame: bool = False
    """Whether training draws one time per latent frame instead of one per clip."""
    scale: float = 1000.0
    """Factor of t in the network's time input."""
    sample_steps: int = 10
    """Steps of the sampler, by Euler's method."""
    temperature: float = 1.0
    """Factor of the noise that the sampler starts from; below 1 samples vary less and are more
    likely ones (reduced temperature, arXiv 1807.03039)."""
    guidance: float = 1.0
    """Classifier-free guidance on the memory (in the world egowm: on the observed image, or on the
    text of Cosmos): 1 = off, above 1 pushes away from 'no memory'."""

    def __post_init__(self):
        """Validate."""
        require_positive(self, "noise", "sample_steps")
        require_fields(self, "noise", lambda value: value > 0, "a number above 0", "shift", "scale")
        require_fields(self, "noise", lambda x: 0 <= x <= 1, "a factor from 0 to 1", "temperature")

    @property
    def velocity_in_unit_time(self) -> bool:
        """Whether the network gets times from 0 to 1 and predicts the velocity ε − x0."""
        return self.scale == 1

    def draw(self, key: Array, batch: int, frames: int) -> Array:
        """Draw times in [0, 1]: (B,), or (B, t) with ``noise.per_frame``."""
        shape = (batch, frames) if self.per_frame else (batch,)
        if self.times == "logit_normal":
            return self._shifted(jax.nn.sigmoid(jax.random.normal(key, shape)))
        return self._shifted(jax.random.uniform(key, shape))

    def corrupt(self, x0: Array, noise: Array, time_B: Array) -> Array:
        """Return (1 − t) x0 + t ε."""
        time = self.expand(time_B, x0.ndim)
        return (1 - time) * x0 + time * noise

    def precondition(self, x_t: Array, time_B: Array) -> tuple[Array, Array]:
        """Return x_t unchanged, and the time in the network's units."""
        return x_t, time_B * self.scale

    def prediction_target(self, x0: Array, noise: Array, time_B: Array) -> Array:
        """Return the velocity ε − x0."""
        del time_B
        return noise - x0

    def weight(self, time_B: Array) -> Array:
        """Return 1."""
        return jnp.ones(time_B.shape)

    def to_x0(self, prediction: Array, x_t: Array, time_B: Array) -> Array:
        """Return x_t − t v."""
        return x_t - self.expand(time_B, x_t.ndim) * prediction

    def levels(self) -> np.ndarray:
        """Return (sample_steps,) times from 1 downwards, shifted."""
        return np.asarray(self._shifted(np.linspace(1, 0, self.sample_steps + 1)[:-1]))

    def sample(self, denoise: Denoiser, noise: Array, key: Array | None = None) -> Array:
        """Follow the flow from t = 1, with noise of ``temperature``, to 0 by Euler's method."""
        del key
        times = np.asarray(self.levels(), np.float32)
        after = np.append(times[1:], np.float32(0))

        def step(x: Array, row: tuple[Array, Array]) -> tuple[Array, None]:
            now, then = row
            x0 = denoise(x, jnp.full((x.shape[0],), now), jnp.float32(self.guidance))
            velocity = (x - x0) / now
            return (x + (then - now) * velocity).astype(x.dtype), None

        start = self._start(noise)
        out, _ = jax.lax.scan(step, start, (jnp.asarray(times), jnp.asarray(after)))
        return out

    def _start(self, noise: Array) -> Array:
        """Return what the sampler starts from."""
        return noise if self.temperature == 1 else noise * self.temperature

    def _shifted(self, time: Any) -> Any:
        """Return s t / (1 + (s − 1) t)."""
        return self.shift * time / (1 + (self.shift - 1) * time)


@dataclasses.dataclass(frozen=True)
class FrameFlowConfig(FlowConfig):
    """x_t = (1 − t) x0 + (s + (1 − s) t) ε, velocity (1 − s) ε − x0.

    A little noise, s, is left at t = 0 (arXiv 2210.02747). With ``per_frame`` each frame has its
    own time (diffusion forcing, arXiv 2407.01392); given frames have some noise, too.
    ``PERSIST_VOXELS`` and ``PERSIST_PIXELS`` are the published settings.
    """

    shift: float = 3.0
    """Time shift of the sampler: t → s t / (1 + (s − 1) t)."""
    times: Literal["uniform", "logit_normal", "ends"] = "logit_normal"  # type: ignore[assignment]
    """Distribution of times in training. `ends`: half the frames at the time of given frames
    (`context_noise`), half at 1, which are the only times in a sampler of one step; it needs
    `per_frame`. Not as published."""
    shifted_times: bool = False
    """Whether the times of training are also shifted."""
    sample_steps: int = 20
    """Steps of the sampler, by Euler's method."""
    predicts: Literal["velocity", "x0"] = "velocity"
    """Prediction of the network: `velocity` as published, or `x0`, the clean latents, if tokens
    have more numbers than the network's width: noise that does not fit through the network remains
    in the sample (arXiv 2511.13720)."""
    smallest: float = 1e-5
    """The noise s that is left at t = 0."""
    context_noise: float = 0.02
    """Time of the frames that are given; published: 0.02 for voxels, 0.1 for pixels."""
    history: float = 0.0
    """Share of the frames in training at the time of given frames, so that the others learn to read
    such frames; other times are rarely as small. It needs `per_frame`; 0 as published."""

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        names, hint = ("smallest", "context_noise", "history"), "0 or more, below 1"
        require_fields(self, "noise", lambda value: 0 <= value < 1, hint, *names)
        require(
            self.times != "ends" or (self.per_frame and self.sample_steps == 1),
            f"noise.times is ends with noise.per_frame {self.per_frame} and noise.sample_steps "
            f"{self.sample_steps}: use per_frame true and 1 step, or other times.",
        )
        require(
            self.per_frame or not self.history,
            f"noise.history is {self.history} and noise.per_frame false: use true, or 0.",
        )

    def draw(self, key: Array, batch: int, frames: int) -> Array:
        """Draw times in [0, 1], (B, t) or (B,); shifted only with ``noise.shifted_times``."""
        if self.times == "ends":
            ended = jax.random.bernoulli(key, shape=(batch, frames))
            return jnp.where(ended, 1.0, self.context_noise)
        drawn = self if self.shifted_times else dataclasses.replace(self, shift=1.0)
        times = FlowConfig.draw(drawn, key, batch, frames)
        if not (self.history and self.per_frame):
            return times
        past = jax.random.bernoulli(jax.random.fold_in(key, 1), self.history, times.shape)
        return jnp.where(past, self.context_noise, times)

    def corrupt(self, x0: Array, noise: Array, time_B: Array) -> Array:
        """Return (1 − t) x0 + (s + (1 − s) t) ε."""
        time, least = self.expand(time_B, x0.ndim), self.smallest
        return (1 - time) * x0 + (least + (1 - least) * time) * noise

    def prediction_target(self, x0: Array, noise: Array, time_B: Array) -> Array:
        """Return the velocity (1 − s) ε − x0, or x0 where that is predicted."""
        del time_B
        if self.predicts == "x0":
            return x0
        return (1 - self.smallest) * noise - x0

    def to_x0(self, prediction: Array, x_t: Array, time_B: Array) -> Array:
        """Return (1 − s) (x_t − t v) − s v, or the prediction where it is x0."""
        if self.predicts == "x0":
            return prediction
        least = self.smallest
        at_zero = x_t - self.expand(time_B, x_t.ndim) * prediction
        return (1 - least) * at_zero - least * prediction

    def velocity(self, x0: Array, x_t: Array, time_B: Array) -> Array:
        """Return ((1 − s) x_t − x0) / (s + (1 − s) t), the velocity that leads to x0."""
        time, least = self.expand(time_B, x_t.ndim), self.smallest
        return ((1 - least) * x_t - x0) / (least + (1 - least) * time)

    def sample(self, denoise: Denoiser, noise: Array, key: Array | None = None) -> Array:
        """Follow the flow from t = 1, with noise of ``temperature``, by Euler's method.

        The sample is the last step's x0, without the noise s ε that is left at t = 0.
        """
        del key
        times = np.asarray(self.levels(), np.float32)
        after = np.append(times[1:], np.float32(0))

        def step(held: tuple[Array, Array], row: tuple[Array, Array]) -> tuple[Any, None]:
            (x, _), (now, then) = held, row
            time_B = jnp.full((x.shape[0],), now)
            x0 = denoise(x, time_B, jnp.float32(self.guidance)).astype(x.dtype)
            return ((x + (then - now) * self.velocity(x0, x, time_B)).astype(x.dtype), x0), None

        rows = (jnp.asarray(times), jnp.asarray(after))
        start = self._start(noise)
        (_, x0), _ = jax.lax.scan(step, (start, start), rows)
        return x0


PERSIST_VOXELS = FrameFlowConfig(per_frame=True)
"""The noise of PERSIST's voxel frames."""
PERSIST_PIXELS = FrameFlowConfig(per_frame=True, context_noise=0.1)
"""The noise of PERSIST's pictures."""
