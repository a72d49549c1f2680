"""Weights & Biases beside TensorBoard, where ``train.wandb`` names a project.

The package logs in, keeps and sends by itself and by its own environment variables: with
``WANDB_MODE=offline`` everything stays in the folder ``wandb`` of the run, and ``wandb sync`` sends
it later. A stage is one run there, grouped by the run's folder, under a name that is kept in the
run's folder: a training that goes on goes on in it too.
"""

from __future__ import annotations

import importlib
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pewm_jax import config as configuration
from pewm_jax.config import Config, UserError
from pewm_jax.io import atomic
from pewm_jax.train.stages import Stage

ID = "wandb.id"
"""File in a run's folder: what the runs of its stages are called there."""


def load() -> Any:
    """Import the package.

    Raises:
        UserError: it is not installed.
    """
    try:
        return importlib.import_module("wandb")  # takes a second: only where it is asked for
    except ImportError:
        raise UserError(
            "train.wandb needs Weights & Biases, which is not installed: "
            "pip install 'pewm-jax[wandb]'."
        ) from None


class WandbLog:
    """Sends the scalars of a stage; one process of a job has one.

    Args:
        config: the experiment, which is shown beside the curves; ``train.wandb`` is the project.
        run: the run's folder.
        stage: the stage about to be trained.

    Raises:
        UserError: the package is not installed, nobody is logged in, or it cannot begin.
    """

    def __init__(self, config: Config, run: Path, stage: Stage):
        wandb = load()
        try:
            self._run = wandb.init(
                project=config.train.wandb,
                name=f"{run.name} {stage.name}",
                group=run.name,
                id=f"{_id(run)}-{stage.name}",
                resume="allow",
                dir=str(run),
                config=configuration.to_dict(config),
                settings=wandb.Settings(console="off"),  # the live view is ours
            )
        except wandb.Error as error:
            reason = " ".join(str(error).split()).rstrip(".")
            raise UserError(
                f"Weights & Biases does not begin ({reason}): run `wandb login` first, or set "
                "WANDB_MODE=offline to keep everything here, or leave out --train.wandb."
            ) from None

    def write(self, step: int, scalars: Mapping[str, float]) -> None:
        """Log the scalars of one step; a step that was logged before is left as it was."""
        self._run.log(dict(scalars), step=step)

    def close(self, *, failed: bool) -> None:
        """Send or keep what is left, and end."""
        self._run.finish(exit_code=int(failed))


def _id(run: Path) -> str:
    """Return the name kept in the run's folder, made when it is first asked for."""
    path = run / ID
    if not path.exists():
        atomic.write_text(path, uuid.uuid4().hex[:12])
    return path.read_text("utf-8").strip()
