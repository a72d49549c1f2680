"""What Table 1 trains: a backbone for each seed, and from it every row.

A row with a memory trains its reader alone (stage 2). The row without one goes on training its
backbone. ``made_from.json`` beside a row's weights names the weights and the data that it was made
from; what was made from others is refused.
"""

from __future__ import annotations

import dataclasses
import gc
import json
import math
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pewm_jax import config as configuration
from pewm_jax import shipped
from pewm_jax.config import Config, NoMemoryConfig, StageConfig, UserError
from pewm_jax.data.dataset import MANIFEST
from pewm_jax.errors import require
from pewm_jax.io import atomic, weights
from pewm_jax.io.store import file_hash
from pewm_jax.models.dinov2 import model as dinov2
from pewm_jax.studies.rows import Row
from pewm_jax.train import loop
from pewm_jax.train.runs import WEIGHTS
from pewm_jax.worlds.pewm.world import STAGES

CODEC, MADE_FROM = "codec", "made_from.json"
Log = Callable[[str], Any]


@dataclasses.dataclass(frozen=True)
class Study:
    """What all trainings of a table share.

    Attributes:
        base: the settings; the folder of data is there.
        out: the folder that everything is kept in.
        minutes: processor minutes of training steps: a backbone's, and a row's.
        steps: steps instead of minutes, for both; None for equal time.
    """

    base: Config
    out: Path
    minutes: tuple[float, float]
    steps: tuple[int, int] | None = None

    def __post_init__(self):
        """Validate."""
        require(
            all(math.isfinite(value) and value > 0 for value in self.minutes),
            f"minutes are {self.minutes}: give two numbers above 0, of a backbone and of a row.",
        )
        require(
            self.steps is None or min(self.steps) >= 1,
            f"steps are {self.steps}: give two whole numbers from 1 on, of a backbone and a row.",
        )

    def folder(self, name: str, seed: int) -> Path:
        """Return the run's folder of a row, or of a backbone."""
        return self.out / f"seed{seed}" / name


def backbone_of(base: Config, row: Row) -> Row:
    """Return the backbone that a row starts from, as a row: without a memory, with its depth.

    Args:
        base: the settings that all rows share; rows of equal depth have the same backbone.
        row: the row.
    """
    given = {
        field.name: getattr(base.model.memory, field.name)
        for field in dataclasses.fields(NoMemoryConfig)
    }
    name = "backbone" if row.depth else "backbone-without_depth"
    return Row(name, NoMemoryConfig(**given), depth=row.depth)


def settings(study: Study, row: Row, seed: int, steps: int, *, start: str) -> Config:
    """Return the settings of one training.

    What goes on training a backbone gets the clips that the readers of this seed get, and not once
    more those of its backbone: clips are chosen by the seed and by the stage's number.

    Args:
        study: what all share.
        row: the row, or its backbone.
        seed: of the training.
        steps: of the only stage that is trained.
        start: the weights to start from.
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
    """Train a row, after its backbone, or find them trained.

    Args:
        study: what all share.
        row: what to train.
        seed: of the training.
        steps: from ``planned``: name of a row or backbone → steps.
        log: shows a line.

    Returns:
        The settings of the row's training, whose folder is ``train.run``.

    Raises:
        UserError: the data do not fit, or a loss is not finite.
        Interrupted: everything is saved; the same call goes on.
    """
    before = backbone_of(study.base, row)
    start = str(_start(study)) if study.base.train.start else ""
    for which in (before, row):
        where = start if which is before else str(_start_of(study, row, before, seed))
        config = settings(study, which, seed, steps[which.name], start=where)
        log(f"{which.name}, training seed {seed}: {steps[which.name]} steps")
        _require_same(config)
        loop.train(config, say=log)
        shutil.rmtree(study.folder(which.name, seed) / "checkpoints", ignore_errors=True)
        gc.collect()  # arrays, and programs that no other row needs
    return config


def _start_of(study: Study, row: Row, before: Row, seed: int) -> Path:
    """Return the weights that a row starts from: its backbone's, and those of its image encoder."""
    backbone = study.folder(before.name, seed)
    if not row.encoder:
        return backbone
    source, folder = Path(row.encoder), study.folder(f"{row.name}-start", seed)
    mark, digest = folder / MADE_FROM, [file_hash(run / WEIGHTS) for run in (backbone, source)]
    if not mark.is_file() or json.loads(mark.read_text("utf-8")) != digest:
        config = configuration.load(backbone / "config.json")
        memory = dataclasses.replace(config.model.memory, encoder=row.memory.encoder)
        params = weights.load(backbone / WEIGHTS) | {"encoder": dinov2.load(source)[1]}
        weights.save(folder / WEIGHTS, params, weights.metadata(backbone / WEIGHTS))
        configuration.save(config.with_model(memory=memory), folder / "config.json")
        atomic.write_text(mark, json.dumps(digest) + "\n")
    return folder


def _require_same(config: Config) -> None:
    """Refuse to go on with, or to take, what was made from other weights or data."""
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
            f"{run} was made from other weights or data ({what}) than there are now: delete it, or "
            "name another folder by --out."
        )


def _start(study: Study) -> Path:
    """Return the codec to start from, without a gate where the settings have none."""
    source, folder = shipped.find(study.base.train.start), study.out / CODEC
    if getattr(study.base.model.codec, "gate", 0):
        return source
    mark, digest = folder / MADE_FROM, file_hash(source / WEIGHTS)
    if not mark.is_file() or json.loads(mark.read_text("utf-8")) != digest:
        config = configuration.load(source / "config.json")
        params = weights.load(source / WEIGHTS)
        params["codec"].pop("gate", None)
        codec = dataclasses.replace(config.model.codec, gate=0)  # type: ignore[union-attr]
        model = dataclasses.replace(config.model, codec=codec)
        facts = weights.metadata(source / WEIGHTS)
        weights.save(folder / WEIGHTS, params, facts)
        configuration.save(dataclasses.replace(config, model=model), folder / "config.json")
        atomic.write_text(mark, json.dumps(digest) + "\n")
    return folder
