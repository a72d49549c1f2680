"""Run on eight simulated devices by ``test_devices``; prints what it measured as JSON.

The same steps of the real model on one device and on eight, arranged in four ways; where the
compiled steps communicate; and a checkpoint written by eight devices, read by one.
"""

import dataclasses
import functools
import json
import math
import os
import re
import sys
from pathlib import Path

os.environ["XLA_FLAGS"] = " ".join(
    (os.environ.get("XLA_FLAGS", ""), "--xla_force_host_platform_device_count=8")
)

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import presets as configs
from pewm_jax.config import MeshConfig
from pewm_jax.io import tree
from pewm_jax.train import sharding, step
from pewm_jax.train.checkpoint import Checkpoints
from pewm_jax.train.step import create
from pewm_jax.worlds import world_model
from pewm_jax.worlds.pewm.world import STAGES
from tests.helpers import random_camera
from tests.train import fakes

STEPS = 20
MESHES = {
    "one": MeshConfig(data=1),
    "data 8": MeshConfig(data=8),
    "fsdp 8": MeshConfig(fsdp=8),
    "tensor 2 fsdp 4": MeshConfig(tensor=2, fsdp=4),
    "context 4 data 2": MeshConfig(context=4, data=2),
}
STAGE_2 = ("one", "tensor 2 fsdp 4", "context 4 data 2")
"""Where stage 2 is run too, whose step takes long to compile."""
MUON_STEPS = 3
MUON = ("one", "tensor 2 fsdp 4")
"""Where stage 1 is run with Muon too, and half of its clips chained."""
MOVED = r"(all-gather|all-to-all|collective-permute|reduce-scatter|all-reduce)"


def clip(config, seed):
    """Random clips whose frames look at what their context shows."""
    made, rng = fakes.clip(config, 8, seed), np.random.default_rng(seed)
    cameras = [random_camera(rng, 1, 16, 16, upright=True) for _ in range(8)]

    def frames(x):
        count = x.depth_THW.shape[1]
        camera = [jax.tree.map(lambda c: np.repeat(c, count, 0), one) for one in cameras]
        camera = jax.tree.map(lambda *c: np.stack(c).astype(np.float32), *camera)
        return dataclasses.replace(x, camera=camera)

    return dataclasses.replace(made, frames=frames(made.frames), context=frames(made.context))


def backbone(config):
    """Weights that stage 2 starts from, whose output is not zero."""
    make = functools.partial(world_model.init, config.model, memory=False)
    rng = np.random.default_rng(0)
    return jax.tree.map(
        lambda x: rng.normal(0, 0.1, x.shape).astype(np.float32),
        jax.eval_shape(make, jax.random.key(0)),
    )


def collectives(text):
    """Return (kind, elements of the result, where it comes from) of what is communicated."""
    found = []
    for line in text.splitlines():
        match = re.search(rf"= \w+\[([\d,]*)\]\S* {MOVED}(?:-start)?\(", line)
        several = re.search(rf"= \(.*\) {MOVED}(?:-start)?\(", line)
        name = re.search(r'op_name="([^"]*)"', line)
        where = name.group(1) if name else ""
        if match:
            sizes = [int(n) for n in match.group(1).split(",") if n]
            found.append((match.group(2), math.prod(sizes), where))
        elif several:
            found.append((several.group(1), 0, where))
    return found


def fresh(config, stage, mesh):
    """Return what making the state takes on each device, and what all of the state is."""
    like = step.abstract_state(config, stage, mesh)
    where = jax.tree.map(lambda leaf: leaf.sharding, like)
    make = jax.jit(functools.partial(create, config, stage), out_shardings=where)
    compiled = make.lower(step.noise_key(config, stage), None).compile()
    memory = compiled.memory_analysis()
    assert memory is not None
    return {
        "made": memory.output_size_in_bytes + memory.temp_size_in_bytes,
        "whole": sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(like)),
        "communicates": bool(collectives(compiled.as_text())),
    }


def run(config, stage, mesh, state, steps=STEPS):
    step_fn = step.compile_step(config, stage, mesh, clip(config, 0))
    where, whole = sharding.of_batch(mesh), sharding.replicated(mesh)
    key = jax.device_put(step.noise_key(config, stage), whole)
    losses = []
    for number in range(steps):
        placed = jax.device_put(clip(config, number), where)
        state, metrics = step_fn(state, placed, key)
        losses.append(float(metrics["loss"]))
    sizes = {s.data.shape[0] for s in placed.frames.rgb_THWC.addressable_shards}
    return losses, state, sorted(sizes), collectives(step_fn.as_text())


def main(folder: Path) -> None:
    config = configs.load("tiny")
    for name in ("stage1", "stage2"):
        config = fakes.with_stage(config, name, batch=8, steps=STEPS)
    wider = dataclasses.replace(config.model.backbone, heads=8, head_dim=32)
    wide = config.with_model(backbone=wider)
    fsdp = sharding.make_mesh(arranged=MESHES["fsdp 8"])
    out = {"losses": {}, "rows": {}, "moved": {}, "fresh": fresh(wide, STAGES[0], fsdp)}
    states, meshes = {}, {}
    for stage, start in zip(STAGES[:2], (None, backbone(config)), strict=True):
        first = sharding.make_mesh(jax.devices()[:1], MESHES["one"])
        begun = jax.tree.map(np.asarray, step.initial_state(config, stage, first, start))
        for name, arranged in MESHES.items():
            if stage.number == 2 and name not in STAGE_2:
                continue
            devices = jax.devices()[:1] if name == "one" else None
            mesh = meshes[name] = sharding.make_mesh(devices, arranged)
            if (stage.number, name) == (2, "tensor 2 fsdp 4"):  # from host memory, part by part
                state = step.initial_state(config, stage, mesh, start)
            else:
                state = jax.device_put(begun, sharding.of_state(config.model, mesh, begun))
            losses, states[name], rows, moved = run(config, stage, mesh, state)
            label = f"{stage.name} {name}"
            out["losses"][label], out["rows"][label], out["moved"][label] = losses, rows, moved
    config_muon = fakes.with_train(config, optimizer="muon", chained=0.5)
    for name in MUON:
        state = step.initial_state(config_muon, STAGES[0], meshes[name], backbone(config))
        losses = run(config_muon, STAGES[0], meshes[name], state, MUON_STEPS)[0]
        out["losses"][f"muon {name}"] = losses
    stacked = jax.tree.leaves(begun.params["backbone"]["blocks"])
    out["stacked"] = max(leaf.size for leaf in stacked)
    eight, one = states["tensor 2 fsdp 4"], step.abstract_state(config, stage, meshes["one"])
    out["split"] = int(sum(not leaf.is_fully_replicated for leaf in jax.tree.leaves(eight)))
    with Checkpoints(folder, config, stage) as checkpoints:
        checkpoints.save(eight)
        checkpoints.wait()
        restored = checkpoints.restore(one)
    eight, restored = tree.flatten(eight), tree.flatten(restored)
    out["restored"] = all(jnp.array_equal(restored[p], np.asarray(eight[p])) for p in eight)
    out["restored_on"] = max(len(leaf.sharding.device_set) for leaf in restored.values())
    print(json.dumps(out))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
