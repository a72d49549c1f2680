"""EgoWM on Stable Video Diffusion: 9 frames of 512×512, steered by (dx, dy, dyaw)."""

from pewm_jax.config import Config
from pewm_jax.models.svd.unet import SVDUNetBackbone
from pewm_jax.models.svd.vae import SVDVAECodec
from pewm_jax.worlds.egowm import paper as egowm_paper


def config() -> Config:
    """Return the settings of the paper on Stable Video Diffusion.

    Training needs ``train.start``: converted weights (``pewm-jax convert import svd SRC DST``; then
    ``pewm-jax train DST`` has these settings too). ``--plan`` needs nothing.
    """
    return egowm_paper.experiment(SVDUNetBackbone(), SVDVAECodec(), run="egowm_svd")
