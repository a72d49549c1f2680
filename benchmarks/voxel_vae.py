"""How fast the autoencoder of voxels learns on a CPU, by how its 3D convolutions are computed.

`python benchmarks/voxel_vae.py` prints, for kernels that see 27 places and kernels that see one,
the seconds to compile a gradient step and the processor seconds of a step, with convolutions by XLA
and as products. Processor seconds are all threads' together: other programs on the machine change
them less than they change the time that passes.
"""

from __future__ import annotations

import argparse
import dataclasses
import time

import jax
import numpy as np
from record import table

from pewm_jax.config import VoxelVAEConfig
from pewm_jax.models import voxel_vae

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batch", type=int, default=4, help="grids of a step")
    parser.add_argument("--runs", type=int, default=3)
    asked = parser.parse_args()
    print(f"{asked.batch} grids of {SMALL.side}³ cells, {SMALL.classes} classes, processor seconds")
    print(table(["network", "convolutions", "compile", "step"], []))
    for name, config in FORMS.items():
        for form in ("xla", "products"):
            chosen = dataclasses.replace(config, convolution=form)
            compiling, step = measure(chosen, asked.batch, asked.runs)
            print(f"| {name} | {form} | {compiling:.1f} | {step:.2f} |", flush=True)


if __name__ == "__main__":
    main()
