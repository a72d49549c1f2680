"""Train, be killed, start again, many times; each start is a fork of a process with all imports.

Run as ``python kills.py FOLDER KILLS SEED``; prints one line of JSON: exit
codes, and of every kill when it came and what was told and saved until then.
The clips are real, read from shards; the model is the small one of ``fakes``.
"""

import dataclasses
import json
import os
import random
import signal
import sys
import time
from pathlib import Path

import jax
import pytest

from pewm_jax.data import loader
from pewm_jax.train import checkpoint, checkpoint_files, loop
from tests.train import fakes

EVERY, STEPS = 3, 27


def config(folder, name):
    made = fakes.config(
        folder / name, stage1=STEPS, stage2=STEPS, save_every=EVERY, keep=1, grace_s=5.0
    )
    data = dataclasses.replace(made.data, path=str(folder / "data"), stride_max=2)
    made = dataclasses.replace(made, data=data)
    for stage in ("stage1", "stage2"):
        made = fakes.with_stage(made, stage, batch=2)
    return made


def start(folder, name):
    """Fork a process that trains; returns its id."""
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        with (folder / f"{name}.txt").open("a") as told:
            os.dup2(told.fileno(), 1)
            os.dup2(told.fileno(), 2)
            loop.train(config(folder, name), log=print)
        code = 0
    finally:
        os._exit(code)


def ended(child):
    """Tell whether a child has ended, without taking note of it."""
    return os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT)


def wait(child):
    """Wait for a child; returns its exit code, minus the signal if one killed it."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def newest(run):
    """Return the stage and step that a new start would go on from."""
    found = [
        (n, step)
        for n in (1, 2)
        for step in checkpoint_files.steps(checkpoint_files.of(run, f"stage{n}"))
    ]
    return max(found, default=(1, 0))


def told(run):
    """Return the stage and step that were last told of."""
    path = run / "metrics.jsonl"
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    entries = [json.loads(line) for line in lines if line.endswith("\n")]
    return (entries[-1]["stage"], entries[-1]["step"]) if entries else (1, 0)


def wait_and_kill(child, run, dice, saves, longest):
    """Kill a child soon after it has begun so many saves, or at any moment if none; tells when.

    So files are half-written, sealed, renamed and pruned when the end comes, or nothing is begun.
    """
    delay = dice.uniform(0, 0.15 if saves else longest)
    seen = set()
    while len(seen) < saves and not ended(child):
        seen |= {path.name for path in run.glob(f"checkpoints/*/*{checkpoint_files.WRITING}*")}
        time.sleep(0.001)
    time.sleep(delay)
    os.kill(child, signal.SIGKILL)  # it is not waited for yet, so this id is still its own
    return {"saves": saves, "delay": round(delay, 4), "code": wait(child)}


def choose(dice, done, killed):
    """Return after how many saves to kill; 0 is at any moment. All kills shall fit into one run."""
    if done > killed + 0.1:
        return 1
    if done < killed - 0.2:
        return 3
    return dice.choice((0, 0, 1, 2))


def main(folder, kills, seed):
    dice = random.Random(seed)
    options = {
        "jax_compilation_cache_dir": str(folder / "compiled"),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    for name, value in options.items():
        jax.config.update(name, value)
    clips, records = loader.clips, loader.records
    with pytest.MonkeyPatch.context() as patch:
        fakes.install(patch)
        patch.setattr(loader, "clips", clips)
        patch.setattr(loader, "records", records)
        patch.setattr(checkpoint, "_MOMENT_S", 60.0)  # however slow this disk is
        began = time.monotonic()
        codes = [wait(start(folder, "undisturbed"))]
        longest = (time.monotonic() - began) / 6
        run, moments = folder / "killed", []
        while len(moments) < kills:
            stage, step = newest(run)
            saves = choose(dice, (stage * STEPS - STEPS + step) / STEPS / 2, len(moments) / kills)
            moment = wait_and_kill(start(folder, "killed"), run, dice, saves, longest)
            moments.append(moment | {"told": told(run), "newest": newest(run)})
        codes.append(wait(start(folder, "killed")))
    print(json.dumps({"codes": codes, "moments": moments}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
