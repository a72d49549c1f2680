"""A U-ViT on pixels with the memory of `small`, to imagine rooms never seen; not shipped yet."""

import dataclasses

from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import Config, DataConfig, EvalConfig, StageConfig, TrainConfig
from pewm_jax.models.uvit import UViTBackbone
from pewm_jax.presets import demo, egowm
from pewm_jax.readers.render import RenderConfig
from pewm_jax.worlds.pewm.world import PEWM


def config() -> Config:
    """Return the settings of ``small2``.

    Its data: ``pewm-jax data collect data/small2 --train 3000 --frames 72 --handheld 0.3``.
    Training starts from the weights of ``egowm``, which already denoise frames that begin with the
    observed one; the reader of the memory is new. The observed frame is rendered from each camera,
    and 30 % of the rendered memories have errors, as those of real recordings have. Surfels are
    finer than those of ``small``, for surfaces nearer than those of generated houses. Batches are
    small and of few frames: many steps learn faster. LPIPS is part of the losses (``pip install
    'pewm-jax[metrics]'``), and the gate is trained last, on clips that the model imagines.
    """
    base = demo.config().model
    reader = RenderConfig(picture_width=192, blocks=False)
    of_frames = StageConfig(batch=4, frames=3, learning_rate=2e-3)
    return Config(
        model=PEWM(
            clip=base.clip,
            codec=PixelConfig(spatial=4, temporal=1, gate=48),
            backbone=UViTBackbone(layers=6, heads=6, head_dim=32),
            memory=dataclasses.replace(
                base.memory,
                reader=reader,
                cell_m=(0.02, 0.02, 0.02),
                cells=(1280, 1280, 256),
                keep="newest",
            ),
            noise=dataclasses.replace(egowm.NOISE, sample_steps=6),
            observed="warped",
        ),
        data=DataConfig(
            path="data/small2",
            context=20,
            stride_max=2,
            prepared=2048,
            prepared_path="data/small2_prepared",
            refresh=2,
        ),
        train=TrainConfig(
            run="runs/small2",
            optimizer="muon",
            start="egowm",
            fresh=(r"memory/.*", r"control/.*"),
            wider=("backbone/into/kernel",),
            stage1=dataclasses.replace(of_frames, steps=0),
            stage2=dataclasses.replace(of_frames, steps=0),
            joint=dataclasses.replace(of_frames, steps=16000, whole=0.15, warmup=100),
            gate=StageConfig(steps=1200, batch=4, learning_rate=1e-3, warmup=50),
            gate_lpips=2.0,
            denoised_lpips=0.3,
            denoised_lpips_weights="equal",
            hidden=0.15,
            chained=0.15,
            memory_errors=0.3,
            ema=0.999,
            preview_every=0,
        ),
        evaluate=EvalConfig(clips=48),
    )
