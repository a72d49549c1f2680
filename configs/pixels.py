"""The paper's reader on plain pixels, without a codec: 48×48 pixels, minutes on two CPU cores."""

from pewm_jax.config import ClipConfig, Config, DataConfig, StageConfig, TrainConfig
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.worlds.pewm.world import PEWM


def config() -> Config:
    """Return the settings of the first demo, kept to compare memories with.

    Each was chosen by trying (48 held-out clips or fewer, one seed: trials, not results):

    * ``snr_shift`` 64 and ``max_weight`` 1: an 8×8 pixel patch of 4 frames is so redundant that
      its mean colour shows through all but the heaviest noise. With a shift of 1 every patch
      hallucinated its own colour and stage 1 reached 12.9 dB, with 64 it reached 15.2 dB.
    * 48 pixels and not 64: half the time per step, at the same 6 × 6 or 8 × 8 patches of 8 pixels.
    * memory narrower than the backbone: attention to the map is what a step's time goes to.
    """
    return Config(
        model=PEWM(
            clip=ClipConfig(height=48, width=48),
            backbone=DiTBackbone(layers=4, heads=6, head_dim=32),
            memory=VoxelConfig(
                cell_m=(0.25, 0.25, 0.25),
                tokens=384,
                reader=AttentionConfig(looks=96, heads=8, head_dim=24, mlp_ratio=2),
            ),
            noise=DDPMConfig(snr_shift=64.0, max_weight=1.0, sample_steps=4),
        ),
        data=DataConfig(path="data/pixels", context=20),
        train=TrainConfig(
            run="runs/pixels",
            stage1=StageConfig(steps=300, batch=16, learning_rate=1e-3, warmup=30),
            stage2=StageConfig(steps=700, batch=16, learning_rate=2e-3, warmup=30),
            ema=0.98,
            preview_every=300,
        ),
    )
