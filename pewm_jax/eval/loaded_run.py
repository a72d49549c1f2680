"""Load trained runs for an evaluation, and find the folder of the report."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from pewm_jax import shipped
from pewm_jax.config import Config, UserError
from pewm_jax.io import weights
from pewm_jax.io.store import file_hash
from pewm_jax.train import runs
from pewm_jax.types import Params
from pewm_jax.worlds import quantized, require_world
from pewm_jax.worlds.rollouts import load_finished

WEIGHTS = "weights.safetensors"
OWN = "report"
"""Folder in a run for the report on its own data."""


@dataclasses.dataclass(frozen=True)
class LoadedRun:
    """A trained run.

    Attributes:
        folder: folder of its configuration and weights; may be read-only.
        home: folder to which its reports are written.
        weights_hash: sha256 of the weights file.
    """

    folder: Path
    home: Path
    config: Config
    params: Params
    weights_hash: str

    @property
    def steps(self) -> dict[str, int]:
        """Return the number of training steps of its weights, by stage."""
        facts = weights.metadata(self.folder / WEIGHTS)
        last, done = int(facts.get("stage", 0)), int(facts.get("step", 0))
        return {
            stage.name: stage.settings(self.config).steps if stage.number < last else done
            for stage in runs.all_stages(self.config)
            if stage.number <= last
        }


def open_run(run: str | Path, config: Config | None = None) -> LoadedRun:
    """Load a run of a world model, by its folder or the name of a model that ships.

    The files of a model that ships are in the package, which is not written to; its reports go to
    ``runs/NAME``.

    Raises:
        UserError: it is missing, damaged, or of a world without reports.
    """
    folder = shipped.find(run)
    if folder.is_file():
        raise UserError(f"{run} is a file; give the folder of a run.")
    if not folder.is_dir():
        raise UserError(f"{run} does not exist; train a model first, e.g. `pewm-jax train demo`.")
    config, params = load_finished(folder, config=config)
    require_world(config.model, f"evaluating {run}")
    return LoadedRun(folder, shipped.home(run), config, params, file_hash(folder / WEIGHTS))


def with_precision(loaded: LoadedRun, precision: str) -> LoadedRun:
    """Return a run with weights in 8 bits, as for ``pewm_jax.load``; "" leaves them unchanged."""
    params = quantized.quantize(loaded.config.model, loaded.params, precision)
    return dataclasses.replace(loaded, params=params)


def has_memory(loaded: LoadedRun) -> bool:
    """Return whether a run's model has a memory; False if it was trained without one by intent.

    That is, its memory is of kind ``none``, or no stage that trains a memory was requested.

    Raises:
        UserError: training is not finished.
    """
    known = runs.all_stages(loaded.config)
    asked = [stage for stage in known if stage.memory and stage.settings(loaded.config).steps > 0]
    can = loaded.config.model.capabilities
    if not can.memory_parameters:
        _require_all_steps(loaded)
        return can.memory
    if can.memory_parameters not in loaded.params:
        if asked:
            raise UserError(
                f"{loaded.folder / WEIGHTS} has no memory blocks yet, because only stage 1 is "
                "trained; finish training with `pewm-jax train`, which resumes."
            )
        _require_all_steps(loaded)
        return False
    return can.memory


def _require_all_steps(loaded: LoadedRun) -> None:
    """Raise an error if a stage was trained for fewer steps than configured."""
    for stage in runs.all_stages(loaded.config):
        wanted = stage.settings(loaded.config).steps
        done = loaded.steps.get(stage.name, wanted if not loaded.steps else 0)
        if done < wanted:
            raise UserError(
                f"{loaded.folder / WEIGHTS} is from step {done} of {wanted} of {stage.name}; "
                "finish training with `pewm-jax train`, which resumes."
            )


def report_folder(loaded: LoadedRun, config: Config) -> Path:
    """Return the folder of a report: ``report``, or ``report-NAME`` for other data or weights."""
    data, split = Path(config.data.path), config.evaluate.split
    other = []
    if data.resolve() != Path(loaded.config.data.path).resolve():
        other.append(data.resolve().name)
    if split != loaded.config.evaluate.split:
        other.append(split.strip("/").replace("/", "-") or "all")
    if config.evaluate.quantize:
        other.append(config.evaluate.quantize)
    return loaded.home / "-".join([OWN, *other])


def open_none(loaded: LoadedRun, config: Config) -> LoadedRun | None:
    """Open the reference run without a memory (``evaluate.none``), or return None.

    Its configuration gets the protocol of the evaluation: the same clips, context, batch and number
    of sampling steps.

    Raises:
        UserError: it does not exist, or is not comparable: it has other clips or another codec, or
            was trained for fewer steps than the model's stages in total.
    """
    name = config.evaluate.none
    if not name:
        return None
    other = open_run(name)
    for part in ("clip", "codec"):
        there, here = (getattr(one.model, part, None) for one in (other.config, config))
        if there != here:
            raise UserError(
                f"evaluate.none: {name} has another {part} than {loaded.folder} "
                f"({_difference(there, here)}), so they are not comparable; train one with the "
                "same."
            )
    done, needed = _steps_without_memory(other), _total_steps(loaded)
    if done < needed:
        raise UserError(
            f"evaluate.none: {name} was trained for {done} steps without a memory and "
            f"{loaded.folder} for {needed} in total; train it longer{_flags_for(loaded, needed)}, "
            "or the comparison would favour the memory."
        )
    model = other.config.model
    if config.model.sample_steps and model.sample_steps:
        model = model.with_sample_steps(config.model.sample_steps)
    laid = dataclasses.replace(
        other.config, model=model, data=config.data, evaluate=config.evaluate
    )
    return dataclasses.replace(other, config=laid)


def _flags_for(loaded: LoadedRun, steps: int) -> str:
    """Return the flags that train a world for as many steps without its memory, in brackets."""
    known = [stage for stage in runs.all_stages(loaded.config) if not stage.optional]
    alone = next((stage for stage in known if not stage.memory), None)
    if alone is None:
        return ""
    flags = [f"--train.{alone.name}.steps {steps}"]
    flags += [f"--train.{stage.name}.steps 0" for stage in known if stage.memory]
    return f" ({' '.join(flags)})"


def none_facts(none: LoadedRun, loaded: LoadedRun) -> dict[str, Any]:
    """Return the report's entry on the run without a memory."""
    return {
        "run": str(none.folder),
        "weights_sha256": none.weights_hash,
        "steps": _steps_without_memory(none),
        "steps_with_memory": _total_steps(loaded),
    }


def _total_steps(loaded: LoadedRun) -> int:
    """Return the number of steps of all stages: those done, or those planned if unknown."""
    planned = [stage.settings(loaded.config).steps for stage in runs.all_stages(loaded.config)]
    return sum(loaded.steps.values() or planned)


def _steps_without_memory(loaded: LoadedRun) -> int:
    """Return the number of steps of the stages that train the model without its memory."""
    known = {stage.name: stage for stage in runs.all_stages(loaded.config)}
    return sum(steps for name, steps in loaded.steps.items() if not known[name].memory)


def _difference(there: Any, here: Any) -> str:
    if type(there) is not type(here):
        return f"{type(there).__name__} there, {type(here).__name__} here"
    wrong = [
        f"{field.name} {getattr(there, field.name)} there, {getattr(here, field.name)} here"
        for field in dataclasses.fields(there)
        if getattr(there, field.name) != getattr(here, field.name)
    ]
    return "; ".join(wrong)
