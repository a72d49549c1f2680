"""Procedural houses at 64×64 pixels: two stages and a report in ten minutes on two CPU cores."""

from pewm_jax.codecs.learned import LearnedCodecConfig
from pewm_jax.config import ClipConfig, Config, DataConfig, EvalConfig, StageConfig, TrainConfig
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.readers.render import RenderConfig
from pewm_jax.worlds.pewm.world import PEWM


def config() -> Config:
    """Return the settings of the demo.

    The codec and its gate come with the library (``train.start`` codec) and stand still; the world
    model begins at random. Clips are prepared once: encoding them and building their memories takes
    a CPU longer than a step does.
    """
    return Config(
        model=PEWM(
            clip=ClipConfig(height=64, width=64),
            codec=LearnedCodecConfig(gate=48),
            backbone=DiTBackbone(layers=6, heads=6, head_dim=32),
            memory=SurfelConfig(
                cell_m=(0.03, 0.03, 0.03),
                capacity=98304,
                footprint=5,
                reader=RenderConfig(picture_width=192),
            ),
            noise=DDPMConfig(snr_shift=4.0, max_weight=1.0, sample_steps=6),
        ),
        data=DataConfig(path="data/demo", context=20, prepared=512),
        train=TrainConfig(
            run="runs/demo",
            start="codec",
            fresh=(r"(backbone|memory)/.*",),
            optimizer="muon",
            noise_key="weights",  # its published numbers were drawn so
            stage1=StageConfig(steps=220, batch=16, learning_rate=1e-3, warmup=30),
            stage2=StageConfig(steps=240, batch=16, learning_rate=1e-3, warmup=30),
            ema=0.98,
            depth_noise=0.02,
            preview_every=0,
        ),
        evaluate=EvalConfig(clips=24),
    )
