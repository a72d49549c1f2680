"""EgoWM on a humanoid of 25 degrees of freedom, which sees its own arms: hours on two cores."""

import dataclasses

from pewm_jax.bodies.humanoid import HUMANOID
from pewm_jax.config import Config
from pewm_jax.controls.actions import ModulationConfig
from pewm_jax.presets import egowm
from pewm_jax.worlds.egowm.world import EgoWMTrainConfig


def config() -> Config:
    """Return the settings of ``egowm_humanoid``.

    They are those of ``egowm``, whose shipped weights training starts from, with another control:
    actions are the angles of the joints at the next frame with the linear and the angular velocity,
    and the initial state is a further input (Eq. 6). The observed frame is rendered from the
    camera on the body's head, which follows from its joints, without the pixels of the body itself.
    The bones of its arms are drawn into further input channels (``control.drawn``). Its data:
    ``pewm-jax data collect data/humanoid --body humanoid --train 1200 --validation 16 --test 48
    --frames 72 --step_m 0.12 --turn_deg 10 --turn_around 0 --test_policy follow --ids``.
    """
    base, size = egowm.config(), HUMANOID.size
    assert isinstance(base.train, EgoWMTrainConfig)
    control = ModulationConfig(
        actions=size,
        state=size,
        units=(1.0,) * size,
        low=tuple(HUMANOID.low.tolist()),
        high=tuple(HUMANOID.high.tolist()),
        angles=(),
        body="humanoid",
        drawn=True,
    )
    return dataclasses.replace(
        base,
        model=dataclasses.replace(base.model, control=control, own_m=0.55),
        data=dataclasses.replace(
            base.data, path="data/humanoid", prepared_path="data/humanoid_prepared"
        ),
        train=dataclasses.replace(
            base.train,
            run="runs/egowm_humanoid",
            start="egowm",
            fresh=("control/.*",),
            wider=("backbone/into/kernel",),
            adapt=dataclasses.replace(base.train.adapt, steps=1200),
        ),
    )
