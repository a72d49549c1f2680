"""PERSIST at its published sizes: 288×512 pixels, grids of 48³ cells with 2,138 classes."""

from pewm_jax.config import Config, DataConfig, EvalConfig, StageConfig
from pewm_jax.memory.class_grid import GridConfig
from pewm_jax.models.persist.config import (
    BlocksConfig,
    VoxelDiTConfig,
    VoxelRendererConfig,
    VoxelVAEConfig,
)
from pewm_jax.models.persist.nets import PersistNetsConfig
from pewm_jax.worlds.persist.config import PersistTrainConfig
from pewm_jax.worlds.persist.world import PERSIST


def config() -> Config:
    """Return the published sizes with this library's codec of pictures.

    The published pictures have 360×640 pixels in patches of 10; this codec's cells have 8, so that
    288×512 pixels are the same 36×64 latents of 16 channels. ``--plan`` needs nothing.
    """
    blocks = BlocksConfig(remat=True)
    return Config(
        model=PERSIST(
            backbone=PersistNetsConfig(
                voxel_vae=VoxelVAEConfig(slab=8, convolution="xla"),
                world_frames=VoxelDiTConfig(blocks=blocks),
                renderer=VoxelRendererConfig(blocks=BlocksConfig(context=16, remat=True)),
            ),
            memory=GridConfig(recorded=56),
            dtype="bfloat16",
        ),
        data=DataConfig(path="data/persist_xl", context=8, stride_max=1),
        train=PersistTrainConfig(
            run="runs/persist_xl",
            beta2=0.99,  # as the paper's AdamW
            weight_decay=2e-3,
            clip_norm=1.0,
            ema=0.9999,
            save_every=1000,
            voxel_vae=StageConfig(steps=200_000, batch=64, learning_rate=1e-4, warmup=1000),
            voxel_statistics=StageConfig(steps=200, batch=64, learning_rate=0.03, warmup=0),
            world_frames=StageConfig(steps=400_000, batch=64, learning_rate=1e-4, warmup=1000),
            camera=StageConfig(steps=100_000, batch=64, learning_rate=1e-4, warmup=1000),
            renderer=StageConfig(steps=400_000, batch=64, learning_rate=1e-4, warmup=1000),
        ),
        evaluate=EvalConfig(),
    )
