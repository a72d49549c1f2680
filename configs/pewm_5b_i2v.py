"""The same on CogVideoX-5b-I2V, its learned positions interpolated from 49 × 480 × 720."""

import dataclasses

from pewm_jax.config import Config
from pewm_jax.presets import pewm_2b


def config() -> Config:
    """Return the settings of ``pewm_5b`` on the image-to-video model.

    Its table of learned positions is for 49 frames of 480 × 720; ``--positions interpolate`` at
    import makes the same choice as here.
    """
    settings = pewm_2b.on("5b-I2V")
    backbone = dataclasses.replace(settings.model.backbone, learned="interpolate")
    return settings.with_model(backbone=backbone)
