"""Load a world model from whatever training left: a finished run, an unfinished one, a checkpoint.

Only inference weights are read: a checkpoint's optimizer state may be missing or damaged.
"""

from __future__ import annotations

import functools
import os
import warnings
from pathlib import Path

import jax

from pewm_jax import config as configuration
from pewm_jax import shipped
from pewm_jax.config import Config, UserError
from pewm_jax.io import weights
from pewm_jax.train import runs, stages, step_folders
from pewm_jax.types import Params
from pewm_jax.worlds import rollouts


def load(path: str | Path) -> tuple[Config, Params]:
    """Load a world model.

    Args:
        path: a run folder made by ``train.py``, finished or not: the newest weights in it are
            taken, those of its newest whole checkpoint while a stage is being trained. Or a
            checkpoint's own folder, such as ``runs/demo/checkpoints/stage1/200``. Or a folder of
            converted weights. Or the name of weights that come with the library
            (``shipped.names()``).

    Returns:
        ``(config, params)``; the averaged weights that inference uses, as NumPy arrays in the
        dtype of the file.

    Raises:
        UserError: something is absent or damaged, or the weights do not fit the configuration.
    """
    if not isinstance(path, str | os.PathLike):
        raise UserError(
            f"load() got a path of type {type(path).__name__}: give the folder of a run, or the "
            "name of weights that come with the library, such as 'small'."
        )
    folder = shipped.find(path)
    if (folder / step_folders.WEIGHTS_ITEM).is_dir():
        return _read(folder)
    newer = _checkpoints(folder)
    if not newer:
        return rollouts.load_finished(folder)
    for number, checkpoint in enumerate(newer):
        try:
            return _read(checkpoint)
        except UserError as error:
            if number == len(newer) - 1 and not (folder / runs.WEIGHTS).exists():
                raise
            warnings.warn(f"{error} The one before it is loaded.", stacklevel=2)
    return rollouts.load_finished(folder)


def _checkpoints(run: Path) -> list[Path]:
    """Return the checkpoints of a run that are newer than its file of weights, newest first."""
    path = run / runs.WEIGHTS
    facts = weights.metadata(path) if path.exists() else {}
    have = (int(facts.get("stage", 0)), int(facts.get("step", 0)))
    found: dict[tuple[int, int], Path] = {}
    config = configuration.load(run / runs.CONFIG)
    for stage in stages.all_stages(config):
        folder = step_folders.of(run, stage.name)
        for step in step_folders.steps(folder):
            found[stage.number, step] = folder / str(step)
    return [found[when] for when in sorted(found, reverse=True) if when > have]


def _read(folder: Path) -> tuple[Config, Params]:
    # Imported here: Orbax takes a second to import, and finished runs do not need it.
    from pewm_jax.train import checkpoint  # noqa: PLC0415

    return checkpoint.read_weights(folder, _shapes)


def _shapes(config: Config, number: int) -> Params:
    """Return the shapes of a model's weights in a stage."""
    stage = next(stage for stage in stages.all_stages(config) if stage.number == number)
    return jax.eval_shape(functools.partial(stage.init, config.model), jax.random.key(0))
