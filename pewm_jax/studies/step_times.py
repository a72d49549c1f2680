"""The time of one training step of several trainings, measured in turn, for equal-time studies.

On a CPU it is processor time, so that other jobs affect all trainings equally; on an accelerator it
is wall-clock time. Preparing clips and compiling do not count.
"""

from __future__ import annotations

import functools
import gc
import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax

from pewm_jax.config import Config
from pewm_jax.data import loader
from pewm_jax.nn import target
from pewm_jax.train import sharding
from pewm_jax.train.step import compile_step, initial_state, noise_key
from pewm_jax.worlds.stages import Stage

ROUNDS = 7
"""Number of timed steps of each training, in turn; one more step before them is not timed."""


def clock() -> Callable[[], float]:
    """Return the clock for training time: processor time, or wall-clock time on an accelerator."""
    return time.process_time if target.current().platform == "cpu" else time.perf_counter


def measure(
    trainings: Mapping[str, tuple[str, Config, Stage]], log: Callable[[str], Any]
) -> dict[str, float]:
    """Return the median seconds per step of each training, measured in turn.

    ``trainings`` are names for messages, settings and stages.
    """
    log(f"timing a step of {len(trainings)} trainings …")
    steps = {key: _compile_step(*training, log) for key, training in trainings.items()}
    taken: dict[str, list[float]] = {key: [] for key in steps}
    now = clock()
    for number in range(ROUNDS + 1):
        for key, step in steps.items():
            began = now()
            step()
            if number:
                taken[key].append(now() - began)
    found = {key: statistics.median(each) for key, each in taken.items()}
    for key, seconds in found.items():
        spread = f"{min(taken[key]):.3f} to {max(taken[key]):.3f}"
        log(f"  {trainings[key][0]}: {seconds:.3f} s per step ({spread})")
    del steps
    gc.collect()
    return found


def _compile_step(
    name: str, config: Config, stage: Stage, log: Callable[[str], Any]
) -> Callable[[], None]:
    """Compile a training step; return a function that runs one step on random weights."""
    mesh = sharding.make_mesh(arranged=config.train.mesh)
    batch = next(iter(loader.clips(config, "train", seed=0, batch=stage.settings(config).batch)))
    key = jax.device_put(noise_key(config, stage), sharding.replicated(mesh))
    held = [initial_state(config, stage, mesh, None)]
    if config.data.prepared:
        assert stage.prepare is not None
        batch = jax.jit(functools.partial(stage.prepare, config.model))(held[0].params, batch)
    clip = jax.device_put(jax.device_get(batch), sharding.of_batch(mesh))
    began = time.monotonic()
    compiled = compile_step(config, stage, mesh, clip)
    log(f"  {name}: compiled in {time.monotonic() - began:.0f} s")

    def step() -> None:
        held[0], metrics = compiled(held[0], clip, key)
        jax.block_until_ready(metrics)

    return step
