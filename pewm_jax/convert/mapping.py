"""How a foreign weight file names and lays out what our parameter tree holds.

A network's converter is a list of ``Entry``: one per foreign tensor, with the path of our leaf and
the turn between the two layouts. The same list reads (foreign → ours), writes (ours → foreign),
and says which names and shapes are expected before any weight is read.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from pewm_jax.types import Array


@dataclasses.dataclass(frozen=True)
class Turn:
    """A change of layout and its inverse, on one tensor; both are pure views or permutations.

    Attributes:
        ours: foreign tensor → our layout.
        theirs: our layout → foreign tensor.
    """

    ours: Callable[[Array], Array]
    theirs: Callable[[Array], Array]


SAME = Turn(lambda x: x, lambda x: x)
"""Biases, scales, embeddings: no change."""
LINEAR = Turn(lambda x: x.T, lambda x: x.T)
"""torch (out, in) ↔ flax (in, out)."""
CONV = Turn(
    lambda x: np.moveaxis(x, (0, 1), (-1, -2)),
    lambda x: np.moveaxis(x, (-1, -2), (0, 1)),
)
"""torch (out, in, k…) ↔ flax (k…, in, out), any number of spatial axes."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """One foreign tensor.

    Attributes:
        theirs: its name in the foreign file.
        path: our leaf, keys joined by slashes (see ``pewm_jax.io.tree``).
        turn: the change of layout.
        layer: position on the leading axis of our leaf where layers are stacked, else None.
    """

    theirs: str
    path: str
    turn: Turn = SAME
    layer: int | None = None
