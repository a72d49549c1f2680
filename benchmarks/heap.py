"""Training steps on a processor, with memory that is kept and with memory that is mapped anew.

    python benchmarks/heap.py --preset demo --record

``pewm-jax train`` asks glibc to keep freed memory (``pewm_jax.io.runtime``). Here the same step
runs in processes of their own, in turn with and without.
"""

from __future__ import annotations

import dataclasses
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from typing import Literal

import record
import tyro


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is measured."""

    preset: str = "demo"
    """The settings whose first stage is trained; its data must be there."""
    steps: int = 12
    """Steps that are timed, after three that are not."""
    turns: int = 2
    """Processes of each kind."""
    record: bool = False
    """Write the table into RESULTS.md."""
    child: Literal["", "kept", "mapped"] = ""
    """Of the processes that this one begins."""


def child(settings: Settings) -> None:
    """Time steps in this process and print them as JSON."""
    from pewm_jax.io import runtime

    if settings.child == "kept":
        assert runtime.keep_large(), "this C library is not glibc"
    import functools

    import jax

    from pewm_jax import presets, worlds
    from pewm_jax.data import loader
    from pewm_jax.io import runtime
    from pewm_jax.train import sharding
    from pewm_jax.train.step import compile_step, initial_state, noise_key

    config = presets.load(settings.preset)
    config = dataclasses.replace(
        config, train=dataclasses.replace(config.train, start="", run="runs/heap")
    )
    runtime.cache_compilation("runs/heap")
    stage, mesh = worlds.stages(config.model)[0], sharding.make_mesh(jax.devices()[:1])
    batch = next(iter(loader.clips(config, "train", seed=0, batch=stage.settings(config).batch)))
    key = jax.device_put(noise_key(config, stage), sharding.replicated(mesh))
    state = initial_state(config, stage, mesh, None)
    if config.data.prepared and stage.prepare is not None:
        batch = jax.jit(functools.partial(stage.prepare, config.model))(state.params, batch)
    clip = jax.device_put(jax.device_get(batch), sharding.of_batch(mesh))
    step = compile_step(config, stage, mesh, clip)
    taken = []
    for number in range(settings.steps + 3):
        if number == 3:
            before = resource.getrusage(resource.RUSAGE_SELF)
        began = time.perf_counter()
        state, metrics = step(state, clip, key)
        jax.block_until_ready(metrics)
        taken.append(time.perf_counter() - began)
    after = resource.getrusage(resource.RUSAGE_SELF)
    found = {
        "seconds": statistics.median(taken[3:]),
        "user": (after.ru_utime - before.ru_utime) / settings.steps,
        "system": (after.ru_stime - before.ru_stime) / settings.steps,
        "gigabytes": after.ru_maxrss / 1e6,
    }
    print(json.dumps(found))


def main(settings: Settings) -> None:
    """Time both kinds in turn and print a table."""
    if settings.child:
        return child(settings)
    found: dict[str, list[dict[str, float]]] = {"mapped": [], "kept": []}
    command = [sys.executable, __file__, "--preset", settings.preset]
    command += ["--steps", str(settings.steps), "--child"]
    for _ in range(settings.turns):
        for kind, each in found.items():
            done = subprocess.run([*command, kind], stdout=subprocess.PIPE, check=True, text=True)
            each.append(json.loads(done.stdout.splitlines()[-1]))
    best = {kind: min(each, key=lambda one: one["seconds"]) for kind, each in found.items()}
    names = {"mapped": "glibc's own ways", "kept": "memory is kept"}
    rows = [
        [names[kind], *(f"{one[key]:.2f}" for key in ("seconds", "user", "system", "gigabytes"))]
        for kind, one in best.items()
    ]
    header = ["", "s a step", "processor s, own", "processor s, system", "GB at most"]
    ratio = best["mapped"]["seconds"] / best["kept"]["seconds"]
    text = (
        f"The first stage of `{settings.preset}`; of {settings.turns} processes each, in turn, the "
        f"faster. With memory that is kept a step is {ratio:.2f} times as fast. Load at the end "
        f"{os.getloadavg()[0]:.1f}.\n\n{record.table(header, rows)}"
    )
    print(text)
    if settings.record:
        title = f"## Memory that is kept\n\n{record.machine('jax', 'numpy')}\n\n"
        record.record("heap", title + text)
    return None


if __name__ == "__main__":
    main(tyro.cli(Settings))
