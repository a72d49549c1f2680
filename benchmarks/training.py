"""Time that training spends besides its steps: input, saving, logging, more processes, starting.

Run with ``python benchmarks/training.py``; ``--record`` writes the section of RESULTS.md. Every
part runs the demo as a user would (``train.py``, the real loop, its own process) on data that are
collected first, with a clock around what the loop calls; nothing is estimated from pieces. The
demo is trained for few steps only, with a save every ten and a log line every step: the worst case.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import record
import training_parts

from pewm_jax import presets as configs
from pewm_jax.cli import parser as cli
from pewm_jax.config import Config, UserError
from pewm_jax.data.collect import collect
from pewm_jax.data.dataset import read_manifest, write_manifest
from pewm_jax.data.make_episode import CollectConfig

NAME = "training"
ROOT = Path(__file__).parents[1]
PARTS = ("loop", "input", "processes")
SAVE_EVERY = 10
"""Steps between saves while measuring: many more saves than a training makes."""
STEPS = 36
PROCESSES = (1, 2, 4)
BATCH = 8
"""Clips per step of all processes together."""
SMALL = (
    *("--model.backbone.layers", "4"),
    *("--model.backbone.heads", "4"),
    *("--model.backbone.head_dim", "32"),
)
"""What makes the smallest preset heavy enough for a step to be worth sharing."""


def python(arguments: Sequence[Any], log: Path) -> subprocess.Popen[str]:
    """Start Python in the repository's root, telling what it prints to a file."""
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'benchmarks'}"}
    with log.open("w") as told:
        return subprocess.Popen(
            [sys.executable, *map(str, arguments)],
            cwd=ROOT,
            env=environment,
            stdout=told,
            stderr=subprocess.STDOUT,
            text=True,
        )


def finish(processes: Sequence[subprocess.Popen[str]], logs: Sequence[Path]) -> None:
    """Wait for processes; when one fails, or this one is interrupted, none is left running.

    Raises:
        UserError: one failed; its last lines are told.
    """
    try:
        for process, log in zip(processes, logs, strict=True):
            if process.wait() != 0:
                lines = log.read_text().strip().splitlines()[-8:]
                raise UserError("A part of the benchmark failed: " + " / ".join(lines))
    finally:
        for process in processes:
            process.kill()
            process.wait()


def part(folder: Path, **job: Any) -> tuple[Any, float]:
    """Run a part in a process of its own; returns what it found and when it was called."""
    job_file, out, log = (folder / f"part.{end}" for end in ("json", "out", "log"))
    job_file.write_text(json.dumps(job))
    called = time.time()
    finish([python([ROOT / "benchmarks/training_parts.py", job_file, out], log)], [log])
    return json.loads(out.read_text()), called


def measure_loop(folder: Path, preset: str, data: Path, steps: int) -> dict[str, Any]:
    """Train both stages with clocks, interrupted near the end and started again."""
    flags = {
        "data.path": data,
        "train.run": folder / "runs/one",
        "train.save_every": SAVE_EVERY,
        "train.log_every": 1,
        "train.preview_every": 0,
        "train.stage1.steps": steps,
        "train.stage2.steps": steps,
    }
    argv = [preset, *(word for name, value in flags.items() for word in (f"--{name}", str(value)))]
    spans, called = part(folder, part="loop", argv=argv, interrupt=[2, steps - 2])
    found: dict[str, Any] = {
        f"stage{stage}": training_parts.summary(spans, stage) for stage in (1, 2)
    }
    found["cold"] = training_parts.launch(spans, 1, called)
    spans, called = part(folder, part="loop", argv=argv, interrupt=None)
    found["resumed"] = training_parts.launch(spans, 2, called)
    return found


def measure_input(folder: Path, preset: str, data: Path, rounds: int) -> dict[str, Any]:
    """Read batches without training on them."""
    batch = configs.load(preset).train.stage1.batch
    job = {"part": "input", "preset": preset, "data": str(data), "batch": batch}
    found, _ = part(folder, **job, batches=16, rounds=rounds)
    return {"batch": batch, **found}


