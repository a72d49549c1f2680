"""What is trained when: each world names its stages.

A stage has a loss, says by rules over parameter paths what trains and what stands still, and finds
its settings (steps, batch, learning rate) under its name in ``train``.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from typing import Any

from pewm_jax import tree
from pewm_jax.config import Config, StageConfig
from pewm_jax.types import Array, Params

TRAIN, FREEZE = "train", "freeze"

Loss = Callable[..., tuple[Array, dict[str, Array]]]
"""``loss(model, train, params, clip, key) -> (loss, measured)``: the loss of a batch of clips with
the settings of the model and of training, and scalars to log."""


@dataclasses.dataclass(frozen=True)
class Stage:
    """One stage of training; static and hashable.

    Attributes:
        name: of its settings (``train.NAME``), folders and log entries.
        number: its place among the world's stages, from 1; weights and noise are drawn by it.
        rules: (pattern, ``TRAIN`` or ``FREEZE``) over parameter paths, the first match wins (see
            ``pewm_jax.tree``); a leaf that none matches is an error.
        init: ``init(model, key) -> params``, all the parameters that the stage needs.
        loss: what it minimises.
        memory: whether clips' context is read, and so the image features that may be kept of it.
        rates: (pattern, factor) over the paths of what trains, the first match wins: the learning
            rate there is so many times that of the stage; where none matches, it is the stage's.
    """

    name: str
    number: int
    rules: tuple[tuple[str, str], ...]
    init: Callable[[Any, Array], Params]
    loss: Loss
    memory: bool = False
    rates: tuple[tuple[str, float], ...] = ()

    @property
    def title(self) -> str:
        """The name as people read it: ``stage1`` is "stage 1"."""
        return re.sub(r"(?<=[a-z])(?=[0-9])|_", " ", self.name)

    @property
    def trained(self) -> tuple[str, ...]:
        """The patterns of what is trained."""
        return tuple(pattern for pattern, label in self.rules if label == TRAIN)

    def labels(self, params: Any) -> Any:
        """Return a tree of ``TRAIN`` and ``FREEZE``, the mask that the optimizer works by.

        Raises:
            TreeError: leaves that no rule matches.
        """
        return tree.assign(self.rules, params, f"rules of {self.name}")

    def settings(self, config: Config) -> StageConfig:
        """Return this stage's settings."""
        return getattr(config.train, self.name)

    def data_seed(self, config: Config) -> int:
        """Return the seed of the order in which this stage reads the data."""
        return config.train.seed + self.number
