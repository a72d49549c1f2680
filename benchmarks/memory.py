"""Inserting one clip into the voxel map, beside NumPy and torch; bytes, points, extents.

Rendering and reading what is rendered follow, as ``benchmarks/surfels.py`` alone prints them.

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
import statistics
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import surfels
import torch
from memory_peers import (
    CHANNELS,
    CONFIG,
    NUMPY_SHARE,
    PATCHES,
    SIZE,
    T,
    numpy_peer,
    peak_mb,
    room,
    slots,
    torch_peer,
)
from record import machine, record, table

from pewm_jax.config import Memory
from pewm_jax.memory import voxel_map
from pewm_jax.types import Frames

DTYPES = {"f32": jnp.float32, "bf16": jnp.bfloat16}


def seconds(run: Callable[[], object]) -> float:
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin


def inserter(config: Memory, frames: Frames, features: jax.Array) -> Callable[[], object]:
    """Return a compiled insertion of a clip into an empty map, waited for."""
    frames = jax.tree.map(jnp.asarray, frames)
    voxels = voxel_map.empty(config, np.zeros(3), features.shape[-1], features.dtype)
    insert = jax.jit(voxel_map.insert_frames, static_argnums=0)
    return lambda: jax.block_until_ready(insert(config, voxels, frames, features))


def planned_mb(frames: Frames, features: jax.Array) -> float:
    """Return what XLA allots to our insertion beside its inputs, MB."""
    voxels = voxel_map.empty(CONFIG, np.zeros(3), features.shape[-1], features.dtype)
    insert = jax.jit(voxel_map.insert_frames, static_argnums=0)
    plan = insert.lower(CONFIG, voxels, frames, features).compile().memory_analysis()
    return (plan.temp_size_in_bytes + plan.output_size_in_bytes) / 1e6


def comparison(repeats: int) -> tuple[str, list[str]]:
    """Return the table of insertions and a line on the fastest peer for each dtype."""
    frames = room(0)
    slot_THW = slots(CONFIG, frames)
    plain = np.random.default_rng(0).normal(size=(T, PATCHES, PATCHES, CHANNELS))
    rows, lines = [], []
    for kind, dtype in DTYPES.items():
        features = jnp.asarray(plain, dtype)
        theirs = {"f32": torch.float32, "bf16": torch.bfloat16}[kind]
        single = plain.astype(np.float32)
        runs = {
            "pewm_jax": inserter(CONFIG, frames, features),
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
        peaks["pewm_jax"] = planned_mb(frames, features)
        for name, spent in times.items():
            ratio = statistics.median(a / b for a, b in zip(spent, times["pewm_jax"], strict=True))
            memory = f"{peaks[name]:.0f} MB" if name in peaks else "–"
            middle = statistics.median(spent)
            rows.append([kind, name, f"{middle * 1e3:.0f} ms", f"{ratio:.1f}×", memory])
        fastest = min(
            statistics.median(a / b for a, b in zip(spent, times["pewm_jax"], strict=True))
            for name, spent in times.items()
            if name != "pewm_jax"
        )
        lines.append(f"{kind}: {fastest:.1f}× faster than the fastest peer.")
    header = ["features", "who", "one clip", "time over pewm_jax", "peak memory beyond the inputs"]
    return table(header, rows), lines


def check(runs: dict, slot_THW: np.ndarray, kind: str) -> None:
    """Insist that ours and torch's maps are equal up to rounding of the interpolation."""
    voxels, theirs = runs["pewm_jax"](), runs["torch index_reduce"]().float().numpy()
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
    header = [
        "features",
        "bytes that must move",
        "copy bandwidth",
        "floor",
        "pewm_jax",
        "over floor",
    ]
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
    surfels.show(chosen.repeats, chosen.record)
    surfels.show_reading(chosen.repeats, 16, chosen.record)


if __name__ == "__main__":
    main()
