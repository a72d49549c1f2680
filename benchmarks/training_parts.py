"""What ``training.py`` measures: the real loop with clocks in it, the input pipeline, processes.

The first two run in a process of their own (``python benchmarks/training_parts.py``), so that
imports, compiling and threads are those of a user's training.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import os
import signal
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

from pewm_jax import presets as configs
from pewm_jax.cli import parser as cli
from pewm_jax.config import Config

Spans = dict[str, list[tuple[float, float]]]
"""What was done → when it began and ended, each time (seconds of ``time.time``)."""


@contextlib.contextmanager
def clocks(interrupt: tuple[int, int] | None = None) -> Iterator[Spans]:
    """Note when the loop steps, compiles, waits for data, saves, restores and logs.

    Args:
        interrupt: stage and how many steps of it to begin before Ctrl-C comes; never by default.
    """
    from pewm_jax.train import loop
    from pewm_jax.train.checkpoint import Checkpoints
    from pewm_jax.train.feed import Feed
    from pewm_jax.train.log import LiveView, MetricsLog

    spans: Spans = {}

    def noted(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            began = time.time()
            try:
                return function(*args, **options)
            finally:
                spans.setdefault(name, []).append((began, time.time()))

        return call

    def compiled(config: Any, stage: Any, mesh: Any, clip: Any, *given: Any) -> Callable[..., Any]:
        step = compile_step(config, stage, mesh, clip, *given)
        name = f"step{stage.number}"

        def call(*args: Any) -> Any:
            import jax

            out = step(*args)
            if name not in spans or len(spans[name]) == 1:  # the end of a first step is of interest
                jax.block_until_ready(out)
            if (stage.number, len(spans.get(name, [])) + 1) == interrupt:
                os.kill(os.getpid(), signal.SIGINT)
            return out

        return noted(name, call)

    compile_step = noted("compile", loop.compile_step)
    patches = [
        mock.patch.object(loop, "compile_step", compiled),
        mock.patch.object(loop, "initial_state", noted("initial", loop.initial_state)),
    ]
    methods = [(Checkpoints, name, name) for name in ("save", "settle", "restore")]
    methods += [(MetricsLog, "write", "log"), (LiveView, "update", "log")]
    methods += [(Feed, "__next__", "data")]
    patches += [
        mock.patch.object(kind, method, noted(name, getattr(kind, method)))
        for kind, method, name in methods
    ]
    with contextlib.ExitStack() as stack:
        for patch in patches:
            stack.enter_context(patch)
        yield spans


def within(spans: Spans, names: Sequence[str], began: float, ended: float) -> list[float]:
    """Return the seconds of every span of these names that began in an interval."""
    return [b - a for name in names for a, b in spans.get(name, []) if began <= a < ended]


def summary(spans: Spans, stage: int) -> dict[str, float]:
    """Reduce the spans of one stage to seconds per step, per save, and so on.

    ``step`` is the median from one step to the next without what saving takes; ``save`` is what a
    save keeps the loop from stepping (copying, and waiting for the one before), ``behind`` how
    much longer the following steps take because it is still being written.
    """
    starts = [a for a, _ in spans[f"step{stage}"]][2:]  # the first two are waited for
    pairs = list(itertools.pairwise(starts))
    blocking = [sum(within(spans, ("save", "settle"), a, b)) for a, b in pairs]
    saved = [k for k, (a, b) in enumerate(pairs) if within(spans, ("save",), a, b)]
    bare = [b - a - held for (a, b), held in zip(pairs, blocking, strict=True)]
    after = {k + more for k in saved for more in (1, 2, 3)} & set(range(len(pairs)))
    quiet = [seconds for k, seconds in enumerate(bare) if k not in after and k not in saved]
    step = statistics.median(quiet)
    slowed = sum(bare[k] - step for k in after) / max(len(saved), 1)
    whole = starts[0], starts[-1]
    return {
        "step": step,
        "save": sum(blocking) / max(len(saved), 1),
        "behind": max(slowed, 0.0),
        "log": sum(within(spans, ("log",), *whole)) / len(pairs),
        "data": sum(within(spans, ("data",), *whole)) / len(pairs),
        "steps": float(len(pairs)),
        "saves": float(len(saved)),
    }


def launch(spans: Spans, stage: int, called: float) -> dict[str, float]:
    """Return the seconds from the call of a command to the end of its first step, in parts."""
    began, ended = spans[f"step{stage}"][0]

    def spent(name: str) -> float:
        return sum(within(spans, (name,), called, ended))

    return {
        "first": ended - called,
        "compile": spent("compile"),
        "state": spent("initial") + spent("restore"),
        "data": spent("data"),
        "step": ended - began,
    }


def train_with_clocks(argv: Sequence[str], interrupt: tuple[int, int] | None = None) -> Spans:
    """Run ``train.py`` here; an interruption that was asked for is no error."""
    from pewm_jax.cli import main

    with clocks(interrupt) as spans, contextlib.suppress(KeyboardInterrupt):
        main.execute(["train", *argv])
    return spans


def reading(config: Config, **settings: Any) -> Config:
    """Return the configuration with other settings of what is read."""
    return dataclasses.replace(config, data=dataclasses.replace(config.data, **settings))


def input_rates(
    config: Config, batch: int, batches: int, rounds: int, processes: int = 2
) -> dict[str, list[float]]:
    """Return seconds per batch of the loader and of torch's over the same records, in turns.

    Both draw and decode clips by the same code; what differs is who reads ahead: threads of Grain
    here, worker processes there.
    """
    import torch

    from pewm_jax.data import loader

    def ours(workers: int) -> Iterator[Any]:
        return loader.clips(reading(config, workers=workers), seed=0, batch=batch)

    peers = torch.utils.data.DataLoader(
        TorchClips(config),  # pyright: ignore[reportArgumentType]
        batch_size=batch,
        sampler=list(range(batch * (batches + 64))),
        num_workers=processes,
        collate_fn=stack_clips,
        multiprocessing_context="spawn" if processes else None,
        persistent_workers=processes > 0,
    )
    makers = {"1 thread": lambda: ours(0), "2 threads": lambda: ours(2), "torch": peers.__iter__}
    seconds: dict[str, list[float]] = {name: [] for name in makers}
    for _ in range(rounds):
        for name, make in makers.items():
            source = make()
            for _ in range(4):  # what is read ahead while nobody asks is not counted
                next(source)
            began = time.perf_counter()
            for _ in range(batches):
                next(source)
            seconds[name].append((time.perf_counter() - began) / batches)
            getattr(source, "close", lambda: None)()
    return seconds


class TorchClips:
    """The same clips for a torch DataLoader; opened where it is used."""

    def __init__(self, config: Config):
        self.config = config
        self.source: Any = None

    def __len__(self) -> int:
        return 2**31

    def __getitem__(self, index: int) -> Any:
        import numpy as np

        from pewm_jax.data import clips
        from pewm_jax.data.dataset import EpisodeSource

        if self.source is None:
            self.source = EpisodeSource(Path(self.config.data.path) / "train")
        rng = np.random.default_rng(index)
        episode = self.source[int(rng.integers(len(self.source)))]
        choice = clips.choose(self.config, episode.length, rng)
        return clips.cut(episode, choice, self.config.data.context)


def stack_clips(parts: Sequence[Any]) -> Any:
    """Stack clips as the loader does."""
    from pewm_jax.data import clips

    return clips.stack(parts)


def step_seconds(run: Path, stage: int) -> float:
    """Return the mean seconds per step that a run's log tells of, without its first and last."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    times = [line["time"] for line in lines if line["stage"] == stage][3:-1]
    return (times[-1] - times[0]) / (len(times) - 1)


def main(argv: Sequence[str]) -> None:
    """Run one part as JSON says, and write what was found beside it."""
    job = json.loads(Path(argv[0]).read_text())
    if job["part"] == "loop":
        interrupt = job["interrupt"] and tuple(job["interrupt"])
        found: Any = train_with_clocks(job["argv"], interrupt)
    else:
        config = reading(configs.load(job["preset"]), path=job["data"])
        found = input_rates(config, job["batch"], job["batches"], job["rounds"])
    Path(argv[1]).write_text(json.dumps(found))


if __name__ == "__main__":
    sys.exit(cli.run(main))