def free_port() -> int:
    """Return a port that nobody listens on."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def measure_processes(folder: Path, data: Path, steps: int) -> dict[str, Any]:
    """Train the same small model, the same batch, on more and more processes."""
    found: dict[str, Any] = {}
    for count in (0, *PROCESSES):  # 0: one process that joins nobody
        run = folder / f"runs/processes{count}"
        stages = [
            word
            for stage in ("stage1", "stage2")
            for name, value in (("steps", steps), ("batch", BATCH))
            for word in (f"--train.{stage}.{name}", value)
        ]
        argv = ["train.py", "tiny", "--data.path", data, "--train.run", run, *SMALL, *stages]
        argv += ["--train.save_every", 10**6]
        joining = ["--distributed", "--coordinator", f"127.0.0.1:{free_port()}"]
        joining += ["--processes", count, "--process"]
        logs = [folder / f"process{k}.log" for k in range(max(count, 1))]
        started = [
            python([*argv, *([*joining, k] if count else [])], log) for k, log in enumerate(logs)
        ]
        finish(started, logs)
        found[str(count)] = [training_parts.step_seconds(run, stage) for stage in (1, 2)]
    return found


def ms(seconds: float) -> str:
    """Write milliseconds."""
    return f"{seconds * 1e3:.0f}" if seconds >= 0.02 else f"{seconds * 1e3:.2f}"


def report_input(found: Mapping[str, Any], loop: Mapping[str, Any]) -> str:
    """Return the table of the input pipeline."""
    steps = [loop[f"stage{stage}"]["step"] for stage in (1, 2)]
    rows = []
    for name in ("1 thread", "2 threads", "torch"):
        words = "torch DataLoader, 2 processes" if name == "torch" else f"pewm_jax, {name}"
        seconds = statistics.median(found[name])
        clips = found["batch"] / seconds
        times = [f"{step / seconds:.1f}×" for step in steps]
        rows.append((words, ms(seconds), f"{clips:.0f}", *times))
    header = ("who reads", "ms per batch", "clips/s", "faster than stage 1", "than stage 2")
    waits = " and ".join(f"{ms(loop[f'stage{stage}']['data'])} ms" for stage in (1, 2))
    return (
        "**Input alone** (goal ≥ 5× faster than a step; the demo reads with 1 thread). During "
        f"training, the loop waits {waits} per step for its next batch (stage 1 and 2).\n\n"
        + record.table(header, rows)
    )


def report_loop(loop: Mapping[str, Any], config: Config) -> str:
    """Return the tables of saving and logging, and of starting."""
    every, rows = config.train.save_every, []
    for stage in (1, 2):
        one = loop[f"stage{stage}"]
        step, held, behind = one["step"], one["save"], one["behind"]
        shares = [held / (n * step + held) for n in (every, SAVE_EVERY)]
        log = one["log"] / step
        cells = (ms(step), ms(held), ms(behind), *(f"{share:.2%}" for share in shares))
        rows.append((f"stage {stage}", *cells, ms(one["log"]), f"{log:.2%}"))
    header = ("", "step, ms", "a save blocks, ms", "and slows by, ms", f"share, every {every}")
    header += (f"every {SAVE_EVERY}", "logging, ms", "of a step")
    text = (
        "**Saving and logging** (goals: a save blocks < 5 % of the time, logging < 1 %). "
        f"Measured with a save every {SAVE_EVERY} steps and a log line every step; the demo saves "
        f"every {every} and logs every {config.train.log_every}. Background "
        "writing also uses processor time: *slows by*.\n\n"
    )
    text += record.table(header, rows)
    starts = {"cold": "first start", "resumed": "again, in the middle of stage 2"}
    rows = []
    for name, words in starts.items():
        one = loop[name]
        known = [one[key] for key in ("state", "compile", "data", "step")]
        rest = one["first"] - sum(known)
        rows.append((words, f"{one['first']:.1f}", *(f"{x:.1f}" for x in (rest, *known))))
    header = ("", "until the first step is done, s", "imports, checks", "weights made or restored")
    header += ("step compiled or found", "first batch", "first step")
    words = "**Starting**: compiled programs are stored beside the run, and a restart reuses them."
    return f"{text}\n\n{words}\n\n{record.table(header, rows)}"


def report_processes(found: Mapping[str, Sequence[float]]) -> str:
    """Return the table of processes."""
    rows = []
    for count, seconds in found.items():
        name = "1, without `--distributed`" if count == "0" else count
        more = [f"{s / base:.2f}" for s, base in zip(seconds, found["0"], strict=True)]
        rows.append((name, ms(seconds[0]), more[0], ms(seconds[1]), more[1]))
    header = ("processes", "stage 1, ms per step", "over alone", "stage 2, ms per step")
    words = (
        f"**Processes**: a small model, {BATCH} clips per step shared by 1, 2 and 4 processes on "
        f"the same {os.cpu_count()} cores. No speed-up can come of that; what a process adds "
        "(collectives, agreeing to go on, one more runtime for the same cores) is what is above 1."
    )
    return f"{words}\n\n{record.table((*header, 'over alone'), rows)}"


def arguments(argv: Sequence[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", default=PARTS, choices=PARTS, help="some parts")
    parser.add_argument("--preset", default="demo", help="what is trained")
    parser.add_argument("--steps", type=int, default=STEPS, help="steps of each stage")
    parser.add_argument("--rounds", type=int, default=5, help="turns of the input pipelines")
    parser.add_argument("--record", action="store_true", help="write the section of RESULTS.md")
    options = parser.parse_args(argv)
    if options.record and set(options.only) != set(PARTS):
        raise UserError("--record needs all parts: leave out --only.")
    if options.steps < 2 * SAVE_EVERY + 4:
        raise UserError(f"--steps is {options.steps}: use at least {2 * SAVE_EVERY + 4}.")
    return options


def gather(folder: Path, size: int, episodes: int, times: int = 1) -> Path:
    """Collect data to train on; each shard of them is there ``times`` times, to save a minute."""
    out = folder / f"data{size}"
    collect(CollectConfig(out, train=episodes, validation=0, test=0, size=size, frames=96))
    made = read_manifest(out / "train")
    for k in range(1, times):
        for shard in made.shards:
            (out / "train" / f"{k}-{shard.file}").hardlink_to(out / "train" / shard.file)
    more = [
        dataclasses.replace(shard, file=f"{k}-{shard.file}" if k else shard.file)
        for k in range(times)
        for shard in made.shards
    ]
    whole = dataclasses.replace(made, shards=tuple(more), frames=made.frames * times)
    write_manifest(out / "train", whole)
    return out


def main(argv: Sequence[str]) -> None:
    """Measure, print, and record if asked to."""
    options = arguments(argv)
    config = configs.load(options.preset)
    texts = [
        "## Time that training spends besides its steps\n\n"
        + record.machine("jax", "grain", "torch")
    ]
    with tempfile.TemporaryDirectory(prefix="pewm-benchmark-") as name:
        folder = Path(name)
        loop: dict[str, Any] = {}
        data = folder
        if {"loop", "input"} & set(options.only):
            data = gather(folder, config.model.clip.width, 32, 10)
            print(f"training {options.preset} for {options.steps} steps of each stage …")
            loop = measure_loop(folder, options.preset, data, options.steps)
        if "input" in options.only:
            print("reading without training …")
            found = measure_input(folder, options.preset, data, options.rounds)
            texts.append(report_input(found, loop))
        if "loop" in options.only:
            texts.append(report_loop(loop, config))
        if "processes" in options.only:
            print("training on 1, 2 and 4 processes …")
            data = gather(folder, configs.load("tiny").model.clip.width, 8)
            texts.append(report_processes(measure_processes(folder, data, 30)))
    text = "\n\n".join(texts)
    print(f"\n{text}")
    if options.record:
        record.record(NAME, text)


if __name__ == "__main__":
    sys.exit(cli.run(main))
