"""A run: its stages, and its folder with configuration, finished weights and lock.

::

    runs/demo/config.json           the experiment, written first
              metrics.jsonl         one line per logged step; as all logs, if `train.log` says so
              tensorboard/          the same for TensorBoard
              rerun/                the same for Rerun
              wandb/, wandb.id      the same for Weights & Biases
              checkpoints/stage1/   by Orbax, see ``checkpoint``
              previews/             sample pictures
              weights.safetensors   inference weights, written at the end of each stage
              base.json             the converted checkpoint it started from, if any
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
from pewm_jax import shipped, worlds
from pewm_jax.config import Config, ConfigError, UserError
from pewm_jax.io import atomic, weights
from pewm_jax.train import processes
from pewm_jax.types import Params
from pewm_jax.worlds import lora, rollouts
from pewm_jax.worlds.stages import Stage

CONFIG = "config.json"
WEIGHTS = "weights.safetensors"
BASE = "base.json"

SAMPLER = (
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
    "model.noise.rendered_until",
    "model.noise.temperature",
)
"""Settings of the sampler, on which only stages that train on imagined clips depend."""
MUTABLE_FIELDS = (
    "evaluate",
    "model.asked_alone",
    "data.features",
    "data.prepared_path",
    "data.workers",
    "data.bad_records",
    *SAMPLER,
    "train.run",
    "train.save_every",
    "train.keep",
    "train.keep_every",
    "train.mesh",
    "train.fresh",
    "train.wider",
    "train.on_nonfinite",
    "train.grace_s",
    "train.log_every",
    "train.preview_every",
    "train.log",
)
"""Settings that may change when a run is resumed: none affects what is learned, except that those
of ``SAMPLER`` affect stages that train on imagined clips; runs with such stages keep them.

