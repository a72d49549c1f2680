"""The folder of a run: its configuration, its finished weights, and a lock on it.

::

    runs/demo/config.json           written first: what this run is
              metrics.jsonl         one line per logged step
              tensorboard/          the same for TensorBoard
              wandb/, wandb.id      the same for Weights & Biases, where `train.wandb` asks for it
              checkpoints/stage1/   by Orbax, see ``checkpoint``
              previews/             sample pictures
              weights.safetensors   inference weights, written when a stage is finished
              base.json             which converted checkpoint it started from, if any
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pewm_jax import config as configuration
from pewm_jax.config import Config, ConfigError, UserError
from pewm_jax.io import atomic, weights
from pewm_jax.train import processes, stages
from pewm_jax.types import Params

CONFIG = "config.json"
WEIGHTS = "weights.safetensors"
BASE = "base.json"

MUTABLE_FIELDS = (
    "evaluate",
    "data.features",
    "data.prepared_path",
    "data.workers",
    "data.bad_records",
    "model.noise.sample_steps",
    "model.noise.sampler",
    "model.noise.spacing",
    "model.noise.steps_offset",
    "model.noise.stride",
    "model.noise.set_alpha_to_one",
    "model.noise.guidance",
    "model.noise.dynamic_guidance",
    "model.noise.sigma_min",
    "model.noise.sigma_max",
    "model.noise.rho",
    "model.noise.ends",
    "train.run",
    "train.save_every",
    "train.keep",
    "train.keep_every",
    "train.mesh",
    "train.fresh",
    "train.on_nonfinite",
    "train.grace_s",
    "train.log_every",
    "train.preview_every",
    "train.wandb",
)
"""Settings that may change between one start of a run and the next: none alters what is learnt.

``data.features`` is one: the features are checked by their hashes when they are opened. So is
``data.prepared_path``: folders in it are named by what the clips in them depend on.
"""
KEPT = ("noise_key", "beta1", "beta2", "epsilon")
"""Settings of ``train`` that versions up to 3 did not have; ``resumed`` keeps a run's own."""


def identity(config: Config) -> dict[str, Any]:
    """Return the settings that make a run what it is, flat: ``{"train.seed": 0, …}``."""
    flat = _flatten(json.loads(json.dumps(configuration.to_dict(config))))
    return {name: value for name, value in flat.items() if not _is_mutable(name)}


def differences(there: dict[str, Any], here: dict[str, Any]) -> list[str]:
    """List the settings in which two identities differ, with both values.

    Settings in ``MUTABLE_FIELDS`` are ignored, also those that older versions compared.
    """
    return [
        f"{name} {there.get(name)} there, {here.get(name)} here"
        for name in sorted(there.keys() | here.keys())
        if there.get(name) != here.get(name) and not _is_mutable(name)
    ]


def phrase(wrong: list[str]) -> str:
    """Join differences for a message, the first few in full."""
    more = f"; and {len(wrong) - 4} more" if len(wrong) > 4 else ""
    return "; ".join(wrong[:4]) + more


def check(config: Config) -> Path:
    """Make the run's folder, or make sure that an existing one is of this configuration.

    Writes nothing into it; see ``prepare``.

    Raises:
        ConfigError: the folder holds training of another configuration.
        UserError: the path is not a folder.
    """
    run = Path(config.train.run)
    try:
        run.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"train.run {run} cannot be made ({error.strerror}); choose another."
        ) from None
    path = run / CONFIG
    if has_begun(run):
        there, here = configuration.load(path), resumed(config, lambda _: None)
        wrong = differences(identity(there), identity(here))
        if wrong:
            raise ConfigError(
                f"{run} was trained with another configuration ({phrase(wrong)}): give this one "
                f"its own folder with --train.run, or put the settings back, or delete {run}."
            )
    return run


def has_begun(run: Path) -> bool:
    """Return whether a folder holds weights or checkpoints of a training."""
    return (run / WEIGHTS).exists() or any(run.glob("checkpoints/*/[0-9]*"))


def resumed(config: Config, log: Callable[[str], None] = print) -> Config:
    """Return the settings with which a run is resumed.

    A run begun by version 3 or earlier has the settings ``KEPT`` as they were fixed then; where a
    preset has other values now, the run's own are kept, and ``log`` gets a line.
    """
    run = Path(config.train.run)
    if not has_begun(run):
        return config
    there = configuration.load(run / CONFIG).train
    kept = {name: getattr(there, name) for name in KEPT}
    kept = {name: value for name, value in kept.items() if value != getattr(config.train, name)}
    if there.noise_key != "weights" or not kept:
        return config
    listed = ", ".join(f"train.{name} {value}" for name, value in kept.items())
    log(f"{run} keeps the settings that it was begun with: {listed}")
    return dataclasses.replace(config, train=dataclasses.replace(config.train, **kept))


def prepare(config: Config) -> Path:
    """Check the run's folder and write down its configuration; only within ``alone``."""
    run = check(config)
    configuration.save(config, run / CONFIG)
    base = Path(config.train.start) / BASE
    if config.train.start and base.is_file():
        atomic.write_text(run / BASE, base.read_text("utf-8"))
    return run


def is_finished(run: Path, config: Config) -> bool:
    """Tell whether the weights of the last planned stage are published and undamaged."""
    last = stages.planned(config)[-1]
    return is_published(run, last, last.settings(config).steps)


def is_published(run: Path, stage: stages.Stage, step: int) -> bool:
    """Tell whether the run's file of weights is of this stage and step, and undamaged."""
    path = run / WEIGHTS
    try:
        if (
            not path.exists()
            or not _metadata(stage, step).items() <= weights.metadata(path).items()
        ):
            return False
        weights.verify(path)
    except UserError:
        return False
    return True


def publish(run: Path, stage: stages.Stage, step: int, params: Params) -> Path:
    """Write the weights that ``pewm_jax.load`` reads; returns the file. Called by all processes."""
    path = run / WEIGHTS
    params = processes.gather(params)
    if processes.is_primary():
        for partial in run.glob(f"{WEIGHTS}.*partial"):
            atomic.remove(partial)  # of a process that was killed
        weights.save(path, params, _metadata(stage, step))
    return path


def _metadata(stage: stages.Stage, step: int) -> dict[str, str]:
    return {"stage": str(stage.number), "step": str(step)}


@contextlib.contextmanager
def alone(run: Path) -> Iterator[None]:
    """Lock the folder against other trainings; the lock ends with the process.

    Raises:
        UserError: another process is training there.
    """
    with (run / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UserError(
                f"Another process is training in {run}: wait for it, or use another --train.run."
            ) from None
        yield


def _is_mutable(name: str) -> bool:
    return any(name == one or name.startswith(one + ".") for one in MUTABLE_FIELDS)


def _flatten(node: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(node, dict):
        return {prefix: node}
    out: dict[str, Any] = {}
    for name, value in node.items():
        out |= _flatten(value, f"{prefix}.{name}" if prefix else name)
    return out
