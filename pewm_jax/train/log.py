"""Training logs: one JSON line and one TensorBoard event per logged step, and a live view.

If ``train.wandb`` names a project, the same scalars are sent to Weights & Biases. The live view is
a progress bar on a terminal, and otherwise a line every ten seconds.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Self

import jax
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from pewm_jax import config as configuration
from pewm_jax.config import Config, UserError
from pewm_jax.io import atomic
from pewm_jax.train import processes
from pewm_jax.worlds.stages import Stage

FLUSH_S = 10
"""Seconds between writes of TensorBoard events; JSON lines are written immediately."""
LINE_EVERY_S = 10.0
"""Seconds between lines of the live view if the output is not a terminal."""


class MetricsLog:
    """Appends scalars to ``metrics.jsonl`` and to TensorBoard; a context manager.

    Lines logged after the step from which the run is resumed (``step`` steps of the stage are done)
    are dropped, so that every step has one line. Only process 0 writes.

    Raises:
        UserError: ``config`` enables Weights & Biases, which cannot start.
    """

    def __init__(self, run: Path, stage: Stage, step: int, config: Config | None = None):
        self._stage = stage.number
        self._writes = processes.is_primary()
        if not self._writes:
            return
        # Imported lazily: it takes a second, and imports torch if that is installed.
        import tensorboardX  # noqa: PLC0415

        self._wandb = None
        if config is not None and config.train.wandb:
            self._wandb = start_wandb(config, run, stage)
        path = run / "metrics.jsonl"
        drop_after(path, stage.number, step)
        self._file = path.open("a")
        self._events = tensorboardX.SummaryWriter(
            str(run / "tensorboard" / stage.name),
            purge_step=step + 1 if step else None,
            flush_secs=FLUSH_S,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if not self._writes:
            return
        # Do not let a full disk mask the error being raised.
        with contextlib.nullcontext() if error is None else contextlib.suppress(OSError):
            try:
                self._file.close()
            finally:
                self._events.close()
                if self._wandb is not None:
                    self._wandb.finish(exit_code=int(error is not None))

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log the scalars of one step; NaN and infinity, which JSON lacks, become null."""
        if not self._writes:
            return
        finite = {name: value for name, value in metrics.items() if math.isfinite(value)}
        values = {name: finite.get(name) for name in metrics}
        line = {"stage": self._stage, "step": step, **values, "time": round(time.time(), 3)}
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()
        for name, value in finite.items():
            self._events.add_scalar(name, value, step)
        if self._wandb is not None:
            self._wandb.log(finite, step=step)


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


class Pace:
    """Smoothed seconds per step, excluding time spent on other work.

    The mean of the first ten steps, then an exponential moving average over about ten.
    """

    def __init__(self, now: float):
        self._last = now
        self._ticks = 0
        self._mean = 0.0

    def pause(self, seconds: float) -> None:
        """Exclude time in which no step was done."""
        self._last += seconds

    def tick(self, now: float) -> float:
        """Record a finished step and return the smoothed seconds per step."""
        seconds, self._last = max(now - self._last, 1e-9), now
        self._ticks += 1
        self._mean += (seconds - self._mean) / min(self._ticks, 10)
        return self._mean


class LiveView:
    """Shows progress, loss and speed of a stage of ``total`` steps; a context manager."""

    def __init__(self, label: str, total: int, done: int, console: Console | None = None):
        self._console = console or Console(file=sys.stdout, soft_wrap=True, highlight=False)
        self._label, self._total = label, total
        self._printed = time.monotonic()
        self._bar: Progress | None = None
        if self._console.is_terminal:
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(bar_width=20),
                MofNCompleteColumn(),
                TextColumn("{task.fields[text]}"),
                console=self._console,
                refresh_per_second=4,
            )
            self._task = self._bar.add_task(label, total=total, completed=done, text="")

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def log(self, text: str) -> None:
        """Print a line."""
        self._console.print(text, markup=False)
        self._printed = time.monotonic()

    def update(self, step: int, metrics: Mapping[str, float]) -> None:
        """Show a finished step; the last one is always shown."""
        text = describe(metrics, (self._total - step) * metrics["step_seconds"])
        if self._bar is not None:
            self._bar.update(self._task, completed=step, text=text)
        elif step == self._total or time.monotonic() - self._printed >= LINE_EVERY_S:
            self.log(f"{self._label} {step}/{self._total} {text}")


def describe(metrics: Mapping[str, float], seconds_left: float) -> str:
    """Format the metrics of a step as one line."""
    return (
        f"loss {metrics['loss']:.4f} · lr {metrics['learning_rate']:.2e} · "
        f"grad {metrics['grad_norm']:.3g} · {duration(metrics['step_seconds'])}/step · "
        f"{metrics['clips_per_second']:.1f} clips/s · {_work(metrics)} · "
        f"{_counts(metrics)}{duration(seconds_left)} left"
    )


