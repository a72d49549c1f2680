"""The stages of a world that are trained."""

from __future__ import annotations

from pewm_jax import worlds
from pewm_jax.config import Config, ConfigError
from pewm_jax.worlds.stages import FREEZE, TRAIN, Stage

__all__ = ["FREEZE", "TRAIN", "Stage", "all_stages", "planned"]


def all_stages(config: Config) -> tuple[Stage, ...]:
    """Return the stages that the experiment's world defines, in order.

    Optional ones without steps are left out.
    """
    return tuple(
        stage
        for stage in worlds.stages(config.model)
        if not stage.optional or stage.settings(config).steps > 0
    )


def planned(config: Config) -> tuple[Stage, ...]:
    """Return the stages with steps to train, in order.

    Raises:
        ConfigError: no stage has steps.
        UserError: the model has no parameters that one of them could train.
    """
    known = all_stages(config)
    stages = tuple(stage for stage in known if stage.settings(config).steps > 0)
    if not stages:
        names = " and ".join(f"train.{stage.name}.steps" for stage in known)
        raise ConfigError(
            f"{names} are {'both' if len(known) == 2 else 'all'} 0, so nothing would be trained: "
            "set one of them."
        )
    for stage in stages:
        if stage.require is not None:
            stage.require(config.model)
    return stages
