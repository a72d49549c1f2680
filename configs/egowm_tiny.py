"""EgoWM, steered by actions alone, without a map: houses at 64×64 pixels, minutes on two cores."""

from pewm_jax.codecs.learned import LearnedCodecConfig
from pewm_jax.config import ActionConfig, ClipConfig, Config, DataConfig, EvalConfig, StageConfig
from pewm_jax.controls.actions import ModulationConfig
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.worlds.egowm.world import EgoWM, EgoWMTrainConfig


def config() -> Config:
    """Return the settings of ``egowm_tiny``.

    The demo's codec and form of backbone. It first becomes a video model, without actions, and then
    learns to follow them. Steps and turns are small, so that what is observed stays in view for a
    while: the world has no memory. Its data: ``pewm-jax data collect data/ego_tiny --train 256
    --validation 8 --frames 64 --step_m 0.12 --turn_deg 10 --turn_around 0 --test_policy follow
    --ids``. Test scenes are walked, since revisits with turns of 10 degrees consist of turns on the
    spot.
    """
    return Config(
        model=EgoWM(
            clip=ClipConfig(height=64, width=64, depth=False),
            codec=LearnedCodecConfig(gate=48),
            backbone=DiTBackbone(layers=4, heads=4, head_dim=32),
            actions=ActionConfig(step_m=0.12, turn_deg=10.0),
            control=ModulationConfig(units=(0.25, 0.25, 1.0)),
            noise=DDPMConfig(snr_shift=4.0, max_weight=1.0, sample_steps=6),
        ),
        data=DataConfig(path="data/ego_tiny", context=20, stride_max=1, prepared=2048),
        train=EgoWMTrainConfig(
            run="runs/egowm_tiny",
            start="codec",
            fresh=(r"(backbone|control)/.*",),
            optimizer="muon",
            video=StageConfig(steps=300, batch=16, learning_rate=1e-3, warmup=30),
            adapt=StageConfig(steps=2500, batch=16, learning_rate=1e-3, warmup=30),
            ema=0.98,
            preview_every=0,
        ),
        evaluate=EvalConfig(clips=24),
    )
