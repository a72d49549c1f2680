"""No memory: the baseline with only the present frame (NWM in the paper's Table 1).

All its tokens are masked. The memory blocks still exist and their feed-forward networks are
trained, so this baseline has the same number of trained parameters as the others.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

from pewm_jax.config import AssembledModel, Memory
from pewm_jax.types import Array, Camera, Frames, MapTokens, Params


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Nothing:
    """An empty pytree."""


@dataclasses.dataclass(frozen=True)
class NoMemoryConfig(Memory):
    """No memory; the reader exists with its parameters, but has nothing to read."""

    KEEPS_FEATURES: ClassVar[bool] = False
    REMEMBERS: ClassVar[bool] = False

    def empty(self, model: AssembledModel, centre_3: Array) -> Nothing:
        """Return the empty memory."""
        del model, centre_3
        return Nothing()

    def insert(
        self,
        model: AssembledModel,
        params: Params,
        memory: Nothing,
        frames: Frames,
        features_ThwF: Array,
        valid_T: Array | None = None,
        *,
        observed: bool = True,
    ) -> Nothing:
        """Return the memory unchanged."""
        del model, params, frames, features_ThwF, valid_T, observed
        return memory

    def read(self, model: AssembledModel, memory: Nothing, camera: Camera) -> MapTokens:
        """Return masked tokens."""
        del model, memory, camera
        return self._masked(self.tokens)

    def to_points(self, model: AssembledModel, memory: Nothing) -> tuple[Array, Array, Array]:
        """Return one invalid slot."""
        del model, memory
        blank = self._masked(1)
        return blank.points_world_M3, blank.features_MF, blank.valid_M

    def _masked(self, count: int) -> MapTokens:
        features = jnp.zeros((count, self.encoder.channels))
        return MapTokens(features, jnp.zeros((count, 3)), jnp.zeros((count,), bool))
