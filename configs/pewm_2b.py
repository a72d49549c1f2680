"""The paper's size: CogVideoX-2b, 9 frames of 512×512, 0.94 billion parameters of memory."""

import dataclasses

from pewm_jax.config import Config
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.cogvideox.vae import VAECodec
from pewm_jax.models.dinov2.model import DINOv2EncoderConfig
from pewm_jax.worlds.pewm import paper


def config() -> Config:
    """Return the settings of the paper on CogVideoX-2b."""
    return on("2b")


def on(variant: str) -> Config:
    """Return the settings of the paper on a published CogVideoX.

    They are those of ``pewm_jax.worlds.pewm.paper``, with DINOv2's features (ViT-S/14 at 518²).
    Training needs ``train.start``: converted weights, widened to depth and cameras, with those of
    DINOv2 (``pewm-jax convert import cogvideox SRC DST --rgbd --camera --encoder DINOV2``; then
    ``pewm-jax train DST`` has these settings too). ``--plan`` needs nothing.
    """
    snr_shift = 3.0 if variant == "2b" else 1.0
    return paper.experiment(
        dataclasses.replace(DiTBackbone.published(variant), prompt="stored"),
        VAECodec.published(variant),
        DDPMConfig(target="v", snr_shift=snr_shift, sample_steps=50),
        run=f"pewm_{variant.lower().replace('-', '_')}",
        encoder=DINOv2EncoderConfig(),
    )
