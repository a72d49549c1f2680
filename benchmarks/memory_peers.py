"""The clip that ``memory`` inserts, and how NumPy and torch insert it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import torch

from pewm_jax.config import Memory
from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw, ray_directions
from pewm_jax.memory import voxel_frames, voxel_map
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.types import Camera, Frames

T, SIZE, PATCHES, CHANNELS = 9, 512, 37, 384
CONFIG = VoxelConfig(cell_m=(0.25, 0.25, 1.0), cells=(256, 256, 32), capacity=4096)
NUMPY_SHARE = 16
"""NumPy is timed on this fraction of one frame."""


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


def slots(config: Memory, frames: Frames) -> np.ndarray:
    """Return (T, H, W) int64: the slot of every pixel; V − 1 is never occupied here."""
    voxels = voxel_map.empty(config, np.zeros(3), 1)
    frames = jax.tree.map(jnp.asarray, frames)
    cell_THW, _ = voxel_frames.pixel_cells(
        config, voxels.origin_3, frames.depth_THW, frames.camera, jnp.ones(T, bool)
    )
    seen = cell_THW[:, 1:-1, 1:-1]
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


def peak_mb(what: str) -> float:
    """Return the growth of a fresh process's resident memory while it runs ``what`` once more."""
    code = f"import memory_peers; memory_peers.measure_peak({what!r})"
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
