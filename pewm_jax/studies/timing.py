"""How many steps each training of Table 1 gets: as many as its time allows.

On a processor, time is processor time, measured before the first training with all rows in turn, so
that another job slows all alike; on an accelerator it is time on the clock. Preparing clips,
compiling and scoring are not counted. What was measured is kept in ``plan.json``, by the settings
that it holds for, and is not measured again: other settings are added, and the old ones stay.
"""

from __future__ import annotations

import functools
import gc
import hashlib
import json
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

from pewm_jax import config as configuration
from pewm_jax.config import ModelConfig, UserError
from pewm_jax.data import loader
from pewm_jax.io import atomic
from pewm_jax.studies.rows import Row
from pewm_jax.studies.trainings import Log, Study, backbone_of, settings
from pewm_jax.train import sharding
from pewm_jax.train.step import compile_step, initial_state, noise_key
from pewm_jax.worlds.pewm.world import STAGES

ROUNDS = 7
"""Steps of each training that are timed, in turn; one more before them is not."""
PLAN = "plan.json"
UNREAD = "weights that are not read"
"""Stands for the weights to start from where settings are only looked at."""
Times = dict[str, float]


def planned(study: Study, rows: Sequence[Row], log: Log) -> dict[str, Any]:
    """Return how many steps each row and its backbone get; measured once.

    Trainings that are timed later are timed beside one that was timed before, and scaled by it.

    Returns:
        By name: ``seconds`` that a step takes, None where steps are equal; and ``steps``.

    Raises:
        UserError: ``plan.json`` is damaged.
    """
    everything = {row.name: row for row in (*(backbone_of(study.base, row) for row in rows), *rows)}
    names = {name: _model(study, row) for name, row in everything.items()}
    seconds: Times = {}
    if study.steps is None:
        seconds = _timed(study, {names[name]: row for name, row in everything.items()}, log)
    plan = {}
    for name, row in everything.items():
        second = not name.startswith("backbone")
        if study.steps is not None:
            steps = study.steps[second] * row.times
        else:
            steps = 60 * study.minutes[second] * row.times / seconds[names[name]]
        plan[name] = {"seconds": seconds.get(names[name]), "steps": max(round(steps), 1)}
    return plan


def _timed(study: Study, models: dict[str, Row], log: Log) -> Times:
    """Return the seconds of a step for each model, from ``plan.json`` or measured now."""
    path = study.out / PLAN
    kept = _kept(path)
    missing = {model: row for model, row in models.items() if model not in kept}
    if not missing:
        return kept
    known = {model: row for model, row in models.items() if model in kept}
    beside = dict(list(known.items())[-1:])  # a row rather than a backbone, where one is known
    found = _measure(study, {**beside, **missing}, log)
    scale = next((kept[model] / found[model] for model in beside), 1.0)
    kept = _kept(path) | kept | {model: scale * found[model] for model in missing}
    study.out.mkdir(parents=True, exist_ok=True)
    atomic.write_text(path, json.dumps(kept, indent=1) + "\n")
    return kept


def _kept(path: Path) -> Times:
    try:
        kept = json.loads(path.read_text("utf-8"))
        return {str(model): float(seconds) for model, seconds in kept.items()}
    except FileNotFoundError:
        return {}
    except (ValueError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path} is damaged ({error}): it says how long trainings are; restore it, or take "
            "another folder by --out."
        ) from None


def _model(study: Study, row: Row) -> str:
    """Return a hash of what the time of a row's step depends on."""
    config = settings(study, row, 0, 1, start=UNREAD)
    assert isinstance(config.model, ModelConfig)
    facts = [configuration.to_dict(config.model), STAGES[0].settings(config).batch, row.reads]
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]


def clock() -> Callable[[], float]:
    """Return the clock that counts: the processor's, or on an accelerator the one on the wall."""
    return time.process_time if jax.default_backend() == "cpu" else time.perf_counter


def _measure(study: Study, models: dict[str, Row], log: Log) -> Times:
    """Return the time of a step of each model, seconds: medians, the models in turn."""
    log(f"timing a step of {len(models)} trainings …")
    steps = {model: _compiled(study, row, log) for model, row in models.items()}
    taken: dict[str, list[float]] = {model: [] for model in steps}
    now = clock()
    for number in range(ROUNDS + 1):
        for model, step in steps.items():
            began = now()
            step()
            if number:
                taken[model].append(now() - began)
    found = {model: statistics.median(each) for model, each in taken.items()}
    for model, seconds in found.items():
        spread = f"{min(taken[model]):.3f} to {max(taken[model]):.3f}"
        log(f"  {models[model].name}: {seconds:.3f} s a step ({spread})")
    del steps
    gc.collect()
    return found


def _compiled(study: Study, row: Row, log: Log) -> Callable[[], None]:
    """Compile a row's training step; returns a function that does one step, on random weights."""
    config = settings(study, row, 0, 1, start=UNREAD)
    stage, mesh = STAGES[1 if row.reads else 0], sharding.make_mesh(arranged=config.train.mesh)
    batch = next(iter(loader.clips(config, "train", seed=0, batch=stage.settings(config).batch)))
    key = jax.device_put(noise_key(config, stage), sharding.replicated(mesh))
    held = [initial_state(config, stage, mesh, None)]
    if config.data.prepared:
        assert stage.prepare is not None
        batch = jax.jit(functools.partial(stage.prepare, config.model))(held[0].params, batch)
    clip = jax.device_put(jax.device_get(batch), sharding.of_batch(mesh))
    began = time.monotonic()
    compiled = compile_step(config, stage, mesh, clip)
    log(f"  {row.name}: compiled in {time.monotonic() - began:.0f} s")

    def step() -> None:
        held[0], metrics = compiled(held[0], clip, key)
        jax.block_until_ready(metrics)

    return step
