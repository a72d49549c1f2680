"""EgoWM on Stable Video Diffusion: 9 frames of 512×512, steered by (dx, dy, dyaw)."""

import math

from pewm_jax.config import (
    ClipConfig,
    Config,
    DataConfig,
    EDMConfig,
    EgoWMConfig,
    EgoWMTrainConfig,
    EvalConfig,
    MeshConfig,
    StageConfig,
    SVDUNetConfig,
    SVDVAEConfig,
)


def config() -> Config:
    """Return the settings of the paper on Stable Video Diffusion (arXiv 2601.15284).

    The paper's are the size, learning rates, motion bucket, noise on the image, guidance and number
    of sampling steps; steps, batch and the share of clips without the image are ours. Training
    needs ``train.start``, a folder with the published weights; ``--plan`` needs nothing.
    """
    return Config(
        model=EgoWMConfig(
            clip=ClipConfig(height=512, width=512, depth=False),
            codec=SVDVAEConfig(),
            backbone=SVDUNetConfig(motion_bucket=180.0, remat=True),
            noise=EDMConfig(
                sigma_data=1.0,
                sigma_max=700.0,
                log_mean=0.7,
                log_std=1.6,
                target="v",
                sample_steps=25,
                guidance=2.0,
            ),
            image_noise=0.1,
            dtype="bfloat16",
        ),
        data=DataConfig(path="data/egowm", context=1, stride_max=1),
        train=EgoWMTrainConfig(
            run="runs/egowm_svd",
            fresh=(r"control/.*",),
            adapt=StageConfig(steps=20000, batch=8, learning_rate=1e-5, warmup=500),
            mesh=MeshConfig(fsdp=8),
            image_noise_mean=math.log(0.1),
            image_noise_std=0.0,
            ema=0.9999,
            preview_every=0,
        ),
        evaluate=EvalConfig(batch=1),
    )
