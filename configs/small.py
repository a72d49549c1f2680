"""The model that ships: the demo's, trained for hours on many houses of 64×64 pixels."""

import dataclasses

from pewm_jax.config import Config, EvalConfig, StageConfig
from pewm_jax.presets import demo


def config() -> Config:
    """Return the settings of ``small``.

    ``pewm-jax data collect data/small --train 512 --frames 72`` makes its houses. Its size is the
    demo's. Muon needs about two thirds of Adam's steps. In a third stage the backbone learns on
    with the memory, in a fourth the gate learns on what the model imagines, with LPIPS in its
    loss (``pip install 'pewm-jax[metrics]'``); neither is the paper's. Prepared clips are kept on
    disk, so that training can be spread over as many sittings as it takes. The weights that come
    with the library were trained in several runs; their card says how.
    """
    base = demo.config()
    noise = dataclasses.replace(base.model.noise, sample_steps=2)
    return dataclasses.replace(
        base,
        model=dataclasses.replace(base.model, noise=noise),
        data=dataclasses.replace(
            base.data,
            path="data/small",
            stride_max=2,
            prepared=6144,
            prepared_path="data/small_prepared",
        ),
        train=dataclasses.replace(
            base.train,
            run="runs/small",
            optimizer="muon",
            stage1=StageConfig(steps=700, batch=16, learning_rate=1e-3, warmup=50),
            stage2=StageConfig(steps=200, batch=16, learning_rate=1e-3, warmup=30),
            joint=StageConfig(steps=4400, batch=16, learning_rate=1e-3, warmup=50),
            gate=StageConfig(steps=1200, batch=4, learning_rate=1e-3, warmup=50),
            gate_lpips=2.0,
            hidden=0.1,
            chained=0.15,
            ema=0.995,
        ),
        evaluate=EvalConfig(clips=48),
    )
