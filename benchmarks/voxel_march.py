"""Rays through a grid of class ids: ours beside the same march in NumPy and in torch.

`python benchmarks/voxel_march.py` takes a grid of 48³ cells, a tenth of them occupied, and the
36×64 rays of PERSIST's renderer with up to 192 layers each, and checks that all three meet the same
cells. Goal: at least 5 times the faster of the other two on a processor. Compared are the shortest
of the runs, taken in turn: other programs on the machine make a run longer and never shorter. With
``--record`` the section of ``RESULTS.md`` is rewritten.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import torch
from record import machine, record, table

from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw
from pewm_jax.geometry.march import march

SIDE, ROWS, COLUMNS, LAYERS = 48, 36, 64, 192
CELL_M = 0.1


def scene(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return class ids, and the origins and directions of the rays of a camera in the middle."""
    rng = np.random.default_rng(seed)
    ids = rng.integers(1, 30, (SIDE,) * 3) * (rng.random((SIDE,) * 3) < 0.1)
    fx, fy, cx, cy = intrinsics_from_fov(ROWS, COLUMNS, 72.0)
    row, column = np.indices((ROWS, COLUMNS)) + 0.5
    seen = np.stack([(column - cx) / fx, (row - cy) / fy, np.ones_like(row)], -1).reshape(-1, 3)
    pose = pose_from_yaw(np.full(3, SIDE * CELL_M / 2), 0.4)
    directions = np.float32(seen @ np.asarray(pose)[:3, :3].T)
    origins = np.broadcast_to(np.float32(pose[:3, 3]), directions.shape)
    return ids.astype(np.int32), np.ascontiguousarray(origins), directions


def with_numpy(ids: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> Any:
    """Return (R, L) class ids and distances; rays begin inside of the grid."""
    start, way = origins / np.float32(CELL_M), directions / np.float32(CELL_M)
    ahead, forward = np.where(way > 0, 1, -1), way > 0
    inverse = 1 / np.where(way == 0, np.float32(1e-12), way)
    cell, flat = np.floor(start).astype(np.int32), ids.reshape(-1)
    rays = np.arange(len(start))
    made, count = np.zeros((len(start), LAYERS), np.int32), np.zeros(len(start), int)
    distances, distance = np.zeros(made.shape, np.float32), np.zeros(len(start), np.float32)
    for _ in range(3 * SIDE):
        inside = ((cell >= 0) & (cell < SIDE)).all(-1)
        if not inside.any():
            break
        at = np.where(inside, (cell[:, 0] * SIDE + cell[:, 1]) * SIDE + cell[:, 2], 0)
        found = np.where(inside, flat[at], 0)
        kept = np.flatnonzero((found > 0) & (count < LAYERS))
        made[kept, count[kept]] = found[kept]
        distances[kept, count[kept]] = distance[kept]
        count[kept] += 1
        away = (cell + forward - start) * inverse
        side = away.argmin(-1)
        distance = away[rays, side]
        cell[rays, side] += ahead[rays, side]
    return made, distances


def with_torch(ids: torch.Tensor, origins: torch.Tensor, directions: torch.Tensor) -> Any:
    """Return (R, L) class ids and distances; rays begin inside of the grid."""
    start, way = origins / CELL_M, directions / CELL_M
    ahead, forward = torch.where(way > 0, 1, -1), way > 0
    inverse = 1 / torch.where(way == 0, 1e-12, way)
    cell, flat = torch.floor(start).long(), ids.reshape(-1)
    made = torch.zeros((len(start), LAYERS + 1), dtype=torch.int32)
    count = torch.zeros(len(start), dtype=torch.long)
    distances, distance = torch.zeros(made.shape), torch.zeros(len(start))
    for _ in range(3 * SIDE):
        inside = ((cell >= 0) & (cell < SIDE)).all(-1)
        if not inside.any():
            break
        at = torch.where(inside, (cell[:, 0] * SIDE + cell[:, 1]) * SIDE + cell[:, 2], 0)
        found = torch.where(inside, flat[at], 0)
        full = found > 0
        slot = torch.where(full, count, LAYERS)[:, None].clamp(max=LAYERS)
        made.scatter_(1, slot, found[:, None])
        distances.scatter_(1, slot, distance[:, None])
        count += full
        away = (cell + forward - start) * inverse
        side = away.argmin(-1, keepdim=True)
        distance = away.gather(1, side)[:, 0]
        cell.scatter_add_(1, side, ahead.gather(1, side))
    return made[:, :LAYERS], distances[:, :LAYERS]


def main() -> None:
    """Measure, print, and record if asked."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--repeats", type=int, default=60)
    parser.add_argument("--record", action="store_true", help="rewrite this section of RESULTS.md")
    options = parser.parse_args()
    ids, origins, directions = scene()
    given = [jax.device_put(x) for x in (ids, origins, directions)]
    tensors = [torch.tensor(x) for x in (ids, origins, directions)]
    low = np.zeros(3, np.float32)
    ours = jax.jit(lambda a, b, c: march(a, low, CELL_M, b, c, LAYERS))
    runs: dict[str, Callable[[], Any]] = {
        "pewm_jax": lambda: jax.block_until_ready(ours(*given)),
        "NumPy": lambda: with_numpy(ids, origins, directions),
        "torch": lambda: with_torch(*tensors),
    }
    hits = runs["pewm_jax"]()
    same, there = np.asarray(hits.ids_L), np.asarray(hits.distance_L)
    for other in ("NumPy", "torch"):
        ids_there, distances = (np.asarray(x) for x in runs[other]())
        apart = ((same != ids_there) | (np.abs(there - distances) > 1e-3)).any(-1).mean()
        if apart > 0.005:  # a ray through an edge may meet either cell
            raise SystemExit(f"{other} meets other cells along {apart:.1%} of the rays")
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(options.repeats):
        for name, run in runs.items():
            begin = time.perf_counter()
            run()
            times[name].append(time.perf_counter() - begin)
    best, rays = {name: min(each) for name, each in times.items()}, len(origins)
    rows = [
        [
            name,
            f"{1e3 * best[name]:.2f} ms",
            f"{1e3 * statistics.median(each):.2f} ms",
            f"{rays / best[name] / 1e6:.2f} M",
            f"{best[name] / best['ours']:.1f}×",
        ]
        for name, each in times.items()
    ]
    text = table([f"{rays} rays", "shortest", "median", "rays/s", "over pewm_jax"], rows)
    print(text)
    if options.record:
        how = (
            "`python benchmarks/voxel_march.py --record`: 48³ cells, a tenth of them occupied, up "
            f"to {LAYERS} layers. {machine('jax', 'torch')}."
        )
        record("voxel_march", "\n\n".join(["## Rays through a grid of classes", how, text]))


if __name__ == "__main__":
    main()
