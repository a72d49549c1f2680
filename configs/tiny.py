"""Absurdly small: shows in seconds that everything runs, learns next to nothing; for tests."""

from pewm_jax.config import ClipConfig, Config, DataConfig, EvalConfig, StageConfig, TrainConfig
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.worlds.pewm.world import PEWM


def config() -> Config:
    """Return the settings of the tests."""
    stage = StageConfig(steps=6, batch=2, warmup=2)
    return Config(
        model=PEWM(
            clip=ClipConfig(frames=5, height=16, width=16),
            backbone=DiTBackbone(
                layers=2, heads=2, head_dim=16, text_length=1, text_dim=8, time_dim=16
            ),
            memory=VoxelConfig(
                cell_m=(0.25, 0.25, 0.25),
                cells=(32, 32, 8),
                capacity=256,
                tokens=16,
                reader=AttentionConfig(heads=4, head_dim=8),
            ),
            noise=DDPMConfig(sample_steps=2),
        ),
        data=DataConfig(path="data/tiny", stride_max=2, context=4),
        train=TrainConfig(
            run="runs/tiny",
            stage1=stage,
            stage2=stage,
            save_every=3,
            log_every=1,
            preview_every=0,
            noise_key="weights",  # its published losses were drawn so
        ),
        evaluate=EvalConfig(clips=2, seeds=(0, 1), videos=1, video_clips=2, batch=2),
    )
