"""Inserting one clip into the voxel map, beside NumPy and torch; bytes, points, extents.

Run with ``python benchmarks/memory.py`` (a few minutes); ``--record`` rewrites its section of
``RESULTS.md``. One clip of the paper's size: 9 frames of 512 × 512 pixels in a furnished room,
37 × 37 × 384 features per frame, into a map of 4,096 cells. Everyone does the same: upsample the
features bilinearly, unproject the depth, take the maximum per cell. Ours goes from frames to map;
the peers are given every pixel's slot (finding cells costs them nothing) and their time is the
upsampling and the maximum, frame by frame so that they fit into memory. NumPy is timed on one
frame's 1/16 and scaled up, which is what its linear cost allows. Runs are interleaved; times are
medians. Peak memory is XLA's plan for ours and what the process grows by for torch.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import statistics
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import torch
from record import machine, record, table

from pewm_jax.config import MemoryConfig
from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw, ray_directions
from pewm_jax.memory import voxel_frames, voxel_map
from pewm_jax.types import Camera, Frames

T, SIZE, PATCHES, CHANNELS = 9, 512, 37, 384
CONFIG = MemoryConfig(cell_m=(0.25, 0.25, 1.0), cells=(256, 256, 32), capacity=4096)
NUMPY_SHARE = 16
"""NumPy is timed on this fraction of one frame."""
GOAL = 2.0
"""How many times faster than the fastest peer on a processor."""
DTYPES = {"f32": jnp.float32, "bf16": jnp.bfloat16}


def room(noise_m: float, seed: int = 0) -> Frames:
    """Return a clip of an agent walking and turning in a room of 8 × 6 × 2.7 m with 12 boxes.

    Args:
        noise_m: standard deviation of the depth, metres.
        seed: of the furniture and of the noise.
    """
    rng = np.random.default_rng(seed)
    poses = [pose_from_yaw(np.array([0.1 * i, 0, 0]), 0.15 * i) for i in range(T)]
    camera = Camera(np.tile(intrinsics_from_fov(SIZE, SIZE, 90), (T, 1)), np.stack(poses))
    rays = np.asarray(ray_directions(camera.intrinsics_4, SIZE, SIZE))
    rays = np.einsum("tij,thwj->thwi", camera.world_from_camera[:, :3, :3], rays)
    start = camera.world_from_camera[:, None, None, :3, 3]
    low, high = np.array([-4.1, -3.1, -1.3]), np.array([3.9, 2.9, 1.4])
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(rays > 0, (high - start) / rays, (low - start) / rays).min(-1)
        for _ in range(12):
            foot = np.append(rng.uniform((-4, -3), (3, 2)), low[2])
            top = foot + rng.uniform(0.3, 1.2, 3)
            a, b = (foot - start) / rays, (top - start) / rays
            enter, leave = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
            depth = np.where((enter < leave) & (enter > 0.2), np.minimum(depth, enter), depth)
    depth = np.maximum(depth + rng.normal(0, 1, depth.shape) * noise_m, 0.1)
    return Frames(np.zeros((T, 1, 1, 3), np.float32), depth.astype(np.float32), camera)


def seconds(run: Callable[[], object]) -> float:
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin


def inserter(config: MemoryConfig, frames: Frames, features: jax.Array) -> Callable[[], object]:
    """Return a compiled insertion of a clip into an empty map, waited for."""
    frames = jax.tree.map(jnp.asarray, frames)
    voxels = voxel_map.empty(config, np.zeros(3), features.shape[-1], features.dtype)
    insert = jax.jit(voxel_map.insert_frames, static_argnums=0)
    return lambda: jax.block_until_ready(insert(config, voxels, frames, features))


def slots(config: MemoryConfig, frames: Frames) -> np.ndarray:
    """Return (T, H, W) int64: the slot of every pixel; V − 1 is never occupied here."""
    voxels = voxel_map.empty(config, np.zeros(3), 1)
    frames = jax.tree.map(jnp.asarray, frames)
    seen = voxel_frames.pixel_cells(config, voxels.origin_3, frames.depth_THW, frames.camera)
    names, slot = np.unique(np.asarray(seen), return_inverse=True)
    assert len(names) < config.capacity, "the room fits into the map"
    return slot.reshape(seen.shape)


def torch_peer(features: np.ndarray, dtype: torch.dtype, slot_THW: np.ndarray, how: str):
    """Return torch's insertion: interpolate, then index_reduce or scatter_reduce, per frame."""
    warnings.filterwarnings("ignore", "index_reduce.. is in beta")
    patches = torch.from_numpy(features).to(dtype).permute(0, 3, 1, 2)
    slot = torch.from_numpy(slot_THW.reshape(T, -1))

    def run() -> torch.Tensor:
        out = torch.full((CONFIG.capacity, CHANNELS), -torch.inf, dtype=dtype)
        for frame in range(T):
            part = patches[frame : frame + 1].contiguous(memory_format=torch.channels_last)
            wide = torch.nn.functional.interpolate(
                part, (SIZE, SIZE), mode="bilinear", align_corners=False
            )
            rows = wide.permute(0, 2, 3, 1).reshape(-1, CHANNELS)
            if how == "index_reduce":
                out.index_reduce_(0, slot[frame], rows, "amax")
            else:
                index = slot[frame][:, None].expand(-1, CHANNELS)
                out.scatter_reduce_(0, index, rows, "amax")
        return out

    return run


