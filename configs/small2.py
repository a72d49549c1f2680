"""The second edition of `small`: a U-ViT on pixels refines its frames; not shipped yet."""

import dataclasses

from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import Config, DataConfig, EvalConfig, StageConfig, TrainConfig
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.models.uvit import UViTBackbone
from pewm_jax.presets import demo
from pewm_jax.readers.render import RenderConfig
from pewm_jax.worlds.draft import NetworkDraft
from pewm_jax.worlds.pewm.world import PEWM


def config() -> Config:
    """Return the settings of ``small2``.

    ``small`` predicts each clip, in one sampling step: its layout, blurred where nothing was seen
    (``model.draft``). A U-ViT on pixels draws the details. Its sampler starts from these frames
    with noise, so that few steps are enough. Surfels are finer than those of ``small``, for
    surfaces nearer than those of generated houses.

    Its data: ``pewm-jax data collect data/small2 --train 3000 --frames 72 --handheld 0.3``.
    Training starts from the weights of ``egowm``, which already denoise frames of houses; the
    reader of the memory is new. Batches are small and of few frames: many steps learn faster. LPIPS
    is part of the losses (``pip install 'pewm-jax[metrics]'``), and the gate is trained last, on
    clips that the model imagines.
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
            noise=EDMConfig(
                sigma_data=0.5,
                log_mean=-0.7,
                log_std=1.1,
                sigma_min=0.1,
                sigma_max=1.5,
                sample_steps=4,
            ),
            observed="drafted",
            asked_alone=True,
            draft=NetworkDraft(
                codec=base.codec,
                backbone=base.backbone,
                reader=base.memory.reader,
                noise=dataclasses.replace(base.noise, sample_steps=1),
            ),
        ),
        data=DataConfig(
            path="data/small2",
            context=20,
            stride_max=2,
            prepared=2048,
            prepared_path="data/small2_prepared",
            refresh=4,
        ),
        train=TrainConfig(
            run="runs/small2",
            optimizer="muon",
            start="egowm",
            start_draft="small",
            fresh=(r"memory/.*", r"control/.*"),
            wider=("backbone/into/kernel",),
            stage1=dataclasses.replace(of_frames, steps=0),
            stage2=dataclasses.replace(of_frames, steps=0),
            joint=dataclasses.replace(of_frames, steps=16000, whole=0.1, warmup=100),
            gate=StageConfig(steps=1200, batch=4, learning_rate=1e-3, warmup=50),
            gate_lpips=2.0,
            denoised_lpips=0.3,
            denoised_lpips_weights="equal",
            chained=0.15,
            ema=0.999,
            preview_every=0,
        ),
        evaluate=EvalConfig(clips=48),
    )
