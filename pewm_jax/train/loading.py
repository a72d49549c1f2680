"""Load a world model from a finished run, an unfinished run or a checkpoint.

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
from pewm_jax.io import tree, weights
from pewm_jax.memory import feature_cache
from pewm_jax.train import checkpoint_files, processes, runs
from pewm_jax.types import Params
from pewm_jax.worlds import lora, quantized, rollouts
from pewm_jax.worlds.stages import Stage


def load(
    path: str | Path, *, revision: str | None = None, quantize: str = ""
) -> tuple[Config, Params]:
    """Load a world model: the experiment, and its averaged (EMA) inference weights in NumPy arrays.

    Args:
        path: one of: a run folder made by ``train.py``, finished or not (the newest weights are
            loaded; while a stage is being trained, those of its newest complete checkpoint); a
            checkpoint folder, such as ``runs/demo/checkpoints/stage1/200``; a folder of converted
            weights; the name of weights that ship with the library (``shipped.names()``); the name
            of a model on a hub, ``org/name`` or ``org/name@revision`` (``io.hub``), which is
            downloaded to the cache first. A run that trained adapters is loaded with the weights
            that they adapt.
        revision: of a model on a hub: a branch, a tag or a commit; by default the newest.
        quantize: ``int8`` or ``fp8`` keeps the kernels of the denoiser in 8 bits
            (``worlds.quantized``).

    Raises:
        UserError: a file is missing or damaged, the weights do not fit the configuration, or the
            model cannot be downloaded.
    """
    config, params = _load(path, revision)
    return config, quantized.quantize(config.model, params, quantize)


def _load(path: str | Path, revision: str | None) -> tuple[Config, Params]:
    if not isinstance(path, str | os.PathLike):
        raise UserError(
            f"load() got a path of type {type(path).__name__}: pass the folder of a run, the "
            "name of weights that ship with the library, such as 'small', or org/name on a hub."
        )
    folder = shipped.find(path, revision)
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
            warnings.warn(f"{error} The previous one is loaded.", stacklevel=2)
    return rollouts.load_finished(folder)


def _checkpoints(run: Path) -> list[Path]:
    """Return the checkpoints of a run that are newer than its weights file, newest first."""
    path = run / runs.WEIGHTS
    facts = weights.metadata(path) if path.exists() else {}
    have = (int(facts.get("stage", 0)), int(facts.get("step", 0)))
    found: dict[tuple[int, int], Path] = {}
    config = configuration.load(run / runs.CONFIG)
    for stage in runs.all_stages(config):
        folder = checkpoint_files.of(run, stage.name)
        for step in checkpoint_files.steps(folder):
            found[stage.number, step] = folder / str(step)
    return [found[when] for when in sorted(found, reverse=True) if when > have]


def _read(folder: Path) -> tuple[Config, Params]:
    # Imported here: Orbax takes a second to import, and finished runs do not need it.
    from pewm_jax.train import checkpoint  # noqa: PLC0415

    config, params = checkpoint.read_weights(folder, _stored_shapes)
    if lora.ROOT in params:
        # The folder is RUN/checkpoints/STAGE/STEP.
        start = lora.find_base(folder.resolve().parents[2], checkpoint.position(folder))
        base = rollouts.load_finished(start)[1]
        params = lora.merge(base, params, config.train.lora, config.model.dtype)
    return config, params


def _shapes(config: Config, number: int) -> Params:
    """Return the shapes of the weights that a stage publishes."""
    stage = _stage(config, number)
    shapes = jax.eval_shape(functools.partial(stage.init, config.model), jax.random.key(0))
    return stage.published(shapes)


def _stored_shapes(config: Config, number: int) -> Params:
    """Return the shapes of the parameters in a stage's checkpoints."""
    return lora.stored(_stage(config, number), _shapes(config, number))


def _stage(config: Config, number: int) -> Stage:
    return next(stage for stage in runs.all_stages(config) if stage.number == number)


def remaining_stages(run: Path, planned: tuple[Stage, ...]) -> tuple[Stage, ...]:
    """Return the planned stages from the last one that has a checkpoint.

    Earlier stages are complete: the checkpoints of the later stage contain their weights.
    """
    begun = [
        n
        for n, stage in enumerate(planned)
        if checkpoint_files.steps(checkpoint_files.of(run, stage.name))
    ]
    return planned[processes.agree(max(begun, default=0)) :]


