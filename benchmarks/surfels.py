"""Rendering a memory of points: 9 frames of 512 × 512 from 200,000 points, beside torch.

`python benchmarks/surfels.py` prints the time of `rendering.splat` (a point is a pixel) beside the
same z-buffer in torch (`scatter_reduce` with amin, then the lowest index of the nearest), of
`rendering.splat_surfels` (points with a size, hidden surfaces, shared pixels), which has no peer
here, and of filling the holes. Both z-buffers must agree.

Then what it costs to give the demo's reader the rendered picture as pixels and as the codec's
latents (``memory.reader.picture``): preparing a batch of its clips, and a step of stage 2 on it.
``--only reading`` does that alone.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch
from memory_peers import SIZE, T, room
from record import machine, record, table

from pewm_jax import presets
from pewm_jax.config import Config
from pewm_jax.data.episodes import read_episode
from pewm_jax.data.make_episode import CollectConfig, make_episode
from pewm_jax.geometry.cameras import invert_rigid, unproject
from pewm_jax.memory import rendering
from pewm_jax.memory import rendering as views
from pewm_jax.readers.render import RenderConfig
from pewm_jax.train import sharding
from pewm_jax.train.step import abstract_state, compile_step, noise_key
from pewm_jax.types import Array, Camera, Clip
from pewm_jax.worlds.pewm.world import STAGES

POINTS = 200_000


def scene() -> tuple[Array, Array, Array, Array, Camera]:
    """Return points of a furnished room, colours, widths, validity, and the clip's cameras."""
    frames = jax.tree.map(jnp.asarray, room(0))
    chosen = np.random.default_rng(0).permutation(frames.depth_THW.size)[:POINTS]
    points = unproject(frames.depth_THW, frames.camera).reshape(-1, 3)[chosen]
    colours = jnp.asarray(np.random.default_rng(1).uniform(-1, 1, (POINTS, 3)), jnp.float32)
    return points, colours, jnp.full(POINTS, 0.04), jnp.ones(POINTS, bool), frames.camera


def torch_splat(points: Array, colours: Array, camera: Camera) -> Callable[[], tuple]:
    """Return the z-buffer of ``rendering.splat`` in torch, frame after frame."""
    places, shades = (torch.from_numpy(np.array(x)) for x in (points, colours))
    moves = torch.from_numpy(np.array(invert_rigid(camera.world_from_camera)))
    intrinsics = torch.from_numpy(np.array(camera.intrinsics_4))
    numbers, pixels = torch.arange(POINTS), SIZE * SIZE

    def run() -> tuple[torch.Tensor, torch.Tensor]:
        images, depths = [], []
        for move, (fx, fy, cx, cy) in zip(moves, intrinsics, strict=True):
            x, y, z = (places @ move[:3, :3].T + move[:3, 3]).unbind(1)
            safe = torch.where(z > 1e-6, z, 1.0)
            column = torch.floor(x / safe * fx + cx).long()
            row = torch.floor(y / safe * fy + cy).long()
            there = (z > rendering.NEAREST_M) & (row >= 0) & (row < SIZE)
            there &= (column >= 0) & (column < SIZE)
            pixel = torch.where(there, row * SIZE + column, pixels)
            depth = torch.full((pixels + 1,), torch.inf).scatter_reduce_(0, pixel, z, "amin")
            first = torch.where(there & (z <= depth[pixel]), pixel, pixels)
            index = torch.full((pixels + 1,), POINTS).scatter_reduce_(0, first, numbers, "amin")
            index, depth = index[:-1], depth[:-1]
            seen = index < POINTS
            images.append(torch.where(seen[:, None], shades[index.clamp(max=POINTS - 1)], 0.0))
            depths.append(torch.where(seen, depth, 0.0))
        return torch.stack(images), torch.stack(depths)

    return run


def measure(repeats: int) -> tuple[dict[str, list[float]], str]:
    """Return the seconds of every run of everything, in turn, and what was checked."""
    points, colours, wide, valid, camera = scene()
    plain = jax.jit(rendering.splat, static_argnums=(4, 5))
    sized = jax.jit(rendering.splat_surfels, static_argnums=(5, 6), static_argnames=("most",))
    fill = jax.jit(views.fill_nearest)
    peer = torch_splat(points, colours, camera)
    drawn = functools.partial(sized, points, colours, wide, valid, camera, SIZE, SIZE)
    ours = functools.partial(plain, points, colours, valid, camera, SIZE, SIZE)
    view, covered = ours(), drawn(most=3)
    runs: dict[str, Callable[[], object]] = {
        "pewm_jax, splat": ours,
        "torch, scatter_reduce": peer,
        "pewm_jax, splat_surfels, 1 pixel": functools.partial(drawn, most=1),
        "pewm_jax, splat_surfels, up to 3 × 3 pixels": functools.partial(drawn, most=3),
        "pewm_jax, fill_nearest": functools.partial(fill, covered),
    }
    image, depth = (x.numpy().reshape(T, SIZE, SIZE, -1) for x in peer())
    same = np.isclose(np.asarray(view.depth_THW), depth[..., 0], atol=1e-4)
    assert same.mean() > 0.999, "the same depths, but for points on the border of two pixels"
    alike = np.isclose(np.asarray(view.features_THWF), image, atol=1e-4).all(-1)
    assert alike.mean() > 0.999, "the same points in front"
    words = (
        f"Pixels hit: {np.asarray(view.seen_THW).mean():.0%} by `splat`, "
        f"{np.asarray(covered.seen_THW).mean():.0%} by `splat_surfels` up to 3 × 3; `splat` and "
        f"torch agree in {alike.mean():.2%} of the pixels."
    )
    times: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(repeats + 1):
        for name, run in runs.items():
            begin = time.perf_counter()
            jax.block_until_ready(run())
            if turn:  # the first compiles
                times[name].append(time.perf_counter() - begin)
    return times, words


