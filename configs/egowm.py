"""EgoWM on walks through houses of 64×64 pixels, steered by (dx, dy, dyaw): hours on two cores."""

from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import ActionConfig, ClipConfig, Config, DataConfig, EvalConfig, StageConfig
from pewm_jax.controls.actions import ModulationConfig
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.models.uvit import UViTBackbone
from pewm_jax.worlds.egowm.world import EgoWM, EgoWMTrainConfig

NOISE = EDMConfig(
    sigma_data=0.5,
    log_mean=-0.3,
    log_std=1.3,
    sigma_min=0.03,
    sigma_max=20.0,
    sample_steps=4,
)
"""Noise down to low levels, so that samples are sharp; sigma_data is that of colours."""


def config() -> Config:
    """Return the settings of ``egowm``.

    Pixels are denoised by a U-ViT, without an autoencoder, whose errors would count in LPIPS. The
    observed frame conditions every frame, rendered by its depth from the camera to which the
    actions lead: the world has no memory, and what the present frame does not show has to be
    imagined. A gate blends imagined and rendered pixels; it is trained last, on imagined clips.
    LPIPS is part of the losses (``pip install 'pewm-jax[metrics]'``).
    Batches are small: many steps learn faster. Steps and turns are small, so that what is observed
    stays in view for a while. Its data: ``pewm-jax data collect data/ego --train 1600 --validation
    16 --test 48 --frames 72 --step_m 0.12 --turn_deg 10 --turn_around 0 --test_policy follow
    --ids``. Test scenes are walked, since revisits with turns of 10 degrees consist of turns on the
    spot. The report imagines two chunks, 16 frames.
    """
    return Config(
        model=EgoWM(
            clip=ClipConfig(height=64, width=64),
            codec=PixelConfig(spatial=4, temporal=1, gate=48),
            backbone=UViTBackbone(layers=6, heads=6, head_dim=32),
            actions=ActionConfig(step_m=0.12, turn_deg=10.0),
            control=ModulationConfig(units=(0.12, 0.12, 1.0)),
            noise=NOISE,
            observed="warped",
        ),
        data=DataConfig(
            path="data/ego",
            context=20,
            stride_max=1,
            prepared=3072,
            prepared_path="data/ego_prepared",
            refresh=8,
        ),
        train=EgoWMTrainConfig(
            run="runs/egowm",
            optimizer="muon",
            adapt=StageConfig(steps=2200, batch=3, learning_rate=3e-3, warmup=100),
            gate=StageConfig(steps=300, batch=4, learning_rate=1e-3, warmup=50),
            gate_lpips=2.0,
            denoised_lpips=0.3,
            denoised_lpips_weights="equal",
            ema=0.999,
            preview_every=0,
        ),
        evaluate=EvalConfig(clips=48, chain=2, seeds=(0,)),
    )
