"""A trace of a few steps, for TensorBoard and for Perfetto."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax

from pewm_jax.train.stages import Stage

FOLDER = "profile"
SKIPPED = 2
"""First steps that are not traced: they also load programs and fill caches."""


class Profile:
    """Traces some steps of a stage; does nothing where none are asked for.

    Args:
        run: the run's folder; the trace goes to ``profile/stage1`` inside.
        stage: the stage.
        steps: how many steps are traced, 0 for none.
        first: the first step of this start.
        last: the last step of the stage; a trace ends with it at the latest.
        say: prints where the trace is and what opens it.
    """

    def __init__(
        self,
        run: Path,
        stage: Stage,
        *,
        steps: int,
        first: int,
        last: int,
        say: Callable[[str], Any],
    ):
        self.folder = run / FOLDER / stage.name
        begin = max(min(first + SKIPPED, last - steps + 1), first)
        self._steps = range(begin, min(begin + steps, last + 1))
        self._stage, self._say = stage, say
        self._tracing = False
        self._traced = 0

    @contextlib.contextmanager
    def around(self, step: int) -> Iterator[None]:
        """Trace what is done inside, if this step is one of those."""
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
        """End the trace with its last step, once that is computed; returns seconds spent on it."""
        if not (self._tracing and step == self._steps[-1]):
            return 0.0
        jax.block_until_ready(result)
        began = time.monotonic()
        self.close()
        return time.monotonic() - began

    def close(self) -> None:
        """Write what was traced so far, if anything."""
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
