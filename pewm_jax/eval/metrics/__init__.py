"""Metrics of imagined frames against ground truth, and the registry of their names.

    metric = metrics.load("lpips_alex")
    each_B = metric(imagined_BTHWC, truth_BTHWC)

Every metric takes clips of one shape, colours as uint8 or as floats in [−1, 1] (values outside are
clipped), and returns one number per clip, independent of the rest of the batch; ``fvd`` and ``kvd``
return one per set.

================ ====== ===========================================================================
psnr             higher dB, of the mean squared error of all pixels of a clip; at most 100
ssim             higher structural similarity, 11 × 11 Gaussian windows, averaged over a clip
lpips_alex       lower  LPIPS with AlexNet, averaged over a clip's frames; images are not resized
lpips_vgg        lower  LPIPS with VGG16, likewise
depth_mae        lower  mean error of depth, m; it takes depths (B, T, H, W) instead of colours
depth_rel        lower  likewise, divided by the true depth
dreamsim         lower  DreamSim (0.2, ensemble), averaged over a clip's frames
fvd              lower  Fréchet distance of the 400 logits of I3D; 9 frames or more; with its floor
kvd              lower  kernel distance of the same; no bias by the number of clips; may be below 0
src              higher clips that go out and return: cosine × 100 of DINOv2 features of both visits
                        of a place, in the imagined clip only (of the ground truth only the shape is
                        used); with its floor and ceiling
src[alex]        higher the same with LPIPS's AlexNet as the encoder; and src[vgg]
mirror[METRIC]   as     clips that go out and return: the way back against the way out by ``psnr``,
                 METRIC ``ssim``, ``lpips_alex`` or ``lpips_vgg``; with its floor and ceiling
================ ====== ===========================================================================

Modules: ``images`` (PSNR, SSIM, depth, and errors over seen and unseen pixels, ``error_sums``),
``perceptual`` (LPIPS, DreamSim), ``videos`` (FVD, KVD), ``revisits`` (SRC, the mirror test),
``structure`` (SCS). ``selection`` selects those of a report.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TypeAlias

from pewm_jax.config import UserError
from pewm_jax.eval.metrics.images import DEPTHS, PLAIN, Metric
from pewm_jax.eval.metrics.perceptual import LPIPS, DreamSim, read_dreamsim, read_lpips
from pewm_jax.eval.metrics.revisits import Revisit, RevisitScore, Similarity, read_encoder
from pewm_jax.eval.metrics.videos import DISTANCES, SetScore, VideoDistance, read_i3d
from pewm_jax.models.i3d import convert as i3d_weights
from pewm_jax.models.lpips import convert as lpips_weights
from pewm_jax.models.lpips.model import Net

__all__ = [
    "LPIPS",
    "NAMES",
    "DreamSim",
    "Metric",
    "Revisit",
    "RevisitScore",
    "SetScore",
    "Similarity",
    "VideoDistance",
    "load",
    "load_all",
]

Weights: TypeAlias = str | Path | None
"""A file or folder of weights, or None for the weights in the installed package."""


def _lpips(net: Net) -> Callable[[Weights], Metric]:
    return lambda weights: read_lpips(lpips_weights.find(net, weights), net)


def _src(encoder: str) -> Callable[[Weights], Metric]:
    def read(weights: Weights) -> Metric:
        compare = read_encoder(encoder, weights)
        return Revisit(f"src[{compare.encoder}]", compare)

    return read


def _mirror(name: str) -> Callable[[Weights], Metric]:
    def read(weights: Weights) -> Metric:
        compare = load(name, weights)
        inside = f"lpips_{compare.encoder}" if isinstance(compare, LPIPS) else name
        return Revisit(f"mirror[{inside}]", compare)

    return read


_NETWORKS: dict[str, Callable[[Weights], Metric]] = {
    "lpips_alex": _lpips("alex"),
    "lpips_vgg": _lpips("vgg"),
    "dreamsim": read_dreamsim,
    **{
        kind: lambda weights, kind=kind: read_i3d(i3d_weights.find(weights), kind)
        for kind in DISTANCES
    },
    "src": _src("dinov2"),
    "src[alex]": _src("alex"),
    "src[vgg]": _src("vgg"),
}
_MIRRORS = {f"mirror[{name}]": _mirror(name) for name in (*PLAIN, "lpips_alex", "lpips_vgg")}
_COLOURS = (*PLAIN, *_NETWORKS, *_MIRRORS)
NAMES = (*_COLOURS, *DEPTHS)
"""The names of all metrics."""


def load(name: str, weights: Weights = None) -> Metric:
    """Return a metric.

    Args:
        name: one of ``NAMES``.
        weights: a file of weights for a metric that is a network (``models.lpips.convert`` and
            ``models.i3d.convert`` list the formats; for ``src`` a folder of DINOv2); by default the
            weights in the installed package.

    Raises:
        UserError: there is no such metric, it takes no weights, or it needs weights and has none.
    """
    if weights is not None and not str(weights):
        raise UserError(f"the name of the weights of {name} is empty: give a file, or omit it.")
    if name not in NAMES:
        raise UserError(f"there is no metric {name!r}; choose one of {', '.join(NAMES)}.")
    reader = _NETWORKS.get(name) or _MIRRORS.get(name)
    if reader is not None:
        return reader(weights)
    if weights is not None:
        raise UserError(f"the metric {name} is not a network and takes no weights, got {weights}.")
    return (PLAIN | DEPTHS)[name]


def load_all(
    names: Iterable[str] = _COLOURS, weights: Mapping[str, str | Path] | None = None
) -> tuple[dict[str, Metric], dict[str, str]]:
    """Return the metrics by name, and the reasons, as sentences, why others are skipped.

    A metric without available weights is skipped, unless they are given in ``weights``: metric →
    file or folder.

    Raises:
        UserError: there is no such metric, or weights are missing, damaged, or given for a metric
            that is not requested.
    """
    names = tuple(names)
    unused = sorted(set(weights or {}) - set(names))
    if unused:
        raise UserError(f"weights are given for {', '.join(unused)}, which are not requested.")
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
