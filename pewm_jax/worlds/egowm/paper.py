"""EgoWM's experiments, around networks of any size (arXiv 2601.15284)."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

from pewm_jax.config.experiment import Config
from pewm_jax.config.training import DataConfig, EvalConfig, MeshConfig, StageConfig
from pewm_jax.config.world import ClipConfig
from pewm_jax.controls.actions import ModulationConfig
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.cogvideox.vae import VAECodec
from pewm_jax.models.cosmos.backbone import CosmosBackbone
from pewm_jax.models.svd.unet import SVDUNetBackbone
from pewm_jax.models.svd.vae import SVDVAECodec
from pewm_jax.models.wan.vae import WanVAECodec
from pewm_jax.worlds.egowm.world import EgoWM, EgoWMTrainConfig

NOISE = EDMConfig(sigma_data=1.0, sigma_max=700.0, target="v", sample_steps=25)
"""The published scheduler of Stable Video Diffusion."""
SIDE = 512
"""Height and width of the paper's frames, with Stable Video Diffusion."""
COSMOS_NOISE = EDMConfig(sigma_data=1.0, target="flow", ends="sigma_min", sample_steps=35)
"""The scheduler of Cosmos-Predict2, as its published pipeline uses it."""
COSMOS_CLIP = (17, 480, 640)
"""Frames, height and width of the paper's clips with Cosmos: 16 frames after the observed one."""
COGVIDEOX_NOISE = DDPMConfig(target="v", snr_shift=1.0, sample_steps=50)
"""The scheduler of CogVideoX-5b-I2V, as its published pipeline uses it."""
COGVIDEOX_CLIP = (17, 480, 720)
"""Frames, height and width with CogVideoX, which the paper does not use: the published images, and
as many frames as with Cosmos."""


def experiment(
    unet: SVDUNetBackbone,
    vae: SVDVAECodec,
    noise: EDMConfig = NOISE,
    *,
    run: str,
    size: tuple[int, int] = (SIDE, SIDE),
    dtype: Literal["float32", "bfloat16"] = "bfloat16",
) -> Config:
    """Return the settings of the paper on Stable Video Diffusion, with runs in ``runs/`` + ``run``.

    Size (height, width), learning rates, motion bucket, noise on the image, guidance and number of
    sampling steps are the paper's; steps, batch, noise levels in training (those of Stable Video
    Diffusion) and the share of clips without the image are ours.
    """
    height, width = size
    return Config(
        model=EgoWM(
            clip=ClipConfig(frames=9, height=height, width=width, depth=False),
            codec=dataclasses.replace(vae, depth=False),
            backbone=dataclasses.replace(unet, motion_bucket=180.0, remat=True),
            noise=dataclasses.replace(noise, log_mean=0.7, log_std=1.6, guidance=2.0),
            image_noise=0.1,
            dtype=dtype,
        ),
        data=DataConfig(path="data/egowm", context=1, stride_max=1),
        train=EgoWMTrainConfig(
            run=f"runs/{run}",
            adapt=StageConfig(steps=20000, batch=8, learning_rate=1e-5, warmup=500),
            mesh=MeshConfig(fsdp=8),
            image_noise_mean=math.log(0.1),
            image_noise_std=0.0,
            ema=0.9999,
            preview_every=0,
        ),
        evaluate=EvalConfig(batch=1),
    )


def cosmos_experiment(
    transformer: CosmosBackbone,
    vae: WanVAECodec,
    noise: EDMConfig = COSMOS_NOISE,
    *,
    run: str,
    clip: tuple[int, int, int] = COSMOS_CLIP,
    dtype: Literal["float32", "bfloat16"] = "bfloat16",
) -> Config:
    """Return the settings of the paper on Cosmos-Predict2; arguments as for ``experiment``.

    The clip (frames, height, width), the learning rates, and the form of the actions' layers (two
    layers and two convolutions over time, ten times as fast) are the paper's. Steps, batch and
    noise levels in training are ours; there is no guidance, which the paper does not mention, and
    no noise on the observed frame. Adam's decays, which the paper does not state, are those of
    Cosmos-Predict2's own training (0.9 and 0.99,
    ``cosmos_predict2/configs/base/defaults/optimizer.py``).
    """
    noise = dataclasses.replace(noise, log_mean=1.0, log_std=1.2)
    train = _adaptation(run, learning_rate=1e-6, beta2=0.99)
    return _of_transformer(transformer, vae, noise, train, clip, dtype)


def cogvideox_experiment(
    transformer: DiTBackbone,
    vae: VAECodec,
    noise: DDPMConfig = COGVIDEOX_NOISE,
    *,
    run: str,
    clip: tuple[int, int, int] = COGVIDEOX_CLIP,
    dtype: Literal["float32", "bfloat16"] = "bfloat16",
) -> Config:
    """Return the method of the paper on CogVideoX for images; arguments as for ``experiment``.

    The paper has no CogVideoX. As with Cosmos, whose autoencoder also covers four frames by a
    latent one, the actions' layers are two layers and two convolutions over time, ten times as
    fast. The observed frame is where the published network expects it: its latents are further
    input channels of the first latent frame, zeros of the others. Adam's decays are those of
    CogVideoX's own fine-tuning (0.9 and 0.95; CogVideo's ``sat/configs/sft.yaml``); steps, batch
    and learning rate are ours.
    """
    train = _adaptation(run, learning_rate=1e-5, beta2=0.95)
    return _of_transformer(transformer, vae, noise, train, clip, dtype)


def _of_transformer(
    transformer: CosmosBackbone | DiTBackbone,
    vae: WanVAECodec | VAECodec,
    noise: EDMConfig | DDPMConfig,
    train: EgoWMTrainConfig,
    clip: tuple[int, int, int],
    dtype: Literal["float32", "bfloat16"],
) -> Config:
    """Return the settings around a transformer whose latents cover four frames each."""
    frames, height, width = clip
    return Config(
        model=EgoWM(
            clip=ClipConfig(frames=frames, height=height, width=width, depth=False),
            codec=dataclasses.replace(vae, depth=False),
            backbone=dataclasses.replace(transformer, remat=True),
            control=ModulationConfig(projection="convolution"),
            noise=noise,
            dtype=dtype,
        ),
        data=DataConfig(path="data/egowm", context=1, stride_max=1),
        train=train,
        evaluate=EvalConfig(batch=1),
    )


def _adaptation(run: str, *, learning_rate: float, beta2: float) -> EgoWMTrainConfig:
    """Return the settings of training such a transformer, without noise on the observed frame."""
    return EgoWMTrainConfig(
        run=f"runs/{run}",
        adapt=StageConfig(steps=20000, batch=8, learning_rate=learning_rate, warmup=500),
        mesh=MeshConfig(fsdp=8),
        image_noise_mean=-10.0,
        image_noise_std=0.0,
        beta2=beta2,
        ema=0.9999,
        preview_every=0,
    )
