"""Frame by frame against chunks: how long as many frames take, on the same backbone.

Navigation World Models imagine one frame from the ones before, EgoWM a chunk at once. `python
benchmarks/egowm_latency.py` times both on one network with random weights, whose attention spans
what each has to see: the present frame and the one to come, or the present frame and a chunk. Runs
of the two alternate; medians of the wall time, with least and most. ``--record`` rewrites the
section of ``RESULTS.md``, ``--preset`` takes another network.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import statistics
import time
from typing import Any

import jax
import numpy as np
from record import machine, record, table

from pewm_jax import presets, worlds
from pewm_jax.geometry.actions import integrate
from pewm_jax.types import Camera, Control, Frames
from pewm_jax.worlds.egowm.world import EgoWM

PRESET = "egowm"


def models(preset: str, chunk: int, steps: int) -> dict[str, EgoWM]:
    """Return the two ways: the same networks, clips of 2 frames and of ``chunk`` + 1."""
    base = presets.load(preset).model
    assert isinstance(base, EgoWM)
    noise = dataclasses.replace(base.noise, sample_steps=steps or base.noise.sample_steps)

    def of(frames: int) -> EgoWM:
        return dataclasses.replace(
            base, clip=dataclasses.replace(base.clip, frames=frames), noise=noise
        )

    return {"frame by frame": of(2), f"chunks of {chunk}": of(chunk + 1)}


def main() -> None:
    """Time both and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--frames", type=int, default=64, help="frames to imagine")
    parser.add_argument("--chunk", type=int, default=8, help="frames of a chunk")
    parser.add_argument("--steps", type=int, default=0, help="sampling steps; 0: the preset's")
    parser.add_argument("--repeats", type=int, default=5, help="timed runs of each")
    parser.add_argument("--preset", default=PRESET, help="whose network it is")
    parser.add_argument("--record", action="store_true", help="rewrite this section of RESULTS.md")
    given = parser.parse_args()
    ways = models(given.preset, given.chunk, given.steps)
    runs = {}
    for name, model in ways.items():
        params = jax.jit(worlds.init, static_argnums=0)(model, jax.random.key(0))
        state = worlds.start(model, params, _frame(model))
        run = jax.jit(functools.partial(worlds.imagine, model))
        control = _control(model, given.frames)
        runs[name] = functools.partial(run, params, state, control, jax.random.key(1))
        jax.block_until_ready(runs[name]())
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(given.repeats):
        for name, run in runs.items():
            began = time.perf_counter()
            jax.block_until_ready(run())
            seconds[name].append(time.perf_counter() - began)
    slow = [statistics.median(found) for found in seconds.values()]
    rows = [
        [name, f"{m:.2f}", f"{min(found):.2f} … {max(found):.2f}", f"{m / slow[-1]:.2f}"]
        for (name, found), m in zip(seconds.items(), slow, strict=True)
    ]
    text = table(["", "seconds, median", "least … most", "of the chunks' time"], rows)
    print(text)
    if given.record:
        steps = next(iter(ways.values())).noise.sample_steps
        how = (
            f"`python benchmarks/egowm_latency.py --record`: {given.frames} frames, the network of "
            f"`{given.preset}` with random weights, {steps} sampling steps, "
            f"{given.repeats} turns, on {jax.devices()[0].device_kind}. {machine('jax')}."
        )
        record("egowm_latency", "\n\n".join(["## Frame by frame against chunks", how, text]))


def _control(model: EgoWM, frames: int) -> Any:
    """Return planar actions or, for others, a control with the cameras of such actions."""
    actions = np.tile(np.array([[0.25, 0, 0.1]], np.float32), (frames, 1))
    present, count = _frame(model).camera, model.batch_spec.actions
    if count == actions.shape[1]:
        return actions
    poses = integrate(present.world_from_camera[0], actions)[1:]
    camera = Camera(np.repeat(present.intrinsics_4, frames, 0), np.asarray(poses))
    return Control(camera, np.zeros((frames, count), np.float32), np.zeros(count, np.float32))


def _frame(model: EgoWM) -> Frames:
    """Return one random frame."""
    rng, size = np.random.default_rng(0), model.clip
    shape = (1, size.height, size.width)
    return Frames(
        rng.integers(0, 256, (*shape, 3), dtype=np.uint8),
        rng.uniform(1, 4, shape).astype(np.float32),
        Camera(np.full((1, 4), 32, np.float32), np.eye(4, dtype=np.float32)[None]),
    )


if __name__ == "__main__":
    main()
