"""A stranger's memory: the middle pixels of the newest frames, the oldest forgotten first."""

import dataclasses
import sys

import jax
import jax.numpy as jnp

from pewm_jax.config import Memory, register
from pewm_jax.memory import cells
from pewm_jax.types import MapTokens

SIDE = 2


@dataclasses.dataclass(frozen=True)
class NewestConfig(Memory):
    frames: int = 4


def empty(model, centre_3):
    count = model.memory.frames * SIDE**2
    features = jnp.zeros((count, model.memory.encoder.channels))
    return features, jnp.zeros((count, 3)), jnp.zeros((count,), bool)


def remember(model, memory, frames, features_ThwF, valid_T=None):
    points, _, valid = cells.sample(frames, SIDE, SIDE, valid_T)
    count, channels = len(points), features_ThwF.shape[-1]
    shape = (count, SIDE, SIDE, channels)
    features = jax.image.resize(features_ThwF, shape, "linear")
    new = features.reshape(-1, channels), points.reshape(-1, 3), valid.reshape(-1)
    return jax.tree.map(lambda old, x: jnp.concatenate([old, x])[-len(old) :], memory, new)


def tokens(model, memory, camera):
    missing = model.memory.tokens - len(memory[2])
    assert missing >= 0
    features, points, valid = (jnp.pad(x, [(0, missing)] + [(0, 0)] * (x.ndim - 1)) for x in memory)
    return MapTokens(features, points, valid)


def to_points(model, memory):
    features, points, valid = memory
    return points, features, valid


register("memory", "newest", NewestConfig, sys.modules[__name__])
