"""A noise in one file: x_t = cos(πt/2) x0 + sin(πt/2) ε with t in (0, 1), target v.

::

    pewm-jax train tiny --plugin noise.py --noise.kind cosine --train.run runs/mine
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config.parts import Noise
from pewm_jax.registry import register


@register("noise", "cosine")
@dataclasses.dataclass(frozen=True)
class CosineConfig(Noise):
    sample_steps: int = 3

    def draw(self, key, batch, frames):
        return jax.random.uniform(key, (batch,))

    def corrupt(self, x0, noise, time_B):
        angle = jnp.pi / 2 * self.expand(time_B, x0.ndim)
        return jnp.cos(angle) * x0 + jnp.sin(angle) * noise

    def precondition(self, x_t, time_B):
        return x_t, 1000 * time_B

    def prediction_target(self, x0, noise, time_B):
        return self.corrupt(noise, -x0, time_B)

    def weight(self, time_B):
        return jnp.ones(time_B.shape)

    def to_x0(self, prediction, x_t, time_B):
        return self.corrupt(x_t, -prediction, time_B)

    def levels(self):
        return np.linspace(1, 0, self.sample_steps + 1)[:-1].astype(np.float32)

    def sample(self, denoise, noise, key=None):
        x = noise
        for now, then in zip(self.levels(), [*self.levels()[1:], np.float32(0)], strict=True):
            time_B = jnp.full((len(x),), now)
            x0 = denoise(x, time_B, jnp.float32(self.guidance))
            noise = (x - self.corrupt(x0, 0, time_B)) / np.sin(np.pi / 2 * now)
            x = self.corrupt(x0, noise, jnp.full((len(x),), then))
        return x
