"""Checks, displays and logs the metrics of each step: finite loss and gradient, speed, MFU.

Only process 0 writes and displays; all processes stop when a value is not finite.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax

from pewm_jax.config import Config, UserError
from pewm_jax.data import loader
from pewm_jax.data.loader import BadRecords
from pewm_jax.io import atomic
from pewm_jax.train import chips, feed, processes
from pewm_jax.train.log import LiveView, MetricsLog, Pace
from pewm_jax.train.sinks import drop_after
from pewm_jax.train.step import Metrics
from pewm_jax.types import Params
from pewm_jax.worlds.stages import Stage

SKIPPED = "nonfinite.jsonl"
"""File in the run's folder with a line for every skipped update."""


@dataclasses.dataclass
class Watch:
    """Reads, checks, displays and logs the metrics of one stage, of which ``done`` steps are done.

    Attributes:
        flops: FLOPs that a step needs (``train.flops``), set when the first batch is known.
    """

    config: Config
    stage: Stage
    run: Path
    done: int
    devices: int
    view: LiveView
    log: MetricsLog
    bad: BadRecords
    flops: float = 0.0

    def __post_init__(self):
        self.settings = self.stage.settings(self.config)
        self.pace = Pace(time.monotonic())
        self._chip = chips.find(jax.devices()[0].device_kind)
        self._skipped = self._skipped_before(self.done)

    def read(self, step: int, metrics: Metrics, kept: Callable[[], str]) -> dict[str, float]:
        """Wait for a step's metrics, check and display them.

        ``kept`` returns a phrase that names the newest checkpoint on disk.

        Raises:
            UserError: loss or gradient is not finite, and such steps are not to be skipped.
        """
        values = {name: float(value) for name, value in jax.device_get(metrics).items()}
        skipped = bool(values.pop("skipped", 0.0))
        if not (math.isfinite(values["loss"]) and math.isfinite(values["grad_norm"])):
            self._not_finite(step, values, skipped, kept)
        seconds = self.pace.tick(time.monotonic())
        rate = self.flops / seconds / self.devices
        values |= {
            "step_seconds": seconds,
            "clips_per_second": self.settings.batch / seconds,
            "tflops_per_second_per_device": rate / 1e12,
        }
        if self._chip is not None:
            values["mfu"] = rate / self._chip.flops
        if self.config.train.on_nonfinite == "skip":
            values["skipped"] = float(self._skipped)
        if self.config.data.bad_records:
            values["bad_records"] = float(len(self.bad))
        self.view.update(step, values)
        return values

    def write(self, step: int, values: Mapping[str, float], always: bool = False) -> None:
        """Log a step every ``train.log_every`` steps, or ``always``."""
        if always or step in (1, self.settings.steps) or step % self.config.train.log_every == 0:
            self.log.write(step, values)

    def _not_finite(
        self, step: int, values: Mapping[str, float], skipped: bool, kept: Callable[[], str]
    ) -> None:
        """Save the names of the batch's records; raise unless the update was skipped."""
        what = f"loss {values['loss']} and gradient norm {values['grad_norm']}"
        self._skipped += skipped
        name = SKIPPED if skipped else f"nonfinite-{self.stage.name}-{step}.json"
        path = self.run / name
        if processes.is_primary():
            entry = {
                "stage": self.stage.number,
                "step": step,
                "loss": _number(values["loss"]),
                "grad_norm": _number(values["grad_norm"]),
                **self._records(step),
                "time": round(time.time(), 3),
            }
            if skipped:
                with path.open("a") as file:
                    file.write(json.dumps(entry, ensure_ascii=False) + "\n")
            else:
                atomic.write_text(path, json.dumps(entry, ensure_ascii=False, indent=2) + "\n")
        if skipped:
            self.view.log(
                f"{self.stage.title}: step {step} is skipped because {what} are not both finite; "
                f"{path} lists its records"
            )
            return
        raise UserError(
            f"{self.stage.title.capitalize()} stopped at step {step}: {what} are not both finite "
            f"({kept()}); {path} lists the batch's records: skip such steps with "
            "--train.on_nonfinite skip, or train again in another --train.run with a lower "
            f"--train.{self.stage.name}.learning_rate."
        )

    def _records(self, step: int) -> dict[str, object]:
        """Return the names of the records in a step's batch, or the reason why they are unknown."""
        once, batch = self.config.data.prepared > 0, self.settings.batch
        seed = (
            feed.prepared_seed(self.config, self.stage)
            if once
            else self.stage.data_seed(self.config)
        )

        def read(number: int) -> list[str]:
            return loader.records(self.config, "train", seed=seed, batch=batch, step=number)

        try:
            if once:
                rows = feed.prepared_rows(self.config, self.stage, step - 1)
                names = [read(row // batch)[row % batch] for row in rows]
            else:
                names = read(step - 1)
        except UserError as error:
            return {"records": [], "why_not": str(error)}
        return {"records": names}

    def _skipped_before(self, done: int) -> int:
        """Drop records of updates skipped after step ``done``; return how many remain."""
        path = self.run / SKIPPED
        if processes.is_primary():
            drop_after(path, self.stage.number, done)
        return len(path.read_text().splitlines()) if path.exists() else 0


def _number(value: float) -> float | str:
    """Return a finite number unchanged, others as text: JSON has no NaN or infinity."""
    return value if math.isfinite(value) else str(value)


IMAGINED = {"model": "model", "memory": "with its map", "empty": "empty map"}
"""Labels of samples: a model without a memory, one with its map, the same weights with an empty
map."""


@dataclasses.dataclass(frozen=True)
class Previewed:
    """The output of a preview.

    Attributes:
        files: pictures and videos.
        psnr: key of ``IMAGINED`` → PSNR in dB against the recording.
    """

    files: tuple[Path, ...]
    psnr: Mapping[str, float] = dataclasses.field(default_factory=dict)


Preview = Callable[[Params, Stage, int], Previewed]
"""Called with inference weights, stage and step; writes samples and measures them."""


@dataclasses.dataclass
class Samples:
    """Makes, displays and measures the samples of a stage.

    ``unless_stopped`` calls work that a stop signal may interrupt (``Stop.unless_requested``).
    """

    config: Config
    stage: Stage
    preview: Preview | None
    log: Callable[[str], Any]
    unless_stopped: Callable[[Callable[[], Previewed]], Previewed | None]
    _made: bool = False

    def due(self, step: int) -> bool:
        """Return whether a step has samples: every ``train.preview_every``-th and the last."""
        every, steps = self.config.train.preview_every, self.stage.settings(self.config).steps
        return self.preview is not None and every > 0 and (step % every == 0 or step == steps)

    def make(self, params: Params, step: int) -> dict[str, float]:
        """Make samples, unless a signal interrupts it or they do not fit into memory.

        Called by all processes; process 0, to which the inference weights are gathered, makes them.

        Returns:
            PSNR in dB, by metric name for the log.
        """
        params, preview = processes.gather(params), self.preview
        if preview is None or not processes.is_primary():
            return {}
        if not self._made:
            self.log(f"{self.stage.title}: compiling the sampler for sample pictures …")
        self._made = True
        try:
            made = self.unless_stopped(lambda: preview(params, self.stage, step))
        except (jax.errors.JaxRuntimeError, UserError) as error:
            reason = " ".join(str(error).split())[:160]
            self.log(f"{self.stage.title}: no sample pictures of step {step} ({reason})")
            return {}
        if made is None:
            return {}
        scores = ", ".join(f"{IMAGINED[name]} {value:.1f} dB" for name, value in made.psnr.items())
        files = f"sample pictures {' and '.join(map(str, made.files))}"
        self.log(f"{self.stage.title}: {f'{scores}; {files}' if scores else files}")
        return {f"psnr_{name}": value for name, value in made.psnr.items()}
