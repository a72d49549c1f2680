"""How fast the autoencoder of voxels learns on a CPU, by how its 3D convolutions are computed.

`python benchmarks/voxel_vae.py` prints, for kernels that see 27 places and kernels that see one,
the seconds to compile a gradient step and the processor seconds of a step, with convolutions by XLA
and as products. Processor seconds are all threads' together: other programs on the machine change
them less than they change the time that passes.

With ``--learn data/persist`` the autoencoder of the preset persist_tiny is trained on that
dataset's houses (``collect --voxels``) instead, by Adam, and the share of cells of held-out houses
whose class it gives back is printed.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax
from record import table

from pewm_jax import presets
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.models.persist import voxel_vae
from pewm_jax.models.persist.config import VoxelVAEConfig

SMALL = VoxelVAEConfig(
    side=32,
    classes=256,
    patch=4,
    embed=16,
    widths=(128,),
    blocks=1,
    middle=1,
    latent_channels=16,
    compared=4096,
)
RATE, WARMUP, BATCH = 4e-3, 50, 4
FORMS = {
    "patches of 4, 27 places": SMALL,
    "patches of 4, 27 places in the middle": dataclasses.replace(SMALL, kernel=1),
    "patches of 4, one place": dataclasses.replace(SMALL, kernel=1, middle=0),
    "patches of 2, two levels": dataclasses.replace(SMALL, patch=2, widths=(32, 64)),
}


def measure(config: VoxelVAEConfig, batch: int, runs: int) -> tuple[float, float]:
    """Return processor seconds of compiling a step, and of one step."""
    params = jax.jit(voxel_vae.init, static_argnums=0)(config, jax.random.key(0))
    shape = (batch, config.side, config.side, config.side)
    grids = np.random.default_rng(0).integers(0, config.classes, shape)
    loss = jax.value_and_grad(
        lambda params, grids, key: voxel_vae.loss(config, params, grids, key), has_aux=True
    )
    began = time.process_time()
    step = jax.jit(loss).lower(params, grids, jax.random.key(0)).compile()
    compiling = time.process_time() - began
    jax.block_until_ready(step(params, grids, jax.random.key(0)))
    began = time.process_time()
    for number in range(runs):
        jax.block_until_ready(step(params, grids, jax.random.key(number)))
    return compiling, (time.process_time() - began) / runs


def grids(path: Path, every: int, side: int) -> tuple[np.ndarray, int]:
    """Return the middle of each ``every``-th grid of a split, and the count of classes."""
    source, found = EpisodeSource(path), []
    for number in range(len(source)):
        episode = source[number]
        classes = episode.voxels(list(range(number % every, episode.length, every))).classes_TXYZ
        low = (classes.shape[1] - side) // 2
        middle = slice(low, low + side)
        found.append(classes[:, middle, middle, middle])
    return np.concatenate(found), len(source[0].voxel_grid.names)


def learn(path: Path, steps: int) -> None:
    """Train on a dataset's houses, and print what is right in held-out ones."""
    preset: Any = presets.load("persist_tiny").model
    config = preset.backbone.voxel_vae
    trained, classes = grids(path / "train", 2, config.side)
    splits = "validation", "revisit"
    held = np.concatenate([grids(path / split, 8, config.side)[0] for split in splits])
    config = dataclasses.replace(config, classes=classes)
    rate = optax.warmup_cosine_decay_schedule(0, RATE, min(WARMUP, steps // 5), steps, RATE / 50)
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))

    @jax.jit
    def step(params, state, ids, key):
        (_, parts), slope = jax.value_and_grad(
            lambda p: voxel_vae.loss(config, p, ids, key), has_aux=True
        )(params)
        change, state = optimizer.update(slope, state)
        return optax.apply_updates(params, change), state, parts

    again = jax.jit(
        lambda p, ids: voxel_vae.decode(config, p, voxel_vae.encode(config, p, ids)),
    )
    params = jax.jit(voxel_vae.init, static_argnums=0)(config, jax.random.key(0))
    state, rng = optimizer.init(params), np.random.default_rng(0)
    began, passed = time.process_time(), time.perf_counter()
    print(f"{len(trained)} grids to learn from, {len(held)} held out, {classes} classes")
    print(table(["step", "processor s", "s", "occupied right", "empty right"], []))
    for number in range(1, steps + 1):
        batch = trained[rng.integers(0, len(trained), BATCH)]
        params, state, _ = step(params, state, batch, jax.random.key(number))
        if number % max(1, steps // 10) == 0:
            spent = time.process_time() - began, time.perf_counter() - passed
            rows = held[: len(held) // BATCH * BATCH].reshape(-1, BATCH, *held.shape[1:])
            right = np.stack([np.asarray(again(params, row)) == row for row in rows])
            shares = right[rows > 0].mean(), right[rows == 0].mean()
            numbers = [f"{x:.0f}" for x in spent] + [f"{x:.2%}" for x in shares]
            print(f"| {' | '.join([str(number), *numbers])} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batch", type=int, default=4, help="grids of a step")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--learn", type=Path, help="a dataset to train a small network on")
    parser.add_argument("--steps", type=int, default=2000, help="of --learn")
    asked = parser.parse_args()
    if asked.learn:
        learn(asked.learn, asked.steps)
        return
    print(f"{asked.batch} grids of {SMALL.side}³ cells, {SMALL.classes} classes, processor seconds")
    print(table(["network", "convolutions", "compile", "step"], []))
    for name, config in FORMS.items():
        for form in ("xla", "products"):
            chosen = dataclasses.replace(config, convolution=form)
            compiling, step = measure(chosen, asked.batch, asked.runs)
            print(f"| {name} | {form} | {compiling:.1f} | {step:.2f} |", flush=True)


if __name__ == "__main__":
    main()