``data.features`` is one: features are checked by their hashes when they are opened. So is
``data.prepared_path``: its subfolders are named by hashes of all that the clips depend on."""
KEPT = ("noise_key", "beta1", "beta2", "epsilon")
"""Settings of ``train`` that versions up to 3 did not have; ``resumed`` keeps a run's own
values."""


def all_stages(config: Config) -> tuple[Stage, ...]:
    """Return the stages that the experiment's world defines, in order.

    Optional ones without steps are left out.
    """
    return lora.adapt(config, _known(config))


def _known(config: Config) -> tuple[Stage, ...]:
    """Return the stages without adapters."""
    return tuple(
        stage
        for stage in worlds.stages(config.model)
        if not stage.optional or stage.settings(config).steps > 0
    )


def planned(config: Config) -> tuple[Stage, ...]:
    """Return the stages with steps to train, in order.

    Raises:
        ConfigError: no stage has steps.
        UserError: the model has no parameters that one of them could train.
    """
    known = all_stages(config)
    stages = tuple(stage for stage in known if stage.settings(config).steps > 0)
    if not stages:
        names = " and ".join(f"train.{stage.name}.steps" for stage in known)
        raise ConfigError(
            f"{names} are {'both' if len(known) == 2 else 'all'} 0, so nothing would be trained: "
            "set one of them."
        )
    for stage in stages:
        if stage.require is not None:
            stage.require(config.model)
    return stages


def identity(config: Config) -> dict[str, Any]:
    """Return the settings that identify a run, flattened: ``{"train.seed": 0, …}``."""
    flat = _flatten(json.loads(json.dumps(configuration.to_dict(config))))
    return {name: value for name, value in flat.items() if not _is_mutable(name)}


def differences(there: dict[str, Any], here: dict[str, Any]) -> list[str]:
    """Return descriptions of the settings in which two identities differ, with both values.

    Settings in ``MUTABLE_FIELDS`` are ignored, including those that older versions compared.
    """
    return [
        f"{name} {there.get(name)} there, {here.get(name)} here"
        for name in sorted(there.keys() | here.keys())
        if there.get(name) != here.get(name) and not _is_mutable(name)
    ]


def _sampler_differences(there: Config, here: Config) -> list[str]:
    """Return the differences of samplers, if a stage to train imagines its clips."""
    stages = [stage for stage in all_stages(here) if stage.settings(here).steps > 0]
    if not any("backbone" in stage.prepares_by for stage in stages):
        return []
    old, new = (_flatten(configuration.to_dict(config)) for config in (there, here))
    return [
        f"{name} {old.get(name)} there, {new.get(name)} here"
        for name in SAMPLER
        if old.get(name) != new.get(name)
    ]


def phrase(wrong: list[str]) -> str:
    """Join differences for a message; list only the first few."""
    more = f"; and {len(wrong) - 4} more" if len(wrong) > 4 else ""
    return "; ".join(wrong[:4]) + more


def check(config: Config) -> Path:
    """Create the run's folder, or check that an existing one has this configuration.

    Writes no file; see ``prepare``.

    Raises:
        ConfigError: the folder contains a run of another configuration.
        UserError: the path cannot be a folder.
    """
    run = Path(config.train.run)
    try:
        run.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"train.run {run} cannot be created ({error.strerror}): choose another folder."
        ) from None
    path = run / CONFIG
    if has_begun(run):
        there, here = configuration.load(path), resumed(config, lambda _: None)
        wrong = differences(identity(there), identity(here))
        wrong += _sampler_differences(there, here)
        if wrong:
            raise ConfigError(
                f"{run} was trained with another configuration ({phrase(wrong)}): choose another "
                f"folder with --train.run, restore the settings, or delete {run}."
            )
    return run


def has_begun(run: Path) -> bool:
    """Return whether a folder holds weights or checkpoints of a run."""
    return (run / WEIGHTS).exists() or any(run.glob("checkpoints/*/[0-9]*"))


def resumed(config: Config, log: Callable[[str], None] = print) -> Config:
    """Return the settings with which a run is started or resumed.

    With adapters, parameters that the start weights lack are added to ``train.lora.full``. A run
    begun by version 3 or earlier used fixed values for the settings ``KEPT``. If a preset now
    has other values, the run's own are kept, and ``log`` gets a line.
    """
    run, config = Path(config.train.run), _with_new_parameters(config, log)
    if not has_begun(run):
        return config
    there = configuration.load(run / CONFIG).train
    kept = {name: getattr(there, name) for name in KEPT}
    kept = {name: value for name, value in kept.items() if value != getattr(config.train, name)}
    if there.noise_key != "weights" or not kept:
        return config
    listed = ", ".join(f"train.{name} {value}" for name, value in kept.items())
    log(f"{run} keeps the settings that it was started with: {listed}")
    return dataclasses.replace(config, train=dataclasses.replace(config.train, **kept))


def _with_new_parameters(config: Config, log: Callable[[str], None]) -> Config:
    start = shipped.find(config.train.start)
    if not (config.train.lora.rank and config.train.start and (start / WEIGHTS).is_file()):
        return config
    stages = [stage for stage in _known(config) if stage.settings(config).steps > 0]
    params = rollouts.load_finished(start, lazily=True)[1]
    return lora.with_new_parameters(config, stages, params, log)


def prepare(config: Config) -> Path:
    """Check the run's folder and write its configuration; call only within ``alone``."""
    run = check(config)
    configuration.save(config, run / CONFIG)
    base = Path(config.train.start) / BASE
    if config.train.start and base.is_file():
        atomic.write_text(run / BASE, base.read_text("utf-8"))
    return run


def is_finished(run: Path, config: Config) -> bool:
    """Return whether the weights of the last planned stage are published and undamaged."""
    last = planned(config)[-1]
    return is_published(run, last, last.settings(config).steps)


def is_published(run: Path, stage: Stage, step: int) -> bool:
    """Return whether the run's weights file is of this stage and step, and undamaged."""
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


def publish(run: Path, stage: Stage, step: int, params: Params) -> Path:
    """Write the weights file for ``pewm_jax.load`` and return its path; called by all processes."""
    path = run / WEIGHTS
    params = processes.gather(params)
    if processes.is_primary():
        for partial in run.glob(f"{WEIGHTS}.*partial"):
            atomic.remove(partial)  # left by a killed process
        base = lora.reference(configuration.load(run / CONFIG)) if stage.stored else {}
        weights.save(path, params, _metadata(stage, step) | base)
    return path


def _metadata(stage: Stage, step: int) -> dict[str, str]:
    return {"stage": str(stage.number), "step": str(step)}


@contextlib.contextmanager
def alone(run: Path) -> Iterator[None]:
    """Lock the folder against other training processes; the lock ends with the process.

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
