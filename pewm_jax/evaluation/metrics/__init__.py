"""Measures of imagined frames against true ones, by name.

    metric = metrics.load("lpips_alex")
    each_B = metric(imagined_BTHWC, truth_BTHWC)

Every metric takes clips of one shape, colours as floats in [−1, 1] (what exceeds that is clipped)
or uint8, and returns one number per clip, whatever else is in the batch.

============ ======= ==============================================================================
psnr         higher  decibels, of the mean squared error of all pixels of a clip; at most 100
ssim         higher  structural similarity, 11 × 11 Gaussian windows, averaged over a clip
lpips_alex   lower   LPIPS with AlexNet, averaged over a clip's frames; pictures are not resized
lpips_vgg    lower   LPIPS with VGG16, the same
============ ======= ==============================================================================
"""

from __future__ import annotations

from pathlib import Path

from pewm_jax.config import UserError
from pewm_jax.evaluation.metrics.perceptual import Perceptual
from pewm_jax.evaluation.metrics.perceptual import read as read_lpips
from pewm_jax.evaluation.metrics.pictures import PLAIN, Metric
from pewm_jax.models import lpips_weights
from pewm_jax.models.lpips import Net

__all__ = ["NAMES", "Metric", "Perceptual", "load"]

_NETS: dict[str, Net] = {"lpips_alex": "alex", "lpips_vgg": "vgg"}
NAMES = (*PLAIN, *_NETS)


def load(name: str, weights: str | Path | None = None) -> Metric:
    """Return a metric.

    Args:
        name: one of ``NAMES``.
        weights: a file of weights for a metric that is a network (``models.lpips_weights`` says of
            which kinds); by default those of the installed package.

    Raises:
        UserError: there is no such metric, it takes no weights, or it needs some and has none.
    """
    if name in _NETS:
        return read_lpips(lpips_weights.find(_NETS[name], weights), _NETS[name])
    if name not in PLAIN:
        raise UserError(f"there is no metric {name!r}; there is {', '.join(NAMES)}.")
    if weights is not None:
        raise UserError(f"the metric {name} is no network and takes no weights, got {weights}.")
    return PLAIN[name]
