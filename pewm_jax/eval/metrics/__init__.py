"""Measures of imagined frames against true ones, by name.

    metric = metrics.load("lpips_alex")
    each_B = metric(imagined_BTHWC, truth_BTHWC)

Every metric takes clips of one shape, colours as floats in [−1, 1] (what exceeds that is clipped)
or uint8, and returns one number per clip, whatever else is in the batch; ``fvd`` and ``kvd`` return
one per set.

================ ====== ===========================================================================
psnr             higher decibels, of the mean squared error of all pixels of a clip; at most 100
ssim             higher structural similarity, 11 × 11 Gaussian windows, averaged over a clip
lpips_alex       lower  LPIPS with AlexNet, averaged over a clip's frames; pictures are not resized
lpips_vgg        lower  LPIPS with VGG16, the same
depth_mae        lower  mean error of depth, m; it takes depths (B, T, H, W) in the place of colours
depth_rel        lower  the same, divided by the true depth
dreamsim         lower  DreamSim (0.2, ensemble), averaged over a clip's frames
fvd              lower  Fréchet distance of the 400 logits of I3D; 9 frames or more; with its floor
kvd              lower  kernel distance of the same: no bias by the number of clips; may be negative
src              higher clips that go and come back: cosine × 100 of DINOv2's features of both
                        visits of a place, of the imagined clip alone (of the truth only the shape
                        counts); with its floor and ceiling
src[alex]        higher the same with LPIPS's AlexNet for an encoder; and src[vgg]
mirror[METRIC]   as     clips that go and come back: the way back against the way out by ``psnr``,
                 METRIC ``ssim``, ``lpips_alex`` or ``lpips_vgg``; with its floor and ceiling
================ ====== ===========================================================================

Errors over seen and over unseen pixels are in ``evaluation.images.error_sums``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from pewm_jax.config import UserError
from pewm_jax.eval.metrics import dreams, similarity, videos
from pewm_jax.eval.metrics.dreams import DreamSim
from pewm_jax.eval.metrics.perceptual import Perceptual
from pewm_jax.eval.metrics.perceptual import read as read_lpips
from pewm_jax.eval.metrics.pictures import DEPTHS, PLAIN, Metric
from pewm_jax.eval.metrics.revisits import Revisit, RevisitScore
from pewm_jax.eval.metrics.similarity import Similarity
from pewm_jax.eval.metrics.videos import SetScore, VideoDistance
from pewm_jax.models.i3d import convert as i3d_weights
from pewm_jax.models.lpips import convert as lpips_weights
from pewm_jax.models.lpips.model import Net

__all__ = [
    "NAMES",
    "DreamSim",
    "Metric",
    "Perceptual",
    "Revisit",
    "RevisitScore",
    "SetScore",
    "Similarity",
    "VideoDistance",
    "load",
    "load_all",
]

_NETS: dict[str, Net] = {"lpips_alex": "alex", "lpips_vgg": "vgg"}
_ENCODERS = {"src": "dinov2", "src[alex]": "alex", "src[vgg]": "vgg"}
_PICTURES = (*PLAIN, *_NETS)
_COLOURS = (
    *_PICTURES,
    "dreamsim",
    *videos.DISTANCES,
    *_ENCODERS,
    *(f"mirror[{name}]" for name in _PICTURES),
)
NAMES = (*_COLOURS, *DEPTHS)
_MIRROR = re.compile(r"mirror\[(.+)\]")


def load(name: str, weights: str | Path | None = None) -> Metric:
    """Return a metric.

    Args:
        name: one of ``NAMES``.
        weights: a file of weights for a metric that is a network (``models.lpips_weights`` and
            ``models.i3d.convert`` say of which kinds; for ``src`` a folder of DINOv2); by default
            those of the installed package.

    Raises:
        UserError: there is no such metric, it takes no weights, or it needs some and has none.
    """
    if weights is not None and not str(weights):
        raise UserError(f"the weights of {name} are named by no letters: name a file, or leave it.")
    if name not in NAMES:
        raise UserError(f"there is no metric {name!r}; there is {', '.join(NAMES)}.")
    mirrored = _MIRROR.fullmatch(name)
    if mirrored:
        inside = load(mirrored[1], weights)
        lpips = isinstance(inside, Perceptual)
        return Revisit(f"mirror[lpips_{inside.encoder}]" if lpips else name, inside)
    if name in _ENCODERS:
        compare = similarity.read(_ENCODERS[name], weights)
        return Revisit(f"src[{compare.encoder}]", compare)
    if name == "dreamsim":
        return dreams.read(weights)
    if name in _NETS:
        return read_lpips(lpips_weights.find(_NETS[name], weights), _NETS[name])
    for kind in videos.DISTANCES:
        if name == kind:
            return videos.read(i3d_weights.find(weights), kind)
    if weights is not None:
        raise UserError(f"the metric {name} is no network and takes no weights, got {weights}.")
    return (PLAIN | DEPTHS)[name]


def load_all(
    names: Iterable[str] = _COLOURS, weights: Mapping[str, str | Path] | None = None
) -> tuple[dict[str, Metric], dict[str, str]]:
    """Return the metrics whose weights are at hand, and why the others are left out.

    Args:
        names: some of ``NAMES``; by default all that take colours.
        weights: metric → file or folder of weights.

    Returns:
        ``(found, left_out)``: name → metric, and name → the reason, a sentence.

    Raises:
        UserError: there is no such metric, or weights that are named are absent or damaged, or of
            no metric that is asked for.
    """
    names = tuple(names)
    strange = sorted(set(weights or {}) - set(names))
    if strange:
        raise UserError(f"weights are named of {', '.join(strange)}, which are not asked for.")
    found: dict[str, Metric] = {}
    left_out: dict[str, str] = {}
    for name in names:
        given = (weights or {}).get(name)
        try:
            found[name] = load(name, given)
        except UserError as error:
            if given is not None or name not in NAMES:
                raise
            left_out[name] = f"{name} is left out: {error}"
    return found, left_out
