"""The trainings of Table 1: a backbone for each seed, and from it every row, in equal time.

A row with a memory trains only its reader (stage 2). The row without one continues the training of
its backbone. ``made_from.json`` beside a row's weights contains hashes of the weights and data it
was trained from; a row trained from others is an error.

Each training gets as many steps as its time allows. On a CPU that is processor time, measured
before the first training with all rows in turn, so that other jobs affect all rows equally; on an
accelerator it is wall-clock time. Preparing clips, compiling and scoring do not count. The
measurements are stored in ``plan.json`` with the settings they are valid for, and are not repeated.
"""

from __future__ import annotations

import dataclasses
import gc
import json
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pewm_jax import config as configuration
from pewm_jax import shipped
from pewm_jax.config import Config, StageConfig, UserError
from pewm_jax.data.dataset import MANIFEST
from pewm_jax.errors import require
from pewm_jax.io import atomic, weights
from pewm_jax.io.store import file_hash, inputs_hash, make_once
from pewm_jax.memory.none import NoMemoryConfig
from pewm_jax.models.dinov2 import model as dinov2
from pewm_jax.studies import step_times
from pewm_jax.studies.table1_rows import Row, as_kind
from pewm_jax.train import loop
from pewm_jax.train.runs import WEIGHTS
from pewm_jax.worlds.pewm.world import PEWM, STAGES

CODEC, MADE_FROM = "codec", "made_from.json"
Log = Callable[[str], Any]


@dataclasses.dataclass(frozen=True)
class Study:
    """Settings shared by all trainings of a table.

    Attributes:
        minutes: processor minutes of training steps: a backbone's, and a row's.
        steps: numbers of steps instead of minutes, for both; None for equal time.
    """

    base: Config
    out: Path
    minutes: tuple[float, float]
    steps: tuple[int, int] | None = None

    def __post_init__(self):
        """Validate."""
        require(
            all(math.isfinite(value) and value > 0 for value in self.minutes),
            f"minutes are {self.minutes}: give two numbers above 0, for a backbone and for a row.",
        )
        require(
            self.steps is None or min(self.steps) >= 1,
            f"steps are {self.steps}: give two integers of 1 or more, for a backbone and a row.",
        )

    def folder(self, name: str, seed: int) -> Path:
        """Return the run's folder of a row, or of a backbone."""
        return self.out / f"seed{seed}" / name


def backbone_of(base: Config, row: Row) -> Row:
    """Return the backbone that a row starts from, as a row: without a memory, with its depth."""
    name = "backbone" if row.depth else "backbone-without_depth"
    return Row(name, as_kind(base.model.memory, NoMemoryConfig), depth=row.depth)


def settings(study: Study, row: Row, seed: int, steps: int, *, start: str) -> Config:
    """Return the settings of one training of a row, or of its backbone, from the weights ``start``.

    A continued backbone gets the clips that the readers of this seed get, not those of its backbone
    again: clips are selected by the seed and the stage's number.
    """
    base = study.base
    clip = dataclasses.replace(base.model.clip, depth=row.depth)
    stages: dict[str, StageConfig] = {}
    for stage in STAGES[:2]:
        given, trained = stage.settings(base), stage.memory == row.reads
        stages[stage.name] = dataclasses.replace(given, steps=steps if trained else 0)
    first = row.name.startswith("backbone")
    fresh = (r"(backbone|memory|control)/.*",) if first else (r"memory/.*",)
    train = dataclasses.replace(
        base.train,
        run=str(study.folder(row.name, seed)),
        start=start,
        fresh=fresh if start else (),
        seed=seed if first or row.reads else seed + 1,
        preview_every=0,
        **stages,
    )
    config = base.with_model(clip=clip, memory=row.memory)
    return dataclasses.replace(config, train=train)


def train(study: Study, row: Row, seed: int, steps: Mapping[str, int], log: Log) -> Config:
    """Train a row and its backbone, unless they are trained already; return the row's settings.

    ``steps`` are those of ``planned``, by name of a row or backbone. The folder is ``train.run``.

    Raises:
        UserError: the data do not fit, or a loss is not finite.
        Interrupted: everything is saved; the same call resumes.
    """
    before = backbone_of(study.base, row)
    start = str(_start(study)) if study.base.train.start else ""
    for which in (before, row):
        where = start if which is before else str(_start_of(study, row, before, seed))
        config = settings(study, which, seed, steps[which.name], start=where)
        log(f"{which.name}, training seed {seed}: {steps[which.name]} steps")
        _require_same(config)
        loop.train(config, log=log)
        shutil.rmtree(study.folder(which.name, seed) / "checkpoints", ignore_errors=True)
        gc.collect()  # arrays, and programs that no other row needs
    return config