def _work(metrics: Mapping[str, float]) -> str:
    """Format the FLOP/s per device, and the MFU if the peak is known."""
    rate = metrics["tflops_per_second_per_device"]
    text = f"{rate:.1f} TFLOP/s" if rate >= 1 else f"{rate * 1e3:.3g} GFLOP/s"
    share = f" · MFU {metrics['mfu']:.1%}" if "mfu" in metrics else ""
    return f"{text}/device{share}"


def _counts(metrics: Mapping[str, float]) -> str:
    """Format the numbers of skipped updates and bad records, if any."""
    names = {"skipped": "skipped", "bad_records": "bad records"}
    return "".join(
        f"{name} {metrics[key]:.0f} · " for key, name in names.items() if metrics.get(key)
    )


def duration(seconds: float) -> str:
    """Format a duration, such as ``85 ms``, ``12.3 s``, ``4 min 05 s``, ``2 h 10 min``."""
    if seconds < 1:
        return f"{seconds * 1000:.0f} ms"
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


ID = "wandb.id"
"""File in a run's folder with the Weights & Biases run ids of its stages."""


def require_wandb() -> Any:
    """Return the module ``wandb``, or raise UserError if it is not installed."""
    try:
        return importlib.import_module("wandb")  # the import takes a second, so only on demand
    except ImportError:
        raise UserError(
            "train.wandb needs Weights & Biases, which is not installed: "
            "pip install 'pewm-jax[wandb]'."
        ) from None


def start_wandb(config: Config, run: Path, stage: Stage) -> Any:
    """Start or resume the run of a stage in the project ``train.wandb`` of Weights & Biases.

    Raises:
        UserError: the package is not installed, no user is logged in, or the run cannot be started.
    """
    wandb = require_wandb()
    try:
        return wandb.init(
            project=config.train.wandb,
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
            "WANDB_MODE=offline to log locally only, or omit --train.wandb."
        ) from None


def _id(run: Path) -> str:
    """Return the id stored in the run's folder; create it on first use."""
    path = run / ID
    if not path.exists():
        atomic.write_text(path, uuid.uuid4().hex[:12])
    return path.read_text("utf-8").strip()


FOLDER = "profile"
SKIPPED = 2
"""First steps that are not traced: they also load programs and fill caches."""


class Profile:
    """Traces some steps of a stage with JAX's profiler, into ``profile/STAGE`` of the run's folder.

    Args:
        run: the run's folder.
        stage: the stage.
        steps: number of steps to trace, 0 for none.
        first: the first step after starting or resuming.
        last: the last step of the stage; the trace ends there at the latest.
        log: prints where the trace is and how to open it.
    """

    def __init__(
        self,
        run: Path,
        stage: Stage,
        *,
        steps: int,
        first: int,
        last: int,
        log: Callable[[str], Any],
    ):
        self.folder = run / FOLDER / stage.name
        begin = max(min(first + SKIPPED, last - steps + 1), first)
        self._steps = range(begin, min(begin + steps, last + 1))
        self._stage, self._say = stage, log
        self._tracing = False
        self._traced = 0

    @contextlib.contextmanager
    def around(self, step: int) -> Iterator[None]:
        """Trace the body of the ``with`` statement if this step is to be traced."""
        if step not in self._steps:
            yield
            return
        if step == self._steps[0]:
            self.folder.mkdir(parents=True, exist_ok=True)
            jax.profiler.start_trace(self.folder)
            self._tracing = True
        with jax.profiler.StepTraceAnnotation("train", step_num=step):
            yield
        self._traced += 1

    def after(self, step: int, result: Any) -> float:
        """End the trace after its last step is computed; return the seconds spent on that."""
        if not (self._tracing and step == self._steps[-1]):
            return 0.0
        jax.block_until_ready(result)
        began = time.monotonic()
        self.close()
        return time.monotonic() - began

    def close(self) -> None:
        """Write the trace so far, if any."""
        if not self._tracing:
            return
        self._tracing = False
        jax.profiler.stop_trace()
        made = sorted(self.folder.rglob("*.trace.json.gz"), key=lambda p: p.stat().st_mtime)
        drop = f", or drop {made[-1]} on https://ui.perfetto.dev" if made else ""
        self._say(
            f"{self._stage.title}: traced {self._traced} step{'s'[: self._traced != 1]}; open with "
            f"`tensorboard --logdir {self.folder}` (and the xprof plugin){drop}"
        )
