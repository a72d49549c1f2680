"""What Table 1 trains: a backbone for each seed, and from it every row, for equal time.

Time is processor time of training steps, measured before the first training with all rows in turn,
so that another job slows all alike; the numbers of steps that follow from it are kept in
``plan.json`` and not measured again. Preparing clips, compiling and scoring are not counted. A row
with a memory trains its reader alone (stage 2). The row without one goes on training its backbone.
"""

from __future__ import annotations

import dataclasses
import functools
import gc
import hashlib
import json
import shutil
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

from pewm_jax import atomic, shipped, weights
from pewm_jax import config as configuration
from pewm_jax.config import Config, ModelConfig, NoMemoryConfig, StageConfig
from pewm_jax.data import loader
from pewm_jax.studies.rows import Row
from pewm_jax.training import loop, sharding
from pewm_jax.training.step import compile_step, initial_state, stage_key
from pewm_jax.worlds.pewm import STAGES

ROUNDS = 7
"""Steps of each row that are timed, in turn; one more before them is not."""
PLAN, CODEC = "plan.json", "codec"
UNREAD = "weights that are not read"
"""Stands for the weights to start from where settings are only looked at."""
Say = Callable[[str], Any]


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
        given, trained = stage.settings(base), stage.memory == row.remembers
        stages[stage.name] = dataclasses.replace(given, steps=steps if trained else 0)
    first = row.name.startswith("backbone")
    fresh = (r"(backbone|memory|control)/.*",) if first else (r"memory/.*",)
    train = dataclasses.replace(
        base.train,
        run=str(study.folder(row.name, seed)),
        start=start,
        fresh=fresh if start else (),
        seed=seed,
        preview_every=0,
        **stages,
    )
    config = base.with_model(clip=clip, memory=row.memory)
    return dataclasses.replace(config, train=train)


def train(study: Study, row: Row, seed: int, steps: Mapping[str, int], say: Say) -> Config:
    """Train a row, after its backbone, or find them trained.

    Args:
        study: what all share.
        row: what to train.
        seed: of the training.
        steps: from ``planned``: name of a row or backbone → steps.
        say: shows a line.

    Returns:
        The settings of the row's training, whose folder is ``train.run``.

    Raises:
        UserError: the data do not fit, or a loss is not finite.
        Interrupted: everything is saved; the same call goes on.
    """
    before = backbone_of(study.base, row)
    start = str(_start(study)) if study.base.train.start else ""
    for which, where in ((before, start), (row, str(study.folder(before.name, seed)))):
        config = settings(study, which, seed, steps[which.name], start=where)
        say(f"{which.name}, training seed {seed}: {steps[which.name]} steps")
        loop.train(config, say=say)
        shutil.rmtree(study.folder(which.name, seed) / "checkpoints", ignore_errors=True)
        _forget()
    return config


def _start(study: Study) -> Path:
    """Return the codec to start from, without a gate where the settings have none."""
    source, folder = shipped.find(study.base.train.start), study.out / CODEC
    if getattr(study.base.model.codec, "gate", 0):
        return source
    if not (folder / "config.json").is_file():
        config = configuration.load(source / "config.json")
        params = weights.load(source / "weights.safetensors")
        params["codec"].pop("gate", None)
        codec = dataclasses.replace(config.model.codec, gate=0)  # type: ignore[union-attr]
        model = dataclasses.replace(config.model, codec=codec)
        facts = weights.metadata(source / "weights.safetensors")
        weights.save(folder / "weights.safetensors", params, facts)
        configuration.save(dataclasses.replace(config, model=model), folder / "config.json")
    return folder


def planned(study: Study, rows: Sequence[Row], say: Say) -> dict[str, Any]:
    """Return how many steps each row and its backbone get; measured once.

    Returns:
        By name: ``seconds`` of processor time that a step takes, None where it was not measured;
        ``steps``; and ``model``, a hash of the settings that this holds for.
    """
    everything = {row.name: row for row in (*(backbone_of(study.base, row) for row in rows), *rows)}
    kept = _kept(study.out / PLAN)
    names = {name: _name(study, row) for name, row in everything.items()}
    missing = [n for n in everything if kept.get(n, {}).get("model") != names[n]]
    if not missing:
        return kept
    if study.steps is None:
        seconds = _measure(study, [everything[name] for name in missing], say)
    else:
        seconds = dict.fromkeys(missing)
    for name in missing:
        row, took = everything[name], seconds[name]
        first = name.startswith("backbone")
        if took is None:
            assert study.steps is not None
            steps = study.steps[0 if first else 1]
        else:
            steps = round(60 * study.minutes[0 if first else 1] * row.times / took)
        kept[name] = {"seconds": took, "steps": max(steps, 1), "model": names[name]}
    study.out.mkdir(parents=True, exist_ok=True)
    atomic.write_text(study.out / PLAN, json.dumps(kept, indent=1) + "\n")
    return kept


def _kept(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text("utf-8"))
    except (FileNotFoundError, ValueError):
        return {}


def _name(study: Study, row: Row) -> str:
    """Return a hash of what a row's number of steps depends on."""
    config = settings(study, row, 0, 1, start=UNREAD)
    assert isinstance(config.model, ModelConfig)
    facts = [
        configuration.to_dict(config.model),
        STAGES[0].settings(config).batch,
        study.minutes,
        study.steps,
        row.times,
    ]
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]


def _measure(study: Study, rows: Sequence[Row], say: Say) -> dict[str, float]:
    """Return the processor time of a step of each row, seconds: medians, the rows in turn."""
    say(f"timing a step of {len(rows)} trainings …")
    steps = {row.name: _compiled(study, row, say) for row in rows}
    taken: dict[str, list[float]] = {name: [] for name in steps}
    for number in range(ROUNDS + 1):
        for name, step in steps.items():
            began = time.process_time()
            step()
            if number:
                taken[name].append(time.process_time() - began)
    found = {name: statistics.median(each) for name, each in taken.items()}
    for name, seconds in found.items():
        say(f"  {name}: {seconds:.3f} s of processor time a step")
    del steps
    _forget()
    return found


def _compiled(study: Study, row: Row, say: Say) -> Callable[[], None]:
    """Compile a row's training step; returns a function that does one step, on random weights."""
    config = settings(study, row, 0, 1, start=UNREAD)
    stage, mesh = STAGES[1 if row.remembers else 0], sharding.make_mesh(jax.devices()[:1])
    batch = next(iter(loader.clips(config, "train", seed=0, batch=stage.settings(config).batch)))
    key = jax.device_put(stage_key(config, stage), sharding.replicated(mesh))
    held = [initial_state(config, stage, mesh, None)]
    if config.data.prepared:
        assert stage.prepare is not None
        batch = jax.jit(functools.partial(stage.prepare, config.model))(held[0].params, batch)
    clip = jax.device_put(jax.device_get(batch), sharding.of_batch(mesh))
    began = time.monotonic()
    compiled = compile_step(config, stage, mesh, clip)
    say(f"  {row.name}: compiled in {time.monotonic() - began:.0f} s")

    def step() -> None:
        held[0], metrics = compiled(held[0], clip, key)
        jax.block_until_ready(metrics)

    return step


def _forget() -> None:
    """Let go of arrays and of programs that no other row needs."""
    gc.collect()
