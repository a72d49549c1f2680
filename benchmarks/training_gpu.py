"""CogVideoX-2b's two stages of training on one NVIDIA GPU, beside what ``--plan`` predicted.

Memory and time are compared with both plans: that of formulas (``--compiler cpu``) and that of the
chip's compiler (``--compiler target``), which compiles without the device, and so without
autotuning. Its time is a lower bound.

Run with ``python benchmarks/training_gpu.py``. A clip is the paper's: 9 frames of 512×512 with 16
of context. The step is the real one (``train_step``: VAE, map, DINOv2, both networks, Adam,
average) on random clips and weights. Every batch size is tried in a process of its own, so that its
peak memory is its own, from one clip on to twice the last until the memory ends. Numbers are kept
in ``--state``: after an interruption, or the ``--seconds`` of one command, run the same command
again and it goes on. ``--record`` writes the section of RESULTS.md. ``--smoke`` runs a tiny step on
a CPU.

MFU is the model's FLOPs (nothing recomputed counts) over the data sheet's rate in bf16.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import record

from pewm_jax import presets as configs
from pewm_jax.cli import parser as cli
from pewm_jax.config import Config, MeshConfig, UserError
from pewm_jax.data import abstract
from pewm_jax.io import atomic
from pewm_jax.plan import plan, target_compiler
from pewm_jax.plan.measure import MeshSizes
from pewm_jax.train import chips, flops, sharding, step
from pewm_jax.types import Clip
from pewm_jax.worlds.pewm.world import STAGES
from pewm_jax.worlds.stages import Stage

NAME = "training_gpu"
BATCHES = (1, 2, 4, 8, 16, 32)
HEADER = ("stage, clips a step", "step, ms", "predicted", "compiler: at best", "clips/s", "MFU")
HEADER += ("predicted", "peak memory, GB", "compiler's plan", "state and gradients", "compile, s")
FULL = "out of memory"


def setting(preset: str, stage: Stage, batch: int) -> Config:
    """Return a preset's configuration for one device and so many clips a step."""
    config = configs.load(preset)
    changed = dataclasses.replace(stage.settings(config), batch=batch)
    changes: dict[str, Any] = {"mesh": MeshConfig(), stage.name: changed}
    return dataclasses.replace(config, train=dataclasses.replace(config.train, **changes))