def numpy_peer(features: np.ndarray, slot_THW: np.ndarray) -> Callable[[], np.ndarray]:
    """Return NumPy's insertion of 1/16 of one frame: separable interpolation, maximum.at."""
    square, share = voxel_frames.between(SIZE, PATCHES)
    first, second = np.clip(square, 0, PATCHES - 1), np.clip(square + 1, 0, PATCHES - 1)
    rows = slice(0, SIZE // NUMPY_SHARE)
    slot = slot_THW[0, rows].reshape(-1)

    def run() -> np.ndarray:
        out = np.full((CONFIG.capacity, CHANNELS), -np.inf, features.dtype)
        down = share[rows, None, None].astype(features.dtype)
        across = share[None, :, None].astype(features.dtype)
        tall = features[0][first[rows]] * (1 - down) + features[0][second[rows]] * down
        wide = tall[:, first] * (1 - across) + tall[:, second] * across
        np.maximum.at(out, slot, wide.reshape(-1, CHANNELS))
        return out

    return run


def planned_mb(frames: Frames, features: jax.Array) -> float:
    """Return what XLA allots to our insertion beside its inputs, MB."""
    voxels = voxel_map.empty(CONFIG, np.zeros(3), features.shape[-1], features.dtype)
    insert = jax.jit(voxel_map.insert_frames, static_argnums=0)
    plan = insert.lower(CONFIG, voxels, frames, features).compile().memory_analysis()
    return (plan.temp_size_in_bytes + plan.output_size_in_bytes) / 1e6


def peak_mb(what: str) -> float:
    """Return the growth of a fresh process's resident memory while it runs ``what`` once more."""
    code = f"import memory; memory.measure_peak({what!r})"
    here = Path(__file__).parent
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=here,
        env={**os.environ, "PYTHONPATH": f"{here.parent}{os.pathsep}{here}"},
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


def measure_peak(what: str) -> None:
    """Print the peak of resident memory during torch's insertion over what was held before, MB."""
    name, kind = what.split()
    frames = room(0)
    features = np.random.default_rng(0).normal(size=(T, PATCHES, PATCHES, CHANNELS))
    dtype = {"f32": torch.float32, "bf16": torch.bfloat16}[kind]
    run = torch_peer(features.astype(np.float32), dtype, slots(CONFIG, frames), name)
    page, peak, stop = os.sysconf("SC_PAGESIZE"), [0], threading.Event()
    statm = Path("/proc/self/statm")

    def watch() -> None:
        while not stop.is_set():
            peak[0] = max(peak[0], int(statm.read_text().split()[1]) * page)
            stop.wait(0.001)

    before = int(statm.read_text().split()[1]) * page
    watcher = threading.Thread(target=watch)
    watcher.start()
    run()
    stop.set()
    watcher.join()
    print(json.dumps((peak[0] - before) / 1e6))


def comparison(repeats: int) -> tuple[str, list[str]]:
    """Return the table of insertions and a line on the goal for each dtype."""
    frames = room(0)
    slot_THW = slots(CONFIG, frames)
    plain = np.random.default_rng(0).normal(size=(T, PATCHES, PATCHES, CHANNELS))
    rows, lines = [], []
    for kind, dtype in DTYPES.items():
        features = jnp.asarray(plain, dtype)
        theirs = {"f32": torch.float32, "bf16": torch.bfloat16}[kind]
        single = plain.astype(np.float32)
        runs = {
            "ours": inserter(CONFIG, frames, features),
            "torch index_reduce": torch_peer(single, theirs, slot_THW, "index_reduce"),
            "torch scatter_reduce": torch_peer(single, theirs, slot_THW, "scatter_reduce"),
            "numpy maximum.at": numpy_peer(np.asarray(features), slot_THW),
        }
        scale = {"numpy maximum.at": T * NUMPY_SHARE}
        check(runs, slot_THW, kind)
        times: dict[str, list[float]] = {name: [] for name in runs}
        for _ in range(repeats):
            for name, run in runs.items():
                times[name].append(seconds(run) * scale.get(name, 1))
        peaks = {name: peak_mb(f"{name.split()[-1]} {kind}") for name in list(runs)[1:3]}
        peaks["ours"] = planned_mb(frames, features)
        for name, spent in times.items():
            ratio = statistics.median(a / b for a, b in zip(spent, times["ours"], strict=True))
            memory = f"{peaks[name]:.0f} MB" if name in peaks else "–"
            middle = statistics.median(spent)
            rows.append([kind, name, f"{middle * 1e3:.0f} ms", f"{ratio:.1f}×", memory])
        fastest = min(
            statistics.median(a / b for a, b in zip(spent, times["ours"], strict=True))
            for name, spent in times.items()
            if name != "ours"
        )
        verdict = "reached" if fastest >= GOAL else "missed"
        lines.append(
            f"{kind}: {fastest:.1f}× faster than the fastest peer (goal {GOAL}×: {verdict})."
        )
    header = ["features", "who", "one clip", "time over ours", "peak memory beyond the inputs"]
    return table(header, rows), lines


def check(runs: dict, slot_THW: np.ndarray, kind: str) -> None:
    """Insist that ours and torch's maps are equal up to rounding of the interpolation."""
    voxels, theirs = runs["ours"](), runs["torch index_reduce"]().float().numpy()
    count = int(voxels.occupied)
    assert count == len(np.unique(slot_THW)), "as many cells"
    mine = np.asarray(voxels.features_VF[:count], np.float32)
    bound = 1e-5 if kind == "f32" else 0.04
    assert np.abs(mine - theirs[:count]).max() < bound, "the same maxima"


def growth(repeats: int) -> tuple[str, str]:
    """Return tables of time over points and over extent."""
    features = jnp.asarray(
        np.random.default_rng(0).normal(size=(T, PATCHES, PATCHES, CHANNELS)), jnp.float32
    )
    frames, whole = room(0), T * SIZE * SIZE
    cases = {}
    for count in (1, 2, 4, 9):
        part = jax.tree.map(lambda x, count=count: x[:count], frames)
        cases["frames", f"{count}"] = (inserter(CONFIG, part, features[:count]), count * SIZE**2)
    rng = np.random.default_rng(1)
    insert = jax.jit(voxel_map.insert, static_argnums=0)
    for count in (25_000, 50_000, 100_000, 200_000):
        points = jnp.asarray(rng.uniform(-4, 4, (count, 3)) * (1, 1, 0.3), jnp.float32)
        values = jnp.asarray(rng.normal(size=(count, CHANNELS)), jnp.float32)
        given = (CONFIG, voxel_map.empty(CONFIG, np.zeros(3), CHANNELS), points, values)
        valid = jnp.ones(count, bool)
        cases["points", f"{count:,}"] = (
            lambda given=given, valid=valid: jax.block_until_ready(insert(*given, valid)),
            count,
        )
    for side in (32, 256, 2048, 8192):
        wide = dataclasses.replace(CONFIG, cells=(side, side, 16))
        cases["extent", f"{side * 0.25:,.0f} m"] = (inserter(wide, frames, features), whole)
    for noise in (0.0, 0.01, 0.1, 1.0):
        cases["noise", f"{noise:g} m"] = (inserter(CONFIG, room(noise), features), whole)
    times: dict[tuple[str, str], list[float]] = {name: [] for name in cases}
    for _ in range(repeats + 1):
        for name, (run, _) in cases.items():
            times[name].append(seconds(run))
    rows, sizes = [], []
    for (what, name), spent in times.items():
        middle, count = statistics.median(spent[1:]), cases[what, name][1]
        line = [
            what,
            name,
            f"{count:,}",
            f"{middle * 1e3:.0f} ms",
            f"{middle / count * 1e9:.0f} ns",
        ]
        rows.append(line)
    for side in (32, 256, 2048, 8192):
        wide = dataclasses.replace(CONFIG, cells=(side, side, 16))
        blank = voxel_map.empty(wide, np.zeros(3), CHANNELS)
        sizes.append(sum(x.nbytes for x in jax.tree.leaves(blank)) / 1e6)
    words = (
        "*frames*, *extent*, *noise*: frames as above, fewer of them, in a grid of other sides, "
        "and with noisy depth (nothing can be skipped on white noise); *points*: "
        f"`insert` of single points. The map takes {min(sizes):.1f} to {max(sizes):.1f} MB at "
        "every extent."
    )
    return table(["what", "", "points", "time", "per point"], rows), words


def floor(repeats: int) -> str:
    """Return how long the bytes that must move take on this device, beside the insertion."""
    frames = room(0)
    cells = len(np.unique(slots(CONFIG, frames)))
    block = jnp.ones((64 * 2**20,), jnp.float32)
    copy = jax.jit(lambda x: x + 1)
    jax.block_until_ready(copy(block))
    spent = [seconds(lambda: jax.block_until_ready(copy(block))) for _ in range(repeats * 2)]
    bandwidth = 2 * block.nbytes / statistics.median(spent)
    rows = []
    for kind, dtype in DTYPES.items():
        features = jnp.ones((T, PATCHES, PATCHES, CHANNELS), dtype)
        moved = features.nbytes + frames.depth_THW.nbytes
        moved += 2 * cells * CHANNELS * features.dtype.itemsize
        run = inserter(CONFIG, frames, features)
        run()
        middle = statistics.median(seconds(run) for _ in range(repeats * 2))
        least = moved / bandwidth
        rows.append(
            [
                kind,
                f"{moved / 1e6:.1f} MB",
                f"{bandwidth / 1e9:.0f} GB/s",
                f"{least * 1e3:.2f} ms",
                f"{middle * 1e3:.1f} ms",
                f"{middle / least:.0f}×",
            ]
        )
    device = jax.devices()[0].device_kind
    header = ["features", "bytes that must move", "copy bandwidth", "floor", "ours", "over floor"]
    return (
        f"On {device}: features and depth read once, touched cells read and written once.\n\n"
        + (table(header, rows))
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--record", action="store_true", help="rewrite this section of RESULTS.md")
    chosen = parser.parse_args()
    print(f"{jax.devices()[0]}; torch on {torch.get_num_threads()} threads", flush=True)
    first, lines = comparison(chosen.repeats)
    print(first, *lines, sep="\n", flush=True)
    second, words = growth(chosen.repeats)
    print(second, words, sep="\n", flush=True)
    third = floor(chosen.repeats)
    print(third)
    if chosen.record:
        clip = f"{T} × {SIZE} × {SIZE} pixels, {PATCHES} × {PATCHES} × {CHANNELS} features"
        how = (
            f"`python benchmarks/memory.py --record`: {clip}; medians of {chosen.repeats}; NumPy "
            f"timed on 1/{T * NUMPY_SHARE} of the clip. {machine('jax', 'torch', 'numpy')}."
        )
        text = [
            "## Inserting a clip into the voxel map",
            how,
            first,
            "  \n".join(lines),
            second,
            words,
            third,
        ]
        record("memory", "\n\n".join(text))


if __name__ == "__main__":
    main()
