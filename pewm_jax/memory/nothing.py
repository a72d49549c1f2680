"""No memory at all: the rival that only knows the present frame (NWM in the paper's Table 1).

Its tokens are all masked. The memory blocks still exist and still train what does not read a
memory, their feed-forward, so that this rival has the same parameters and the same chance.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from pewm_jax.types import MapTokens


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Nothing:
    """Holds nothing."""


def tokens(count: int, channels: int) -> MapTokens:
    """Return ``count`` masked tokens."""
    return MapTokens(jnp.zeros((count, channels)), jnp.zeros((count, 3)), jnp.zeros((count,), bool))
