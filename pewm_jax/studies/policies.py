"""A trained policy: the run of a NoMaD, opened."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path

from pewm_jax import config as configuration
from pewm_jax.config import ActionConfig, Config, NomadWorldConfig, UserError
from pewm_jax.io.store import file_hash
from pewm_jax.train.runs import WEIGHTS
from pewm_jax.types import Params
from pewm_jax.worlds.rollouts import load_finished

SETTINGS = "config.json"


@dataclasses.dataclass(frozen=True, eq=False)
class OpenedPolicy:
    """A trained NoMaD.

    Attributes:
        folder: of its run.
        config: of its training.
        weights: the policy's parameters.
        digest: of weights and settings, see ``digest``.
    """

    folder: Path
    config: Config
    weights: Params = dataclasses.field(repr=False)
    digest: str

    @property
    def motion(self) -> ActionConfig:
        """What an action of its walks does."""
        return self.config.model.actions


def digest(weights_hash: str, config: Config) -> str:
    """Return a hash of all that what a model does depends on: its weights and its settings."""
    settings = json.dumps(configuration.to_dict(config.model), sort_keys=True)
    return hashlib.sha256((weights_hash + settings).encode()).hexdigest()


def is_run(name: str | Path) -> bool:
    """Tell whether a name is a folder with settings of a training."""
    return (Path(name) / SETTINGS).is_file()


def open_policy(name: str | Path) -> OpenedPolicy:
    """Open the run of a NoMaD.

    Raises:
        UserError: there is no such run, it is damaged or not finished, or it trained another kind
            of model.
    """
    folder = Path(name)
    if not is_run(folder):
        raise UserError(f"{folder} holds no run: train a policy first (pewm-jax train nomad).")
    config, params = load_finished(folder)
    if not isinstance(config.model, NomadWorldConfig):
        raise UserError(f"{folder} trained no policy: name the run of one (pewm-jax train nomad).")
    return OpenedPolicy(
        folder, config, params["policy"], digest(file_hash(folder / WEIGHTS), config)
    )
