"""No memory: the rival that knows only the present frame (NWM in the paper's Table 1).

All its tokens are masked. The memory blocks still exist, and their feed-forward networks are still
trained, so this rival has the same number of trained parameters as the others.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from pewm_jax.config import ModelConfig
from pewm_jax.types import Array, Camera, Frames, MapTokens


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Nothing:
    """An empty pytree."""


def empty(model: ModelConfig, centre_3: Array) -> Nothing:
    """Return the empty memory."""
    del model, centre_3
    return Nothing()


def remember(
    model: ModelConfig,
    memory: Nothing,
    frames: Frames,
    features_ThwF: Array,
    valid_T: Array | None = None,
) -> Nothing:
    """Return the memory unchanged."""
    del model, frames, features_ThwF, valid_T
    return memory


def tokens(model: ModelConfig, memory: Nothing, camera: Camera) -> MapTokens:
    """Return masked tokens."""
    del memory, camera
    return _masked(model, model.memory.tokens)


def to_points(model: ModelConfig, memory: Nothing) -> tuple[Array, Array, Array]:
    """Return one invalid slot."""
    del memory
    blank = _masked(model, 1)
    return blank.points_world_M3, blank.features_MF, blank.valid_M


def _masked(model: ModelConfig, count: int) -> MapTokens:
    channels = model.memory.encoder.channels
    return MapTokens(jnp.zeros((count, channels)), jnp.zeros((count, 3)), jnp.zeros((count,), bool))
