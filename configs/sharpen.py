"""A sharper decoder for a trained codec (runs/codec), on the same houses: LPIPS and a GAN."""

from pewm_jax.config import ClipConfig, Config, DataConfig, EvalConfig, StageConfig
from pewm_jax.worlds.codec import CodecTask, CodecTrainConfig


def config() -> Config:
    """Return the settings that sharpen a decoder.

    The encoder stays as it is in ``runs/codec``, so a model of the same latents can use the result.
    LPIPS's weights are in the extra ``metrics``. A gate is trained after it:
    ``pewm-jax train gate --train.start runs/sharpen``.
    """
    still = StageConfig(steps=0)
    return Config(
        model=CodecTask(clip=ClipConfig(frames=2)),
        data=DataConfig(path="data/codec", stride_max=8, context=1),
        train=CodecTrainConfig(
            run="runs/sharpen",
            start="runs/codec",
            codec=still,
            statistics=still,
            gate=still,
            sharpen=StageConfig(steps=2000, batch=16, learning_rate=3e-4, warmup=50),
            ema=0.998,
        ),
        evaluate=EvalConfig(split="validation"),
    )
