"""NoMaD, a policy that proposes ways to go, on walks through procedural houses of 64×64 pixels."""

from pewm_jax.config import ClipConfig, Config, DataConfig, EvalConfig, StageConfig
from pewm_jax.models.nomad.config import NomadConfig
from pewm_jax.worlds.nomad import NomadTask, NomadTrainConfig


def config() -> Config:
    """Return the settings of the policy's training; much smaller than the published network.

    ``pewm-jax data collect data/demo --train 144 --frames 80`` makes walks for it. One step of a
    walk is one waypoint; goals are up to 16 steps away. Steps are scaled by the longest there are,
    0.25 m.
    """
    return Config(
        model=NomadTask(
            clip=ClipConfig(frames=20),
            policy=NomadConfig(
                height=64,
                width=64,
                trunk_width=0.5,
                trunk_depth=0.5,
                trunk_stages=4,
                dim=128,
                layers=2,
                channels=(32, 64, 128),
                time_dim=64,
                lowest=(-1.2, -1.2),
                highest=(1.2, 1.2),
            ),
        ),
        data=DataConfig(path="data/demo", stride_max=1, context=1),
        train=NomadTrainConfig(
            policy=StageConfig(steps=2000, batch=16, learning_rate=5e-4, warmup=100),
            weight_decay=0.01,
        ),
        evaluate=EvalConfig(split="validation"),
    )
