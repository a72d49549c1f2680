"""The gate of a trained codec (runs/codec), on the same houses: minutes on two CPU cores."""

from pewm_jax.codecs.learned import LearnedCodecConfig
from pewm_jax.config import ClipConfig, Config, DataConfig, EvalConfig, StageConfig
from pewm_jax.worlds.codec import CodecTask, CodecTrainConfig


def config() -> Config:
    """Return the settings of the gate's training.

    Everything but the gate comes from ``runs/codec``. Clips are short, so that of what they show
    some was seen in the context and some was not.
    """
    still = StageConfig(steps=0)
    return Config(
        model=CodecTask(clip=ClipConfig(frames=5), codec=LearnedCodecConfig(gate=48)),
        data=DataConfig(path="data/codec", stride_max=3, context=12),
        train=CodecTrainConfig(
            run="runs/gate",
            start="runs/codec",
            fresh=(r"codec/gate/.*",),
            codec=still,
            statistics=still,
            gate=StageConfig(steps=500, batch=12, learning_rate=2e-3, warmup=30),
            ema=0.99,
        ),
        evaluate=EvalConfig(split="validation"),
    )
