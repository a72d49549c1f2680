"""Training logs: scalars of logged steps where ``train.log`` says, a live view, and profiles.

The live view is a progress bar on a terminal, and otherwise a line every ten seconds.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Self

import jax
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from pewm_jax.config import Config
from pewm_jax.io.progress import duration
from pewm_jax.train import processes
from pewm_jax.train.sinks import SINKS, Sink
from pewm_jax.worlds.stages import Stage

LINE_EVERY_S = 10.0
"""Seconds between lines of the live view if the output is not a terminal."""


class MetricsLog:
    """Logs scalars where ``train.log`` says; a context manager.

    Steps after ``step``, from which the stage is resumed, are dropped from earlier logs, so that
    every step is logged once. Only process 0 writes.

    Raises:
        UserError: a log needs a package that is not installed, or cannot start.
    """

    def __init__(self, run: Path, stage: Stage, step: int, config: Config):
        self._sinks: list[Sink] = []
        if not processes.is_primary():
            return
        for name, argument in config.train.logs.items():
            self._sinks.append(SINKS[name](run, stage, step, config, argument))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        # Do not let a full disk mask the error being raised.
        unmasked = contextlib.nullcontext() if error is None else contextlib.suppress(OSError)
        with unmasked, contextlib.ExitStack() as stack:
            for sink in self._sinks:
                stack.callback(sink.close, error is not None)

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log the scalars of one step; numbers that are not finite are left out or null."""
        for sink in self._sinks:
            sink.write(step, metrics)


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
