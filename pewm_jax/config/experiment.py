"""One experiment: the settings of model, data, training and evaluation."""

from __future__ import annotations

import dataclasses
from typing import Any

from pewm_jax.config.training import DataConfig, EvalConfig, TrainConfig, TrainSettings
from pewm_jax.config.world import World, require_capabilities
from pewm_jax.errors import require
from pewm_jax.registry import part, require_section

VERSION = 5
"""The version of ``config.json`` that is written; ``migrations`` upgrades earlier ones."""


@dataclasses.dataclass(frozen=True)
class Config:
    """One experiment, from pixels to scores."""

    version: int = VERSION
    """Version of the format; set by the library."""
    model: Any = part("world", "pewm")
    """The world model: all settings that inference needs."""
    data: DataConfig = DataConfig()
    """What training reads."""
    train: TrainSettings = TrainConfig()
    """How it learns."""
    evaluate: EvalConfig = EvalConfig()
    """How it is scored."""

    def with_model(self, **changes: Any) -> Config:
        """Return the experiment with other settings of its model: ``config.with_model(clip=…)``."""
        return dataclasses.replace(self, model=dataclasses.replace(self.model, **changes))

    def __post_init__(self):
        """Validate settings that depend on each other."""
        require(
            self.version == VERSION,
            f"version is {self.version}: this library writes version {VERSION}; leave it out.",
        )
        require_section(self.model, "world", "model")
        if isinstance(self.model, World):
            require_capabilities(self.model)
        require(
            isinstance(self.train, self.model.TRAIN),
            f"train is a {type(self.train).__name__}, and a {type(self.model).__name__} is trained "
            f"by the stages of a {self.model.TRAIN.__name__}: use that.",
        )
        self.train.require_fit(self.model)
        encoder = getattr(getattr(self.model, "memory", None), "encoder", None)
        require(
            not self.data.features or getattr(encoder, "WEIGHTS", "encoder") == "encoder",
            f"data.features is {self.data.features}, and the memory's features are the codec's "
            "latents, of which no cache is kept: leave data.features empty; data.prepared keeps "
            "what is made of them.",
        )
