"""A memory in one file: the middle pixels of the newest frames; the oldest are forgotten first.

::

    pewm-jax train tiny --plugin memory.py --memory.kind newest --train.run runs/mine
"""

import dataclasses

import jax
import jax.numpy as jnp

from pewm_jax.config.parts import Memory
from pewm_jax.memory import cells
from pewm_jax.registry import register
from pewm_jax.types import MapTokens

SIDE = 2


@register("memory", "newest")
@dataclasses.dataclass(frozen=True)
class NewestConfig(Memory):
    frames: int = 4

    def empty(self, model, centre_3):
        count = self.frames * SIDE**2
        features = jnp.zeros((count, self.encoder.channels))
        return features, jnp.zeros((count, 3)), jnp.zeros((count,), bool)

    def insert(self, model, params, memory, frames, features_ThwF, valid_T=None, *, observed=True):
        points, _, valid = cells.sample(frames, SIDE, SIDE, valid_T)
        shape = (len(points), SIDE, SIDE, features_ThwF.shape[-1])
        features = jax.image.resize(features_ThwF, shape, "linear")
        new = features.reshape(-1, shape[-1]), points.reshape(-1, 3), valid.reshape(-1)
        return jax.tree.map(lambda old, x: jnp.concatenate([old, x])[-len(old) :], memory, new)

    def read(self, model, memory, camera):
        missing = self.tokens - len(memory[2])
        assert missing >= 0
        features, points, valid = (
            jnp.pad(x, [(0, missing)] + [(0, 0)] * (x.ndim - 1)) for x in memory
        )
        return MapTokens(features, points, valid)

    def to_points(self, model, memory):
        features, points, valid = memory
        return points, features, valid
