"""The learned codec on procedural houses of 64×64 pixels: about an hour on two CPU cores."""

from pewm_jax.config import ClipConfig, Config, DataConfig, EvalConfig, StageConfig
from pewm_jax.worlds.codec import CodecTask, CodecTrainConfig


def config() -> Config:
    """Return the settings of the codec's training.

    Many houses teach more than many frames of one:
    ``pewm-jax data collect data/codec --train 1000 --frames 28 --validation 24 --test 8``.
    Two frames of each of 16 episodes make a step; a context of one frame, which every clip has, is
    not looked at. ``pewm-jax evaluate runs/codec`` prints the numbers on houses never trained on.
    """
    return Config(
        model=CodecTask(clip=ClipConfig(frames=2)),
        data=DataConfig(path="data/codec", stride_max=8, context=1),
        train=CodecTrainConfig(
            codec=StageConfig(steps=3000, batch=16, learning_rate=2e-3, warmup=100),
            statistics=StageConfig(steps=200, batch=32, learning_rate=0.03, warmup=0),
            ema=0.998,
            clip_norm=0.3,
        ),
        evaluate=EvalConfig(split="validation"),
    )
