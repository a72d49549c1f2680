"""Run in a process of its own with eight simulated devices: prints as JSON what was measured."""

import dataclasses
import json
import math

import jax
import numpy as np

from examples.backbone import PerceptronConfig
from examples.codec import TurnConfig
from examples.control import PushConfig
from examples.memory import NewestConfig
from examples.noise import CosineConfig
from pewm_jax import worlds
from pewm_jax.config import ClipConfig, Config, DataConfig, MeshConfig, StageConfig, TrainConfig
from pewm_jax.data import abstract
from pewm_jax.plan import measure
from pewm_jax.readers.render import BothConfig
from pewm_jax.train import sharding, step
from pewm_jax.worlds.pewm.world import PEWM
from tests.helpers import random_frames


def experiment(mesh=None, run="runs/parts", batch=8, width=32) -> Config:
    stage = StageConfig(steps=2, batch=batch, warmup=1)
    return Config(
        model=PEWM(
            clip=ClipConfig(frames=4, height=16, width=16),  # a number that no fold by 4 allows
            codec=TurnConfig(),
            backbone=PerceptronConfig(width=width),
            control=PushConfig(),
            memory=NewestConfig(
                tokens=16, reader=BothConfig(heads=2, head_dim=width // 2, looks=8)
            ),
            noise=CosineConfig(),
        ),
        data=DataConfig(context=3),
        train=TrainConfig(
            run=run,
            stage1=stage,
            stage2=stage,
            mesh=mesh or MeshConfig(),
            preview_every=0,
            save_every=1,
        ),
    )


def clip(config, seed=0):
    """Return a batch of random clips."""
    rng, size, batch = np.random.default_rng(seed), config.model.clip, config.train.stage1.batch
    made = []
    for _ in range(batch):
        parts = [random_frames(rng, n, size.height, size.width) for n in (size.frames, 3)]
        made.append(parts)
    frames, context = (
        jax.tree.map(lambda *x: np.stack(x).astype(x[0].dtype), *part)
        for part in zip(*made, strict=True)
    )
    like = abstract.clip(config, batch)
    actions = rng.normal(0, 0.3, like.actions_TA.shape).astype(np.float32)
    valid = np.ones(like.context_valid_S.shape, bool)
    made = dataclasses.replace(
        like, frames=frames, context=context, actions_TA=actions, context_valid_S=valid
    )
    return jax.tree.map(lambda x, want: np.asarray(x, want.dtype), made, like)


def losses(mesh, devices):
    """Return the losses of two steps of each stage, and how a matrix is split."""
    config = experiment(mesh)
    placed = sharding.make_mesh(devices, mesh)
    found, split, start = [], {}, None
    for stage in worlds.stages(config.model)[:2]:
        state = step.initial_state(config, stage, placed, start)
        batch = jax.device_put(clip(config), sharding.of_batch(placed))
        key = jax.device_put(step.noise_key(config, stage), sharding.replicated(placed))
        run = step.compile_step(config, stage, placed, batch)
        for _ in range(2):
            state, metrics = run(state, batch, key)
            found.append(float(metrics["loss"]))
        start = jax.device_get(state.params)
        up = state.params["backbone"]["blocks"]["up"]
        split = {
            "spec": str(up.sharding.spec),
            "part": up.addressable_shards[0].data.size / up.size,
        }
    return found, split


def counted(number, devices):
    """Return the FLOPs of a compiled step, and those of its jaxpr."""
    config = experiment(batch=8, width=64)
    stage = worlds.stages(config.model)[number - 1]
    sizes = measure.MeshSizes(data=len(devices))
    traced = measure.trace(config, stage, devices)
    work = measure.work_of(config, stage, traced, None)
    counted = math.fsum(work.on_device(sizes).values())
    return measure.compile_traced(traced, sizes).program.flops, counted


def main():
    devices = measure.virtual(8)
    one, _ = losses(MeshConfig(), devices[:1])
    eight, split = losses(MeshConfig(fsdp=4, tensor=2), devices)
    measured = {"one": one, "eight": eight, "split": split}
    measured["flops"] = [counted(number, devices[:1]) for number in (1, 2)]
    print(json.dumps(measured))


if __name__ == "__main__":
    main()