def require_weights(config: Config) -> None:
    """Raise UserError if weights of networks that are never trained are missing.

    ``train.start`` names those of the model; the loss of a stage may need others. A run that has
    begun no longer needs the folders that it started from.
    """
    begun = runs.has_begun(Path(config.train.run))
    for name in ("start", *(("start_draft",) if _drafts(config) else ())):
        run = getattr(config.train, name)
        if run and not begun and not _has_weights(shipped.find(run)):
            raise UserError(
                f"train.{name} is {run}, which has no weights: name the folder of a trained run, "
                f"or a model that ships ({', '.join(shipped.names())})."
            )
    for stage in runs.all_stages(config):
        if stage.extra_weights is not None and stage.settings(config).steps > 0:
            stage.extra_weights(config.model, config.train)
    if _drafts(config) and not config.train.start:
        raise UserError(
            "model.draft is a network that is not trained: set train.start to the weights that "
            "training begins with, and train.start_draft to the run that makes drafts."
        )
    for where, part in _parts(config.model):
        if where in config.model.TRAINS or config.train.start:
            continue
        if getattr(part, "CONVERTED", False):
            convert = "convert a checkpoint (pewm-jax convert --help)"
            raise UserError(
                f"{where} of kind {kinds.of(part).name} needs pretrained weights: "
                f"{getattr(part, 'WEIGHTS_FROM', convert)} and set train.start to its folder."
            )


def _has_weights(run: Path) -> bool:
    """Return whether a folder is a run with weights or checkpoints, or a checkpoint."""
    return runs.has_begun(run) or (run / checkpoint_files.WEIGHTS_ITEM).is_dir()


def _parts(settings: Settings, prefix: str = "") -> Iterator[tuple[str, Settings]]:
    """Yield the parts of a model, recursively, with the dotted names of their settings."""
    for field in dataclasses.fields(settings):  # type: ignore[arg-type]
        part = getattr(settings, field.name)
        if isinstance(part, Settings):
            yield f"{prefix}{field.name}", part
            yield from _parts(part, f"{prefix}{field.name}.")


def read_weights(config: Config, stage: Stage, log: Callable[[str], None]) -> Params | None:
    """Return the weights in ``train.start``, memory-mapped; None if it is empty.

    Weights of later stages are dropped, with a log line: PEWM's memory blocks are trained further
    if stage 2 is the first stage, but not after stage 1, which trains a different backbone.
    """
    if not config.train.start:
        return None
    file = shipped.find(config.train.start) / runs.WEIGHTS
    params = _start_weights(config)
    if file.exists():  # a checkpoint is verified while it is read
        processes.run_on_process_0(lambda: weights.verify(file))
    for later in runs.all_stages(config):
        if later.number <= stage.number:
            continue
        later_only = _shapes(config, later.number).keys() - _shapes(config, stage.number).keys()
        extra = later_only & params.keys()
        if extra and not stage.stored:  # adapters leave them as they are
            log(
                f"{config.train.start}: its {' and '.join(sorted(extra))} blocks are ignored; "
                f"{later.title} initializes new ones"
            )
        params = {name: part for name, part in params.items() if name not in extra}
    return params


def encoder(config: Config) -> Params:
    """Return the image encoder's weights in ``train.start``, for checking cached features."""
    if not config.model.memory.encoder.CONVERTED:
        return {}
    return _start_weights(config)["encoder"]


def _start_weights(config: Config) -> Params:
    """Return the weights in ``train.start``, and if they have no draft those of ``start_draft``."""
    params = _weights_of(config.train.start)
    if not _drafts(config) or "draft" in params:
        return params
    run = config.train.start_draft
    if not run:
        raise UserError(
            f"{config.train.start} has no draft: set train.start_draft to a run whose weights fit "
            "model.draft, such as small."
        )
    found = _weights_of(run)
    wanted = jax.eval_shape(config.model.init, jax.random.key(0))["draft"]
    if wrong := tree.mismatches(found, wanted):
        raise UserError(
            f"The weights in {run} (train.start_draft) do not fit model.draft "
            f"({tree.listing(wrong, 2)}): name a run with the same codec, backbone and reader."
        )
    return {**params, "draft": found}


def _drafts(config: Config) -> bool:
    """Return whether the model has a draft, by a network that is not trained."""
    draft = getattr(config.model, "draft", None)
    return draft is not None and draft.PREDICTS


def _weights_of(run: str) -> Params:
    """Return the weights of a run, from its weights file or else from a checkpoint."""
    folder = shipped.find(run)
    if (folder / runs.WEIGHTS).exists():
        return rollouts.load_finished(folder, lazily=True)[1]
    return load(folder)[1]


def features(config: Config, stage: Stage) -> feature_cache.FeatureCache | None:
    """Open the feature cache if the stage uses it, without checking it against the weights."""
    if not (config.data.features and stage.memory):
        return None
    return feature_cache.read(Path(config.data.features) / "train")
