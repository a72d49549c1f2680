"""Run on eight simulated devices by ``test_training_devices``; prints what it measured as JSON.

The same steps of the real model on one device and on eight; and a checkpoint written by eight
devices, read by one.
"""

import dataclasses
import json
import os
import sys
from pathlib import Path

os.environ["XLA_FLAGS"] = " ".join(
    (
        "--xla_force_host_platform_device_count=8",
        "--xla_backend_optimization_level=0",  # compile quickly
        "--xla_llvm_disable_expensive_passes=true",
    )
)

import jax
import numpy as np
import training_fakes as fakes

import configs
from pewm_jax import tree
from pewm_jax.training import sharding, stages, step
from pewm_jax.training.checkpoint import Checkpoints

STEPS = 3


def main(run: Path) -> None:
    tiny = configs.load("tiny")
    config = fakes.with_stage(tiny, "stage2", batch=8)
    config = dataclasses.replace(config, dit=dataclasses.replace(tiny.dit, layers=1))
    stage = stages.STAGES[1]
    losses, states, meshes, copies = {}, {}, {}, {}
    for count in (1, 8):
        mesh = meshes[count] = sharding.make_mesh(jax.devices()[:count])
        state = step.initial_state(config, stage, mesh)
        step_fn = step.compile_step(config, stage, mesh, fakes.clip(config, 8, 0))
        key = jax.device_put(step.stage_key(config, stage), sharding.replicated(mesh))
        losses[count] = []
        for number in range(STEPS):
            clip = jax.device_put(fakes.clip(config, 8, number), sharding.of_batch(mesh))
            state, metrics = step_fn(state, clip, key)
            losses[count].append(float(metrics["loss"]))
        states[count] = state
        copies[count] = len(clip.frames.rgb_THWC.sharding.device_set)
    with Checkpoints(run, config, stage) as checkpoints:
        checkpoints.save(states[8])
        checkpoints.wait()
        restored = checkpoints.restore(step.abstract_state(config, stage, meshes[1]))
    eight, one = tree.flatten(states[8]), tree.flatten(restored)
    print(
        json.dumps(
            {
                "losses": losses,
                "batch_on": copies,
                "restored": all(np.array_equal(one[path], eight[path]) for path in eight),
                "restored_on": max(len(leaf.sharding.device_set) for leaf in one.values()),
            }
        )
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
