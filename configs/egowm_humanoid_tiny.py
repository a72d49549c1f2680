"""EgoWM on a humanoid of 25 degrees of freedom, at the size of `egowm_tiny`: minutes."""

import dataclasses

from pewm_jax.config import Config
from pewm_jax.controls.actions import ModulationConfig
from pewm_jax.presets import egowm_humanoid, egowm_tiny


def config() -> Config:
    """Return the settings of ``egowm_humanoid_tiny``.

    They are those of ``egowm_tiny`` with the data and the control of ``egowm_humanoid``. No arms
    are drawn and the observed frame is not warped, so that motion is known from actions alone.
    """
    base, humanoid = egowm_tiny.config(), egowm_humanoid.config()
    control = humanoid.model.control
    assert isinstance(control, ModulationConfig)
    return dataclasses.replace(
        base.with_model(control=dataclasses.replace(control, drawn=False)),
        data=dataclasses.replace(base.data, path=humanoid.data.path),
        train=dataclasses.replace(base.train, run="runs/egowm_humanoid_tiny"),
    )