def _start_of(study: Study, row: Row, before: Row, seed: int) -> Path:
    """Return the weights that a row starts from: its backbone's, and those of its image encoder."""
    backbone = study.folder(before.name, seed)
    if not row.encoder:
        return backbone
    source, folder = Path(row.encoder), study.folder(f"{row.name}-start", seed)

    def make() -> None:
        config = configuration.load(backbone / "config.json")
        memory = dataclasses.replace(config.model.memory, encoder=row.memory.encoder)
        params = weights.load(backbone / WEIGHTS) | {"encoder": dinov2.load(source)[1]}
        weights.save(folder / WEIGHTS, params, weights.metadata(backbone / WEIGHTS))
        configuration.save(config.with_model(memory=memory), folder / "config.json")

    make_once(folder / MADE_FROM, [file_hash(run / WEIGHTS) for run in (backbone, source)], make)
    return folder


def _require_same(config: Config) -> None:
    """Raise an error if a row's folder was made from other weights or data."""
    run, start = Path(config.train.run), config.train.start
    now = {
        "start": file_hash(Path(shipped.find(start)) / WEIGHTS) if start else "",
        "data": file_hash(Path(config.data.path) / "train" / MANIFEST),
    }
    try:
        before = json.loads((run / MADE_FROM).read_text("utf-8"))
    except (FileNotFoundError, ValueError):
        before = None
    if before is None:
        run.mkdir(parents=True, exist_ok=True)
        atomic.write_text(run / MADE_FROM, json.dumps(now) + "\n")
    elif before != now:
        what = " and ".join(name for name in now if now[name] != before.get(name))
        raise UserError(
            f"{run} was made from other weights or data ({what}) than the present ones: delete it, "
            "or choose another folder by --out."
        )


def _start(study: Study) -> Path:
    """Return the codec to start from, without a gate if the settings have none."""
    source, folder = shipped.find(study.base.train.start), study.out / CODEC
    if getattr(study.base.model.codec, "gate", 0):
        return source

    def make() -> None:
        config = configuration.load(source / "config.json")
        params = weights.load(source / WEIGHTS)
        params["codec"].pop("gate", None)
        codec = dataclasses.replace(config.model.codec, gate=0)  # type: ignore[union-attr]
        model = dataclasses.replace(config.model, codec=codec)
        facts = weights.metadata(source / WEIGHTS)
        weights.save(folder / WEIGHTS, params, facts)
        configuration.save(dataclasses.replace(config, model=model), folder / "config.json")

    make_once(folder / MADE_FROM, file_hash(source / WEIGHTS), make)
    return folder


PLAN = "plan.json"
UNREAD = "weights that are not read"
"""Placeholder for the start weights when settings are only inspected."""
Times = dict[str, float]


def planned(study: Study, rows: Sequence[Row], log: Log) -> dict[str, Any]:
    """Return the time and the number of steps of each row and its backbone.

    ``seconds`` per step are None for equal steps. Trainings timed later are timed together with one
    that was timed before, and scaled by it.

    Raises:
        UserError: ``plan.json`` is damaged.
    """
    everything = {row.name: row for row in (*(backbone_of(study.base, row) for row in rows), *rows)}
    names = {name: _model(study, row) for name, row in everything.items()}
    seconds: Times = {}
    if study.steps is None:
        seconds = _step_times(study, {names[name]: row for name, row in everything.items()}, log)
    plan = {}
    for name, row in everything.items():
        second = not name.startswith("backbone")
        if study.steps is not None:
            steps = study.steps[second] * row.times
        else:
            steps = 60 * study.minutes[second] * row.times / seconds[names[name]]
        plan[name] = {"seconds": seconds.get(names[name]), "steps": max(round(steps), 1)}
    return plan


def _step_times(study: Study, models: dict[str, Row], log: Log) -> Times:
    """Return the seconds of a step for each model, from ``plan.json`` or measured now."""
    path = study.out / PLAN
    kept = _read_times(path)
    missing = {model: row for model, row in models.items() if model not in kept}
    if not missing:
        return kept
    known = {model: row for model, row in models.items() if model in kept}
    beside = dict(list(known.items())[-1:])  # preferably a row, not a backbone
    found = _measure(study, {**beside, **missing}, log)
    scale = next((kept[model] / found[model] for model in beside), 1.0)
    kept = _read_times(path) | kept | {model: scale * found[model] for model in missing}
    study.out.mkdir(parents=True, exist_ok=True)
    atomic.write_text(path, json.dumps(kept, indent=1) + "\n")
    return kept


def _read_times(path: Path) -> Times:
    if not path.exists():
        return {}
    try:
        kept = json.loads(path.read_text("utf-8"))
        return {str(model): float(seconds) for model, seconds in kept.items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path} is damaged ({error}), but it defines the lengths of trainings: restore it, or "
            "use another folder by --out."
        ) from None


def _model(study: Study, row: Row) -> str:
    """Return a hash of all that the step time of a row depends on."""
    config = settings(study, row, 0, 1, start=UNREAD)
    assert isinstance(config.model, PEWM)
    facts = [configuration.to_dict(config.model), STAGES[0].settings(config).batch, row.reads]
    return inputs_hash(facts)[:16]


def _measure(study: Study, models: dict[str, Row], log: Log) -> Times:
    """Return the median seconds per step of each model, measured in turn."""
    trainings = {
        model: (row.name, settings(study, row, 0, 1, start=UNREAD), STAGES[1 if row.reads else 0])
        for model, row in models.items()
    }
    return step_times.measure(trainings, log)
