"""The experiment of ``make table1``: small enough to train every memory three times in hours."""

import dataclasses

from pewm_jax.codecs.learned import LearnedCodecConfig
from pewm_jax.config import Config, DataConfig, EvalConfig, StageConfig
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.presets import demo
from pewm_jax.readers.attention import AttentionConfig


def config() -> Config:
    """Return the settings that all rows share; ``pewm_jax.studies.table1`` lists what differs.

    The demo's, with a narrower backbone and half its batch, so that slow readers get as many steps
    as possible. No gate mixes the memory's picture into what is imagined: what a memory gives goes
    through the model. The cells are the paper's.
    """
    base = demo.config()
    reader = AttentionConfig(looks=64, heads=4, head_dim=32)
    return dataclasses.replace(
        base,
        model=dataclasses.replace(
            base.model,
            codec=LearnedCodecConfig(),
            backbone=dataclasses.replace(base.model.backbone, layers=4, heads=4),
            memory=VoxelConfig(capacity=4096, tokens=384, reader=reader),
        ),
        data=DataConfig(path="data/demo", context=20, prepared=1024),
        train=dataclasses.replace(
            base.train,
            run="runs/table1/run",
            start="codec",
            stage1=StageConfig(steps=1000, batch=8, learning_rate=1e-3, warmup=30),
            stage2=StageConfig(steps=1000, batch=8, learning_rate=1e-3, warmup=30),
            ema=0.99,
            log_every=10,
        ),
        evaluate=EvalConfig(clips=96, seeds=(0,), batch=16),
    )
