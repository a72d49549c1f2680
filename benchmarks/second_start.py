"""The first and the second start of a rollout, the viewer and an evaluation, with kept programs.

`python benchmarks/second_start.py` copies the shipped model `small` into an empty folder and starts
each twice: a script that imagines eight frames, `pewm-jax play` until the page is ready, and
`pewm-jax evaluate` of two clips on newly collected episodes. Every start is a process of its own.
The compiled programs of the first are kept beside the run (`pewm_jax.cache_compilation`). JAX's own
events say how many programs were compiled, how many were loaded, and how long tracing, lowering and
compiling took. With ``--record`` the section of ``RESULTS.md`` is rewritten.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from record import machine, record, table

from pewm_jax import shipped

EVENTS = """
import atexit, collections, json, sys
import jax
found = collections.Counter()
jax.monitoring.register_event_listener(
    lambda event, **_: found.update({event.split("/")[-1]: 1})
)
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **_: found.update({event.split("/")[-1]: seconds})
)
def keep():
    with open(sys.argv[1], "w") as file:
        json.dump(found, file)
atexit.register(keep)
"""
"""Beginning of every measured process: its first argument is the file of JAX's events."""
COMMAND = """
from pewm_jax.cli.main import main
sys.exit(main(sys.argv[2:]))
"""
PLAY = """
import functools, threading
from pewm_jax import shipped
from pewm_jax.cli import play
from pewm_jax.play import driver, engine
from pewm_jax.play.session import PageUpdate
from pewm_jax.play.settings import Start
from pathlib import Path
model = Path(sys.argv[2])
one = driver.Driver(
    lambda: play._load(str(model), model), Start(), lambda _: None, model / "worlds", ahead=False
)
assert one.wait(600)
one.close()
"""
ROLLOUT = """
import numpy as np
import pewm_jax
from pathlib import Path
from pewm_jax.data import abstract
run = Path(sys.argv[2])
pewm_jax.cache_compilation(run.parent)
config, params = pewm_jax.load(run)
clip = config.model.clip
poses = np.stack([pewm_jax.pose_from_yaw(np.array([0.0, 0.0, 1.25]), 0.1 * k) for k in range(3)])
intrinsics = pewm_jax.intrinsics_from_fov(clip.height, clip.width, 90.0)
camera = pewm_jax.Camera(np.tile(intrinsics, (3, 1)).astype("f"), poses.astype("f"))
shape = (3, clip.height, clip.width)
rng = np.random.default_rng(0)
frames = pewm_jax.Frames(
    rng.integers(0, 256, (*shape, 3), np.uint8), np.full(shape, 2.0, "f"), camera
)
state = pewm_jax.start(config, params, frames)
state, imagined = pewm_jax.rollout(config, params, state, [0] * 8, jax.random.key(0))
jax.block_until_ready(imagined)
"""
HEADER = ("", "start", "seconds", "tracing and lowering", "compiling or loading")
HEADER += ("compiled", "loaded")


def started(code: str, *words: str) -> dict[str, Any]:
    """Run code in a process of its own; return its seconds, and what JAX reported."""
    left_out = ("JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE")
    environment = {name: text for name, text in os.environ.items() if name not in left_out}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "events.json"
        began = time.perf_counter()
        subprocess.run(
            [sys.executable, "-c", EVENTS + code, str(file), *words],
            env=environment,
            stdout=subprocess.DEVNULL,
            check=True,
        )
        seconds = time.perf_counter() - began
        return {"seconds": seconds, **json.loads(file.read_text())}


def cases(folder: Path) -> dict[str, list[tuple[str, tuple[str, ...]]]]:
    """Return name → code and arguments of its two starts; each has a copy of the run."""

    def copied(name: str) -> str:
        run = folder / name / "small"
        shutil.copytree(shipped.find("small"), run)
        return str(run)

    data = str(folder / "data")
    sizes = ("--train", "1", "--validation", "1", "--test", "2", "--workers", "1")
    subprocess.run(
        [sys.executable, "-m", "pewm_jax", "data", "collect", data, *sizes],
        stdout=subprocess.DEVNULL,
        check=True,
    )
    few = ("--clips", "2", "--seeds", "0", "--videos", "1", "--video-clips", "1", "--batch", "2")
    few = ("--data", data, *few, "--mirror", "0", "--lpips", "off", "--fvd", "off", "--scs", "off")
    scored = copied("evaluate")
    rollout, play = (ROLLOUT, (copied("rollout"),)), (PLAY, (copied("play"),))
    return {
        "rollout of 8 frames": [rollout, rollout],
        "play, until it is ready": [play, play],
        "evaluate 2 clips": [
            (COMMAND, ("evaluate", scored, *few, "--out", str(folder / f"report{k}")))
            for k in (1, 2)
        ],
    }


def row(name: str, number: int, found: dict[str, Any]) -> tuple[str, ...]:
    """Return a line of the table."""
    tracing = found.get("jaxpr_trace_duration", 0.0)
    tracing += found.get("jaxpr_to_mlir_module_duration", 0.0)
    compiling = found.get("backend_compile_duration", 0.0)
    times = (f"{seconds:.1f} s" for seconds in (found["seconds"], tracing, compiling))
    counts = (f"{found.get(name, 0):.0f}" for name in ("cache_misses", "cache_hits"))
    return name, ("first", "second")[number], *times, *counts


def main() -> None:
    """Measure, print and record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--only", default="", help="the case that begins so")
    given = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, starts in cases(Path(folder)).items():
            if name.startswith(given.only):
                for number, (code, words) in enumerate(starts):
                    rows.append(row(name, number, started(code, *words)))
                    print("  ".join(rows[-1]), flush=True)
    how = f"{os.getloadavg()[0]:.0f} processes were running at the end."
    title = "## The second start\n\nThe model `small`; seconds of whole processes."
    text = f"{title} {how}\n\n{machine('jax', 'jaxlib')}\n\n{table(HEADER, rows)}"
    print(text)
    if given.record:
        record("second_start", text)


if __name__ == "__main__":
    main()
