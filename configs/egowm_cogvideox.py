"""EgoWM on CogVideoX-5b-I2V: 17 frames of 480×720, steered by (dx, dy, dyaw)."""

import dataclasses

from pewm_jax.config import Config
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.cogvideox.vae import VAECodec
from pewm_jax.worlds.egowm import paper as egowm_paper


def config() -> Config:
    """Return the method of the paper on CogVideoX, which the paper does not use.

    Training needs ``train.start``: converted weights (``pewm-jax convert import cogvideox SRC DST
    --actions``; then ``pewm-jax train DST`` has these settings too). ``--plan`` needs nothing. The
    network's table of learned positions is for 49 frames; it is interpolated to 17.
    """
    transformer = DiTBackbone.published("5b-I2V")
    return egowm_paper.cogvideox_experiment(
        dataclasses.replace(transformer, learned="interpolate", prompt="stored"),
        VAECodec.published("5b-I2V"),
        run="egowm_cogvideox",
    )
