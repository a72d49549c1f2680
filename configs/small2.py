"""The second edition of the model that ships: rooms where nothing was seen, and real recordings."""

import dataclasses

from pewm_jax.config import Config, EvalConfig, StageConfig
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.presets import demo


def config() -> Config:
    """Return the settings of the second edition of ``small``.

    ``pewm-jax data collect data/small2 --train 4000 --validation 48 --frames 72 --handheld 0.3
    --seed 7`` makes its houses. The network has the demo's size. It differs from the first edition
    in the noise (EDM, which is sampled in few steps and does not average what is unknown), in the
    observed frame, which is warped into every camera, in errors planted into the rendered memory,
    and in the number of clips: a batch is replaced every eight steps.
    """
    base = demo.config()
    noise = EDMConfig(
        sigma_data=1.0, log_mean=0.0, log_std=1.4, sigma_max=20.0, sample_steps=5
    )
    return dataclasses.replace(
        base,
        model=dataclasses.replace(base.model, observed="warped", noise=noise),
        data=dataclasses.replace(
            base.data,
            path="data/small2",
            stride_max=2,
            prepared=6144,
            prepared_path="data/small2_prepared",
            refresh=8,
        ),
        train=dataclasses.replace(
            base.train,
            run="runs/small2",
            optimizer="muon",
            noise_key="own",
            stage1=StageConfig(steps=600, batch=16, learning_rate=1e-3, warmup=50),
            stage2=StageConfig(steps=200, batch=16, learning_rate=1e-3, warmup=30),
            joint=StageConfig(steps=26000, batch=16, learning_rate=1e-3, warmup=100),
            gate=StageConfig(steps=1200, batch=4, learning_rate=1e-3, warmup=50),
            gate_lpips=2.0,
            hidden=0.15,
            chained=0.15,
            memory_errors=0.3,
            ema=0.999,
        ),
        evaluate=EvalConfig(clips=48),
    )
