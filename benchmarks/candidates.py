"""What it costs to compare many controls: 64 imagined from one state, with and without remembering.

`python benchmarks/candidates.py` prints, for each preset, the time of both and their ratio. The
states of candidates that are not remembered share one map.
"""

from __future__ import annotations

import argparse
import functools
import time

import jax
import jax.numpy as jnp
import numpy as np
from record import machine, record, table

from pewm_jax import presets, worlds
from pewm_jax.geometry import cameras
from pewm_jax.types import Camera, Frames


def frames_of(model, count: int, rng: np.random.Generator) -> Frames:
    """Return frames of random walls, looked at while turning around."""
    height, width = model.clip.height, model.clip.width
    poses = [cameras.pose_from_yaw((0.0, 0.0, 1.25), 0.5 * k, 0.0) for k in range(count)]
    intrinsics = cameras.intrinsics_from_fov(height, width, 90.0)
    return Frames(
        rng.integers(0, 256, (count, height, width, 3), dtype=np.uint8),
        rng.uniform(0.5, 5.0, (count, height, width)).astype(np.float32),
        Camera(np.tile(intrinsics, (count, 1)), np.stack(poses)),
    )


def measure(preset: str, candidates: int, actions: int, runs: int) -> dict[bool, list[float]]:
    """Return the seconds of every run, with (True) and without (False) remembering, in turn."""
    config, rng = presets.load(preset), np.random.default_rng(0)
    model = config.model
    params = worlds.init(model, jax.random.key(0))
    state = worlds.start(model, params, frames_of(model, config.data.context, rng))
    moves = jnp.asarray(rng.integers(0, 3, (candidates, actions)))
    keys = jax.random.split(jax.random.key(1), candidates)
    compiled, seconds = {}, {True: [], False: []}
    for remember in seconds:
        many = functools.partial(worlds.imagine_many, model)
        if remember:
            many = jax.vmap(functools.partial(worlds.imagine, model), (None, None, 0, 0))
        compiled[remember] = jax.jit(many).lower(params, state, moves, keys).compile()
        jax.block_until_ready(compiled[remember](params, state, moves, keys))
    for _ in range(runs):
        for remember, imagine in compiled.items():
            began = time.perf_counter()
            jax.block_until_ready(imagine(params, state, moves, keys))
            seconds[remember].append(time.perf_counter() - began)
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--presets", nargs="+", default=["tiny", "demo"])
    parser.add_argument("--candidates", type=int, default=64)
    parser.add_argument("--actions", type=int, default=8)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--record", action="store_true", help="write the numbers to RESULTS.md")
    options = parser.parse_args()
    rows = []
    for preset in options.presets:
        seconds = measure(preset, options.candidates, options.actions, options.runs)
        both = {remember: float(np.median(times)) for remember, times in seconds.items()}
        ratios = np.array(seconds[False]) / np.array(seconds[True])
        spread = f"{np.median(ratios):.2f} ({ratios.min():.2f} to {ratios.max():.2f})"
        rows.append((preset, f"{both[True]:.3f} s", f"{both[False]:.3f} s", spread))
    header = ("preset", "remembering", "not remembering", "ratio, median of pairs (range)")
    text = (
        f"## {options.candidates} candidates from one state, {options.actions} actions each\n\n"
        f"{table(header, rows)}\n\n"
        f"Medians of {options.runs} runs in turn. {machine('jax')}."
    )
    print(text)
    if options.record:
        record("candidates", text)


if __name__ == "__main__":
    main()
