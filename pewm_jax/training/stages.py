"""What is trained when: the paper's two stages as a table of rules over parameter paths.

Stage 1 fine-tunes the backbone, without any memory, to the domain, to camera control and to
RGB-D. Stage 2 adds the memory blocks, which start as the identity, and trains nothing else.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from pewm_jax import tree
from pewm_jax.config import Config, ConfigError, StageConfig

TRAIN, FREEZE = "train", "freeze"


@dataclasses.dataclass(frozen=True)
class Stage:
    """One stage of training; static and hashable.

    Attributes:
        number: 1 or 2.
        memory: whether the memory blocks exist and read the map.
        rules: (pattern, ``TRAIN`` or ``FREEZE``) over parameter paths, the first match wins (see
            ``pewm_jax.tree``); a leaf that none matches is an error.
    """

    number: int
    memory: bool
    rules: tuple[tuple[str, str], ...]

    @property
    def trained(self) -> tuple[str, ...]:
        """Return the patterns of what is trained."""
        return tuple(pattern for pattern, label in self.rules if label == TRAIN)

    def labels(self, params: Any) -> Any:
        """Return a tree of ``TRAIN`` and ``FREEZE``, the mask that the optimizer works by.

        Raises:
            TreeError: leaves that no rule matches.
        """
        return tree.assign(self.rules, params, f"rules of {self.name}")

    @property
    def name(self) -> str:
        """``stage1`` or ``stage2``: the name of settings, folders and log entries."""
        return f"stage{self.number}"

    def settings(self, config: Config) -> StageConfig:
        """Return this stage's settings."""
        return getattr(config.train, self.name)

    def data_seed(self, config: Config) -> int:
        """Return the seed of the order in which this stage reads the data."""
        return config.train.seed + self.number


STAGES = (
    Stage(
        number=1,
        memory=False,
        rules=((r"backbone/.*", TRAIN), (r"(codec|encoder|text)/.*", FREEZE)),
    ),
    Stage(
        number=2,
        memory=True,
        rules=((r"memory/.*", TRAIN), (r"(backbone|codec|encoder|text)/.*", FREEZE)),
    ),
)


def planned(config: Config) -> tuple[Stage, ...]:
    """Return the stages that have steps to do, in order.

    Raises:
        ConfigError: no stage has any.
    """
    stages = tuple(stage for stage in STAGES if stage.settings(config).steps > 0)
    if not stages:
        raise ConfigError(
            "train.stage1.steps and train.stage2.steps are both 0: nothing would be trained; "
            "give one of them steps."
        )
    return stages
