"""EgoWM on Cosmos-Predict2-2B: 17 frames of 480×640, steered by (dx, dy, dyaw)."""

from pewm_jax.config import Config
from pewm_jax.models.cosmos.backbone import COSMOS_2B
from pewm_jax.models.wan.vae import WanVAECodec
from pewm_jax.worlds.egowm import paper as egowm_paper


def config() -> Config:
    """Return the settings of the paper on Cosmos-Predict2.

    Training needs ``train.start``: converted weights (``pewm-jax convert import cosmos2 SRC DST``;
    then ``pewm-jax train DST`` has these settings too). ``--plan`` needs nothing.
    """
    return egowm_paper.cosmos_experiment(COSMOS_2B, WanVAECodec(), run="egowm_cosmos2b")
