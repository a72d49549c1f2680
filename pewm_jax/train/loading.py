"""Load a world model from whatever training left: a finished run, an unfinished one, a checkpoint.

Only inference weights are read: a checkpoint's optimizer state may be missing or damaged.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import jax

from pewm_jax import config as configuration
from pewm_jax import registry as kinds
from pewm_jax import shipped
from pewm_jax.config import Config, Settings, UserError
from pewm_jax.io import weights
from pewm_jax.memory import feature_cache
from pewm_jax.train import checkpoint_files, processes, runs, stages
from pewm_jax.train.stages import Stage, all_stages
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
    if (folder / checkpoint_files.WEIGHTS_ITEM).is_dir():
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
        folder = checkpoint_files.of(run, stage.name)
        for step in checkpoint_files.steps(folder):
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


def remaining_stages(run: Path, planned: tuple[Stage, ...]) -> tuple[Stage, ...]:
    """Return the planned stages from the last one that has a checkpoint.

    Earlier ones are done: the checkpoints of the later stage hold their weights.
    """
    begun = [
        n
        for n, stage in enumerate(planned)
        if checkpoint_files.steps(checkpoint_files.of(run, stage.name))
    ]
    return planned[processes.agree(max(begun, default=0)) :]


def require_weights(config: Config) -> None:
    """Refuse networks that are never trained, if there are no weights for them.

    Those of the model are named by ``train.start``; a stage's loss may need others.
    """
    for stage in all_stages(config):
        if stage.extra_weights is not None and stage.settings(config).steps > 0:
            stage.extra_weights(config.model, config.train)
    for where, part in _parts(config.model):
        if where in config.model.TRAINS or config.train.start:
            continue
        if getattr(part, "CONVERTED", False):
            convert = "convert a checkpoint (pewm-jax convert --help)"
            raise UserError(
                f"{where} of kind {kinds.of(part).name} needs weights that are not trained here: "
                f"{getattr(part, 'WEIGHTS_FROM', convert)} and name its folder by train.start."
            )


def _parts(settings: Settings, prefix: str = "") -> Iterator[tuple[str, Settings]]:
    """List the parts that a model is put together of, and their parts, by their settings' names."""
    for field in dataclasses.fields(settings):  # type: ignore[arg-type]
        part = getattr(settings, field.name)
        if isinstance(part, Settings):
            yield f"{prefix}{field.name}", part
            yield from _parts(part, f"{prefix}{field.name}.")


def read_weights(config: Config, stage: Stage, log: Callable[[str], None]) -> Params | None:
    """Return the weights in ``train.start``, mapped into memory; None if it is empty.

    What only later stages have is dropped, which is said: PEWM's memory blocks are trained further
    where stage 2 is the first, and not after stage 1, which makes another backbone than theirs.
    """
    if not config.train.start:
        return None
    file = shipped.find(config.train.start) / runs.WEIGHTS
    params = _given(config)
    if file.exists():  # a checkpoint has been verified while reading
        processes.run_on_process_0(lambda: weights.verify(file))
    for later in _later(config, stage):
        extra = (
            _stage_shapes(config, later).keys() - _stage_shapes(config, stage).keys()
        ) & params.keys()
        if extra:
            log(
                f"{config.train.start}: its {' and '.join(sorted(extra))} blocks are left out; "
                f"{later.title} begins with fresh ones"
            )
        params = {name: part for name, part in params.items() if name not in extra}
    return params


def _later(config: Config, stage: Stage) -> list[Stage]:
    return [one for one in all_stages(config) if one.number > stage.number]


def _stage_shapes(config: Config, stage: Stage) -> Params:
    """Return the shapes of all parameters of a stage."""
    return jax.eval_shape(functools.partial(stage.init, config.model), jax.random.key(0))


def encoder(config: Config) -> Params:
    """Return the image encoder's weights in ``train.start``, to compare kept features with."""
    if not config.model.memory.encoder.CONVERTED:
        return {}
    return _given(config)["encoder"]


def _given(config: Config) -> Params:
    """Return the weights in ``train.start``: those of its file, or else of a checkpoint."""
    folder = shipped.find(config.train.start)
    if (folder / runs.WEIGHTS).exists():
        return rollouts.load_finished(folder, lazily=True)[1]
    return load(folder)[1]


def features(config: Config, stage: Stage) -> feature_cache.FeatureCache | None:
    """Open the kept features if the stage uses any, without comparing them with the weights."""
    if not (config.data.features and stage.memory):
        return None
    return feature_cache.read(Path(config.data.features) / "train")