def walk(config: Config, batch: int) -> Clip:
    """Return clips along a walk through a generated house, each after its context."""
    context, length = config.data.context, config.model.clip.frames
    size = config.model.clip.height
    settings = CollectConfig(Path("unused"), frames=batch + context + length, size=size)
    episode = read_episode(make_episode(settings, "revisit", 0))

    def frames(count: int, after: int) -> Any:
        parts = (episode.frames(range(k + after, k + after + count)) for k in range(batch))
        return jax.tree.map(lambda *x: np.stack(x), *parts)

    return Clip(frames(length, context), frames(context, 0), np.ones((batch, context), bool))


def filled(like: Any) -> Any:
    """Return small positive numbers of these shapes: drawing weights properly compiles longer."""
    rng = np.random.default_rng(0)

    def one(leaf: Any) -> Array:
        drawn = jnp.array(np.abs(rng.normal(0, 0.02, leaf.shape)), leaf.dtype)
        return jax.device_put(drawn, leaf.sharding)

    return jax.tree.map(one, like)


def readings(batch: int) -> dict[tuple[str, str], Callable[[], object]]:
    """Return what is timed for each picture: preparing a batch, a step of stage 2 on it."""
    found: dict[tuple[str, str], Callable[[], object]] = {}
    for picture in ("pixels", "latents"):
        config, stage = presets.load("demo"), STAGES[1]
        assert stage.prepare is not None
        reader = config.model.memory.reader
        assert isinstance(reader, RenderConfig)
        reader = dataclasses.replace(reader, picture=picture)
        config = config.with_model(memory=dataclasses.replace(config.model.memory, reader=reader))
        mesh = sharding.make_mesh(jax.devices()[:1])
        state = filled(abstract_state(config, stage, mesh))
        clips, key = jax.device_put((walk(config, batch), noise_key(config, stage)))
        prepare = jax.jit(functools.partial(stage.prepare, config.model))
        frozen = {"codec": jax.tree.map(jnp.copy, state.params["codec"])}
        ready = prepare(frozen, clips)
        step, states = compile_step(config, stage, mesh, ready), [state]

        def prepared(prepare=prepare, frozen=frozen, clips=clips) -> object:
            return jax.block_until_ready(prepare(frozen, clips))

        def stepped(step=step, states=states, ready=ready, key=key) -> object:
            states[0], metrics = step(states[0], ready, key)
            return jax.block_until_ready(metrics)

        found["preparing", picture] = prepared
        found["a step", picture] = stepped
    return found


def show_reading(repeats: int, batch: int, recorded: bool) -> None:
    """Measure both pictures in turn, print, and rewrite the section of ``RESULTS.md`` if asked."""
    runs = readings(batch)
    times: dict[tuple[str, str], list[float]] = {name: [] for name in runs}
    for turn in range(repeats + 1):
        for name, run in runs.items():
            begin = time.perf_counter()
            run()
            if turn:  # the first warms up
                times[name].append(time.perf_counter() - begin)
    rows: list[list[str]] = []
    for what in ("preparing", "a step"):
        pixels, latents = times[what, "pixels"], times[what, "latents"]
        ratio = statistics.median(b / a for a, b in zip(pixels, latents, strict=True))
        middle = [f"{statistics.median(spent) * 1e3:.0f} ms" for spent in (pixels, latents)]
        rows.append([what, *middle, f"{ratio:.2f}×"])
    text = table([f"{batch} clips", "pixels", "latents", "latents over pixels"], rows)
    print(text, flush=True)
    if recorded:
        how = (
            f"`python benchmarks/surfels.py --only reading --record`: the demo's model and sizes, "
            f"random weights, clips of one walk; medians of {repeats} in turn. {machine('jax')}."
        )
        title = "## Reading a rendered memory as pixels or as latents"
        record("reading", "\n\n".join([title, how, text]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--batch", type=int, default=16, help="clips that are read at once")
    parser.add_argument("--only", choices=("points", "reading"), help="one of the two parts")
    parser.add_argument("--record", action="store_true", help="rewrite this section of RESULTS.md")
    chosen = parser.parse_args()
    if chosen.only != "reading":
        show(chosen.repeats, chosen.record)
    if chosen.only != "points":
        show_reading(chosen.repeats, chosen.batch, chosen.record)


def show(repeats: int, recorded: bool) -> None:
    """Measure, print, and rewrite the section of ``RESULTS.md`` if asked."""
    times, words = measure(repeats)
    ours, rows = times["pewm_jax, splat"], []
    for name, spent in times.items():
        ratio = statistics.median(a / b for a, b in zip(spent, ours, strict=True))
        rows.append([name, f"{statistics.median(spent) * 1e3:.0f} ms", f"{ratio:.1f}×"])
    text = table(["what", "one clip", "time over pewm_jax, splat"], rows)
    print(text, words, sep="\n", flush=True)
    if recorded:
        how = (
            f"`python benchmarks/surfels.py --record`: {T} frames of {SIZE} × {SIZE} pixels from "
            f"{POINTS:,} points; medians of {repeats}; torch on "
            f"{torch.get_num_threads()} threads. {machine('jax', 'torch', 'numpy')}."
        )
        title = "## Rendering a memory of points"
        record("surfels", "\n\n".join([title, how, text, words]))


if __name__ == "__main__":
    main()
