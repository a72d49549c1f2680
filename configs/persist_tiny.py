"""PERSIST, small: a world of blocks at 64×64 pixels, trained in about half an hour on two cores."""

import dataclasses

from pewm_jax.codecs.learned import LearnedCodecConfig
from pewm_jax.config import ClipConfig, Config, DataConfig, EvalConfig, StageConfig
from pewm_jax.controls.actions import ModulationConfig
from pewm_jax.diffusion.flow import FrameFlowConfig
from pewm_jax.memory.class_grid import GridConfig
from pewm_jax.models.persist.config import (
    BlocksConfig,
    CameraModelConfig,
    VoxelDiTConfig,
    VoxelRendererConfig,
    VoxelVAEConfig,
)
from pewm_jax.models.persist.nets import PersistNetsConfig
from pewm_jax.worlds.persist.config import PersistTrainConfig
from pewm_jax.worlds.persist.world import PERSIST

CLASSES = 73
"""Nine groups of kinds in eight colours, and nothing."""


def config() -> Config:
    """Return the settings of ``persist_tiny``.

    Its data: ``pewm-jax data collect data/persist --moving --voxels --voxels.kinds groups
    --voxels.colours 8 --voxels.pictures cells --voxels.cell 0.25 --voxels.side 40 --train 128
    --validation 8 --test 16 --frames 40``. The codec of pictures is the one that comes with the
    library.
    """
    codec = LearnedCodecConfig(gate=48)
    width = {"head_dim": 40, "gates": "open"}
    voxels = FrameFlowConfig(per_frame=True, times="ends", sample_steps=1, shift=1.0, predicts="x0")
    pixels = dataclasses.replace(voxels, times="uniform", sample_steps=2, context_noise=0.1)
    return Config(
        model=PERSIST(
            clip=ClipConfig(frames=5, height=64, width=64),
            codec=codec,
            backbone=PersistNetsConfig(
                voxel_vae=VoxelVAEConfig(
                    side=32,
                    classes=CLASSES,
                    patch=2,
                    embed=16,
                    widths=(256,),
                    blocks=1,
                    middle=0,
                    kernel=1,
                    middle_kernel=1,
                    latent_channels=16,
                    kl=1e-5,
                    cube=8,
                    cubes=16,
                    compared=192,
                    occupied_weight=6.0,
                ),
                world_frames=VoxelDiTConfig(
                    latent_side=16,
                    latent_channels=16,
                    patch=4,
                    actions=3,
                    pixel_channels=codec.channels + 24,
                    pixel_patch=1,
                    blocks=BlocksConfig(layers=4, heads=8, mlp_ratio=2, context=4, **width),
                ),
                camera_model=CameraModelConfig(
                    classes=CLASSES,
                    inner=6,
                    embed=8,
                    actions=3,
                    units=(0.05, 0.05, 0.05, 0.05, 0.05, 0.05),
                    blocks=BlocksConfig(layers=2, heads=2, head_dim=32, context=4),
                ),
                renderer=VoxelRendererConfig(
                    classes=CLASSES,
                    height=8,
                    width=8,
                    latent_channels=codec.channels,
                    rays=4,
                    layers=6,
                    embed=16,
                    sides=True,
                    kernel=2,
                    stride=2,
                    fold=8,
                    drawn=codec.channels,
                    patch=1,
                    longest_m=12.0,
                    blocks=BlocksConfig(layers=4, heads=4, context=3, **width),
                ),
            ),
            control=ModulationConfig(units=(0.25, 0.25, 1.0)),
            memory=GridConfig(
                cell_m=(0.25, 0.25, 0.25),
                cells=(128, 128, 32),
                recorded=40,
                kinds="groups",
                colours=8,
                pictures="cells",
            ),
            noise=pixels,
            voxel_noise=voxels,
            persistence_logit=30.0,
            empty_prior=2.0,
            observation_logit=60.0,
            points=True,
            dead_reckoning=True,
        ),
        data=DataConfig(path="data/persist", context=8, stride_max=1, prepared=640),
        train=PersistTrainConfig(
            run="runs/persist_tiny",
            start="codec",
            optimizer="muon",
            voxel_vae=StageConfig(
                steps=1500, batch=2, learning_rate=4e-3, warmup=30, optimizer="adam"
            ),
            voxel_statistics=StageConfig(steps=40, batch=8, learning_rate=0.05, warmup=0),
            world_frames=StageConfig(steps=340, batch=6, learning_rate=1.5e-3, warmup=30),
            camera=StageConfig(steps=40, batch=16, learning_rate=1e-3, warmup=10),
            renderer=StageConfig(steps=900, batch=6, learning_rate=1.5e-3, warmup=30),
            occupied=3.0,
            classes=4.0,
            ema=0.98,
        ),
        evaluate=EvalConfig(clips=24, seeds=(0,), videos=4, video_clips=8, batch=8),
    )
