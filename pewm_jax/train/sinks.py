"""Where scalars are logged: JSON lines, TensorBoard, Weights & Biases, Rerun.

Each is a class with ``write`` and ``close``, made for one stage of a run of which some steps are
done; ``SINKS`` names them as ``train.log`` does.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import time
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

from pewm_jax import config as configuration
from pewm_jax.config import Config, UserError
from pewm_jax.io import atomic
from pewm_jax.worlds.stages import Stage

METRICS = "metrics.jsonl"
"""File in a run's folder with one JSON line per logged step."""
FLUSH_S = 10
"""Seconds between writes of TensorBoard events; JSON lines are written immediately."""
ID = "wandb.id"
"""File in a run's folder with the Weights & Biases run ids of its stages."""
PROJECT = "pewm-jax"
"""Project of Weights & Biases, if neither ``train.log`` nor WANDB_PROJECT names one."""


class Sink(Protocol):
    """A log of scalars."""

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log the scalars of one step."""
        ...

    def close(self, failed: bool) -> None:
        """Flush and close the log; ``failed``: training ends with an error."""
        ...


class JsonLines:
    """One JSON line per step in ``metrics.jsonl``; NaN and infinity, which JSON lacks, are null."""

    def __init__(self, run: Path, stage: Stage, step: int, config: Config, argument: str):
        del config, argument
        self._stage = stage.number
        drop_after(run / METRICS, stage.number, step)
        self._file = (run / METRICS).open("a")

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Append a line."""
        values = {name: value if math.isfinite(value) else None for name, value in metrics.items()}
        line = {"stage": self._stage, "step": step, **values, "time": round(time.time(), 3)}
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()

    def close(self, failed: bool) -> None:
        """Close the file."""
        del failed
        self._file.close()


class TensorBoard:
    """Event files in ``tensorboard/STAGE``."""

    def __init__(self, run: Path, stage: Stage, step: int, config: Config, argument: str):
        del config, argument
        # Imported lazily: it takes a second, and imports torch if that is installed.
        import tensorboardX  # noqa: PLC0415

        self._events = tensorboardX.SummaryWriter(
            str(run / "tensorboard" / stage.name),
            purge_step=step + 1 if step else None,
            flush_secs=FLUSH_S,
        )

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Add an event per scalar."""
        for name, value in _finite(metrics).items():
            self._events.add_scalar(name, value, step)

    def close(self, failed: bool) -> None:
        """Write what is buffered."""
        del failed
        self._events.close()


class Rerun:
    """Files ``rerun/STAGE-STEP.rrd``, where STEP is the first step that they may hold.

    All files of a stage are one recording: `rerun runs/demo/rerun/*.rrd` shows them joined, and a
    step that was repeated after a kill overlays the former one.
    """

    def __init__(self, run: Path, stage: Stage, step: int, config: Config, argument: str):
        del config, argument
        rerun: Any = importlib.import_module("rerun")
        folder = run / "rerun"
        folder.mkdir(exist_ok=True)
        self._rerun = rerun
        self._stream = rerun.RecordingStream(PROJECT, recording_id=f"{run.name}-{stage.name}")
        self._stream.save(folder / f"{stage.name}-{step + 1:07d}.rrd")

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log each scalar under its name, on the timeline ``step``."""
        self._stream.set_time("step", sequence=step)
        for name, value in _finite(metrics).items():
            self._stream.log(name, self._rerun.Scalars(value))

    def close(self, failed: bool) -> None:
        """Write what is buffered."""
        del failed
        self._stream.flush()
        self._stream.disconnect()


class WeightsAndBiases:
    """A run of Weights & Biases for each stage, grouped by the name of the run's folder."""

    def __init__(self, run: Path, stage: Stage, step: int, config: Config, argument: str):
        del step  # steps that are sent again are ignored there
        self._run = start_wandb(config, run, stage, argument)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Send the scalars."""
        self._run.log(_finite(metrics), step=step)

    def close(self, failed: bool) -> None:
        """Finish the run."""
        self._run.finish(exit_code=int(failed))


SINKS: Mapping[str, Callable[[Path, Stage, int, Config, str], Sink]] = {
    "jsonl": JsonLines,
    "tensorboard": TensorBoard,
    "wandb": WeightsAndBiases,
    "rerun": Rerun,
}
"""Name in ``train.log`` → the log. Its arguments are the run's folder, the stage, the number of its
finished steps, the experiment, and what follows a colon after the name."""


def require_packages(config: Config) -> None:
    """Raise UserError if a log of ``train.log`` needs a package that is not installed."""
    imports: Mapping[str, tuple[str, Callable[[], Any]]] = {  # each takes a second
        "wandb": ("Weights & Biases", lambda: importlib.import_module("wandb")),
        "rerun": ("Rerun", lambda: importlib.import_module("rerun")),
    }
    for log in config.train.logs.keys() & imports.keys():
        name, load = imports[log]
        try:
            load()
        except ImportError:
            raise UserError(
                f"train.log {log} needs {name}, which is not installed: pip install "
                f"'pewm-jax[{log}]'."
            ) from None


def drop_after(path: Path, stage: int, step: int) -> None:
    """Drop the log lines after ``step`` of stage number ``stage``, and a partial last line."""
    if not path.exists():
        return
    kept = []
    for line in path.read_text().splitlines():
        try:
            entry = json.loads(line)
        except json.JSONDecodeError:
            continue
        if (entry["stage"], entry["step"]) <= (stage, step):
            kept.append(line + "\n")
    atomic.write_text(path, "".join(kept))


def start_wandb(config: Config, run: Path, stage: Stage, project: str = "") -> Any:
    """Start or resume the run of a stage in a project of Weights & Biases.

    ``project``: by default the one that the environment variable WANDB_PROJECT names, or
    ``PROJECT``.

    Raises:
        UserError: no user is logged in, or the run cannot be started.
    """
    wandb: Any = importlib.import_module("wandb")
    try:
        return wandb.init(
            project=project or os.environ.get("WANDB_PROJECT") or PROJECT,
            name=f"{run.name} {stage.name}",
            group=run.name,
            id=f"{_id(run)}-{stage.name}",
            resume="allow",
            dir=str(run),
            config=configuration.to_dict(config),
            settings=wandb.Settings(console="off"),  # the live view prints already
        )
    except wandb.Error as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise UserError(
            f"Weights & Biases cannot start ({reason}): run `wandb login` first, set "
            "WANDB_MODE=offline to log locally only, or choose another --log."
        ) from None


def _id(run: Path) -> str:
    """Return the id stored in the run's folder; create it on first use."""
    path = run / ID
    if not path.exists():
        atomic.write_text(path, uuid.uuid4().hex[:12])
    return path.read_text("utf-8").strip()


def _finite(metrics: Mapping[str, float]) -> dict[str, float]:
    return {name: value for name, value in metrics.items() if math.isfinite(value)}