def random_clip(config: Config, stage: Stage) -> Clip:
    """Return a batch of noise with cameras that look ahead and depths of a room."""
    rng = np.random.default_rng(0)

    def draw(leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        if leaf.dtype == np.uint8:
            return rng.integers(0, 256, leaf.shape, np.uint8)
        if leaf.dtype == np.bool_:
            return np.ones(leaf.shape, bool)
        if leaf.shape[-2:] == (4, 4):
            return np.broadcast_to(np.eye(4, dtype=leaf.dtype), leaf.shape).copy()
        if leaf.shape[-1] == 4:
            half = config.model.clip.width / 2
            return np.full(leaf.shape, half, leaf.dtype)
        return rng.uniform(1, 4, leaf.shape).astype(leaf.dtype)

    batch = stage.settings(config).batch
    return jax.tree.map(draw, abstract.clip(config, batch, features=stage.memory))


def predicted(config: Config, stage: Stage, chip: chips.Chip) -> dict[str, float]:
    """Return what ``--plan --compiled off`` says of one device."""
    found = plan.plan_stage(config, stage, MeshSizes(), chip, compiles=False).choice
    return {
        "predicted_s": found.time.step_s,
        "predicted_mfu": found.time.mfu,
        "held_gb": found.memory.peak / 1e9,
    }


def planned(config: Config, stage: Stage, chip: chips.Chip) -> dict[str, float]:
    """Return what the chip's compiler says of one device; nothing where it cannot."""
    try:
        found = target_compiler.compile_stage(config, stage.name, chip, 1)
    except UserError as error:
        print(f"no plan of the compiler: {error}", file=sys.stderr)
        return {}
    numbers = {"plan_gb": (found.peak_bytes or 0) / 1e9, "plan_s": found.roofline_s or 0}
    return {name: number for name, number in numbers.items() if number}


def measure(preset: str, number: int, batch: int, repeats: int) -> dict[str, Any]:
    """Time one stage's step for one batch in this process."""
    stage = STAGES[number - 1]
    config, device = setting(preset, stage, batch), jax.local_devices()[0]
    chip = chips.find(device.device_kind) or chips.named("h200")
    found: dict[str, Any] = {"batch": batch, **predicted(config, stage, chip)}
    mesh = sharding.make_mesh([device], config.train.mesh)
    clip = jax.device_put(random_clip(config, stage), sharding.of_batch(mesh))
    key = jax.device_put(step.noise_key(config, stage), sharding.replicated(mesh))
    began = time.perf_counter()
    compiled = step.compile_step(config, stage, mesh, clip)
    found["compile_s"] = time.perf_counter() - began
    state = step.initial_state(config, stage, mesh)
    state, metrics = jax.block_until_ready(compiled(state, clip, key))
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        state, metrics = jax.block_until_ready(compiled(state, clip, key))
        seconds.append(time.perf_counter() - began)
    if not np.isfinite(float(metrics["loss"])):
        raise UserError(f"stage {number}, {batch} clips: the loss is {float(metrics['loss'])}.")
    peak = (device.memory_stats() or {}).get("peak_bytes_in_use", 0)
    needed = flops.of_stage(config, stage, clip).total
    taken = statistics.median(seconds)
    if device.platform == "gpu":
        found |= planned(config, stage, chip)
    return {**found, "s": taken, "mfu": needed / taken / chip.flops, "peak_gb": peak / 1e9}


def report(done: dict[str, dict[str, Any]]) -> str:
    """Return the table of what is known so far."""
    rows = []
    for name, found in done.items():
        if FULL in found:
            guess = f"{found['held_gb']:.1f}"
            rows.append((name, FULL, *[""] * 7, guess, ""))
            continue
        best = f"{found['plan_s'] * 1e3:.0f}" if "plan_s" in found else ""
        plan_gb = f"{found['plan_gb']:.1f}" if "plan_gb" in found else ""
        times = f"{found['s'] * 1e3:.0f}", f"{found['predicted_s'] * 1e3:.0f}", best
        shares = f"{found['mfu']:.1%}", f"{found['predicted_mfu']:.1%}"
        sizes = f"{found['peak_gb']:.1f}", plan_gb, f"{found['held_gb']:.1f}"
        rate = f"{found['batch'] / found['s']:.2f}"
        rows.append((name, *times, rate, *shares, *sizes, f"{found['compile_s']:.0f}"))
    return record.table(HEADER, rows)


def has_gpu() -> bool:
    """Whether JAX sees an NVIDIA GPU; asked in another process, which takes no memory of it."""
    code = (
        "import sys; from pewm_jax.nn import target; sys.exit(target.current().platform != 'cuda')"
    )
    return subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def in_a_process(number: int, batch: int, options: argparse.Namespace) -> dict[str, Any] | None:
    """Run one part in a process of its own; None where it failed for another reason than memory."""
    words = ["--part", str(number), str(batch), "--repeats", str(options.repeats)]
    command = [sys.executable, __file__, "--preset", options.preset, *words]
    environment = {"XLA_PYTHON_CLIENT_MEM_FRACTION": "0.95", **os.environ}
    run = subprocess.run(command, check=False, capture_output=True, text=True, env=environment)
    if run.returncode == 0:
        return json.loads(run.stdout.splitlines()[-1])
    if "RESOURCE_EXHAUSTED" in run.stderr or "out of memory" in run.stderr.lower():
        stage = STAGES[number - 1]
        config = setting(options.preset, stage, batch)
        return {"batch": batch, FULL: True, **predicted(config, stage, chips.named("h200"))}
    print(run.stderr[-2000:])
    print(f"stage {number} with {batch} clips failed as above; the other parts go on.")
    return None


def arguments(argv: Sequence[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--preset", default="pewm_2b", help="what is trained")
    parser.add_argument("--repeats", type=int, default=5, help="steps per number")
    parser.add_argument("--seconds", type=float, default=420, help="start no part after")
    parser.add_argument("--state", type=Path, default=Path("training_gpu.json"))
    parser.add_argument(
        "--part", type=int, nargs=2, metavar=("STAGE", "BATCH"), help="run it alone"
    )
    parser.add_argument("--smoke", action="store_true", help="tiny, on a CPU, nothing is kept")
    parser.add_argument("--record", action="store_true", help="write the section of RESULTS.md")
    return parser.parse_args(argv)


def main(argv: Sequence[str]) -> None:
    """Measure what is not measured yet, and print."""
    options = arguments(argv)
    if options.smoke:
        found = {f"{number}, 2": measure("tiny", number, 2, 1) for number in (1, 2)}
        print(report(found))
        return
    if options.part:
        number, batch = options.part
        print(json.dumps(measure(options.preset, number, batch, options.repeats)))
        return
    if not has_gpu():
        raise UserError(
            "JAX sees no NVIDIA GPU here: run this on a machine with one and "
            "`pip install 'pewm-jax[cuda]'`, or add --smoke to see that it runs."
        )
    done = json.loads(options.state.read_text()) if options.state.exists() else {}
    if not complete(done, options):
        print("time is up; run the same command to go on.")
    machine = record.machine("jax")
    title = "## CogVideoX-2b's two stages of training on one GPU, bf16, 9 frames of 512 × 512"
    text = f"{title}\n\n{machine}\n\n{report(done)}"
    print(text)
    if options.record:
        record.record(NAME, text)


def complete(done: dict[str, dict[str, Any]], options: argparse.Namespace) -> bool:
    """Measure what is missing, smallest batches of both stages first; False when time is up."""
    start = time.perf_counter()
    full: set[int] = set()
    for batch in BATCHES:
        for number in (1, 2):
            name = f"{number}, {batch}"
            if name not in done and number not in full:
                if time.perf_counter() - start > options.seconds:
                    return False
                print(f"stage {number}, {batch} clips a step …", flush=True)
                found = in_a_process(number, batch, options)
                if found is None:
                    full.add(number)
                    continue
                done[name] = found
                atomic.write_text(options.state, json.dumps(done, indent=2))
            if FULL in done.get(name, {}):
                full.add(number)
    return True


if __name__ == "__main__":
    sys.exit(cli.run(main))
