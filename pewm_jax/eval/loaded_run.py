"""Load trained runs for an evaluation, and find the folder of the report."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from pewm_jax import shipped
from pewm_jax.config import Config, UserError
from pewm_jax.io import weights
from pewm_jax.io.store import file_hash
from pewm_jax.train import stages
from pewm_jax.types import Params
from pewm_jax.worlds import require_world
from pewm_jax.worlds.rollouts import load_finished

WEIGHTS = "weights.safetensors"
OWN = "report"
"""The folder in a run for the report of its own data."""


@dataclasses.dataclass(frozen=True)
class LoadedRun:
    """A trained run.

    Attributes:
        folder: where its configuration and weights are; may be read-only.
        home: the folder that its reports go to.
        config: its configuration.
        params: its weights.
        weights_hash: sha256 of the file of weights.
    """

    folder: Path
    home: Path
    config: Config
    params: Params
    weights_hash: str

    @property
    def steps(self) -> dict[str, int]:
        """The steps that its weights were trained for, by stage."""
        facts = weights.metadata(self.folder / WEIGHTS)
        last, done = int(facts.get("stage", 0)), int(facts.get("step", 0))
        return {
            stage.name: stage.settings(self.config).steps if stage.number < last else done
            for stage in stages.all_stages(self.config)
            if stage.number <= last
        }


def folders(run: str | Path) -> tuple[Path, Path]:
    """Return where a run is and where its reports go.

    Args:
        run: a run folder, or the name of a model that comes with the library: its files are in
            the package, which is not written to, and its reports go to ``runs/NAME``.

    Raises:
        UserError: there is no such folder.
    """
    folder = shipped.find(run)
    if not folder.is_dir():
        raise UserError(f"{run} does not exist; train a model first, e.g. `pewm-jax train demo`.")
    return folder, shipped.home(run)


def open_run(run: str | Path, config: Config | None = None) -> LoadedRun:
    """Load a run of a world model.

    Args:
        run: a run folder, or the name of a model that comes with the library.
        config: its configuration, if it is read already.

    Raises:
        UserError: it is absent, damaged, or of a world of which there is no report.
    """
    folder, home = folders(run)
    config, params = load_finished(folder, config=config)
    require_world(config.model, f"evaluating {run}")
    return LoadedRun(folder, home, config, params, file_hash(folder / WEIGHTS))


def has_memory(opened: LoadedRun) -> bool:
    """Tell whether a run's model has a memory; False where it was trained without one on purpose.

    That is, its memory is of kind ``none``, or no stage that trains one was asked for.

    Raises:
        UserError: training is not finished.
    """
    known = stages.all_stages(opened.config)
    asked = [stage for stage in known if stage.memory and stage.settings(opened.config).steps > 0]
    can = opened.config.model.capabilities
    if not can.memory_parameters:
        _require_all_steps(opened)
        return can.memory
    if can.memory_parameters not in opened.params:
        if asked:
            raise UserError(
                f"{opened.folder / WEIGHTS} has no memory blocks yet, only stage 1 is trained; "
                "finish training with `pewm-jax train`, which goes on where it stopped."
            )
        _require_all_steps(opened)
        return False
    return can.memory


def _require_all_steps(opened: LoadedRun) -> None:
    """Refuse a run of which a stage was trained for fewer steps than its settings ask for."""
    for stage in stages.all_stages(opened.config):
        wanted = stage.settings(opened.config).steps
        done = opened.steps.get(stage.name, wanted if not opened.steps else 0)
        if done < wanted:
            raise UserError(
                f"{opened.folder / WEIGHTS} is of step {done} and {wanted} of {stage.name} were "
                "asked for; finish training with `pewm-jax train`, which goes on where it stopped."
            )


def report_folder(opened: LoadedRun, config: Config) -> Path:
    """Return where the report of some data goes: ``report``, or ``report-NAME`` of other data.

    Args:
        opened: the run.
        config: its configuration, with overrides for the evaluation.
    """
    data, split = Path(config.data.path), config.evaluate.split
    other = []
    if data.resolve() != Path(opened.config.data.path).resolve():
        other.append(data.resolve().name)
    if split != opened.config.evaluate.split:
        other.append(split.strip("/").replace("/", "-") or "all")
    return opened.home / "-".join([OWN, *other])


def open_none(opened: LoadedRun, config: Config) -> LoadedRun | None:
    """Open the run without a memory that ``evaluate.none`` names, or return None.

    Its configuration gets the protocol of the evaluation: the same clips, context, batch
    and number of sampling steps.

    Raises:
        UserError: it does not exist, or cannot be compared: other clips or another codec, or fewer
            steps without a memory than the model has in all.
    """
    name = config.evaluate.none
    if not name:
        return None
    other = open_run(name)
    for part in ("clip", "codec"):
        there, here = (getattr(one.model, part, None) for one in (other.config, config))
        if there != here:
            raise UserError(
                f"evaluate.none: {name} has another {part} than {opened.folder} "
                f"({_difference(there, here)}), so they cannot be compared; train one with the "
                "same."
            )
    done, needed = _without_memory(other), _in_all(opened)
    if done < needed:
        raise UserError(
            f"evaluate.none: {name} was trained for {done} steps without a memory and "
            f"{opened.folder} for {needed} in all; train it longer{_how(opened, needed)}, "
            "or the comparison would favour the memory."
        )
    model = other.config.model
    if config.model.sample_steps and model.sample_steps:
        model = model.with_sample_steps(config.model.sample_steps)
    laid = dataclasses.replace(
        other.config, model=model, data=config.data, evaluate=config.evaluate
    )
    return dataclasses.replace(other, config=laid)


def _how(opened: LoadedRun, steps: int) -> str:
    """Return the flags that train a world as long without its memory, in brackets."""
    known = [stage for stage in stages.all_stages(opened.config) if not stage.optional]
    alone = next((stage for stage in known if not stage.memory), None)
    if alone is None:
        return ""
    flags = [f"--train.{alone.name}.steps {steps}"]
    flags += [f"--train.{stage.name}.steps 0" for stage in known if stage.memory]
    return f" ({' '.join(flags)})"


def none_facts(none: LoadedRun, opened: LoadedRun) -> dict[str, Any]:
    """Return what the report says of the run without a memory."""
    return {
        "run": str(none.folder),
        "weights_sha256": none.weights_hash,
        "steps": _without_memory(none),
        "steps_with_memory": _in_all(opened),
    }


def _in_all(opened: LoadedRun) -> int:
    """Return the steps of all stages: those done, or those planned where the file does not say."""
    planned = [stage.settings(opened.config).steps for stage in stages.all_stages(opened.config)]
    return sum(opened.steps.values() or planned)


def _without_memory(opened: LoadedRun) -> int:
    """Return the steps of the stages that train the part that works without a memory."""
    known = {stage.name: stage for stage in stages.all_stages(opened.config)}
    return sum(steps for name, steps in opened.steps.items() if not known[name].memory)


def _difference(there: Any, here: Any) -> str:
    if type(there) is not type(here):
        return f"{type(there).__name__} there, {type(here).__name__} here"
    wrong = [
        f"{field.name} {getattr(there, field.name)} there, {getattr(here, field.name)} here"
        for field in dataclasses.fields(there)
        if getattr(there, field.name) != getattr(here, field.name)
    ]
    return "; ".join(wrong)
