"""Scores and their standard errors, from sums under masks.

Clips of one scene show the same rooms, so they are not independent. Standard errors are therefore
clustered by scene (Liang & Zeger 1986; with one clip per scene this is σ / √n), or by episode if
there is only one scene. Sampling seeds are averaged within a clip first: more seeds make a clip's
score more precise but say nothing about new places.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from pewm_jax.eval.metrics.images import MASKS, PSNR_CEILING, SUMS
from pewm_jax.report.labels import own_method

METRICS = ("psnr", "ssim", "depth_mae", "depth_rel")
"""Units: dB; structural similarity; metres; share of the true depth. Under the mask ``all`` there
is also ``lpips`` if it was measured."""
ENDS = 16
"""Number of frames at the start and at the end of a long rollout that are compared to measure
drift."""
LEAST_SHARE = 0.01
"""Smallest share of pixels that a mask must cover for a clip or frame to get a score."""


def scores(sums: np.ndarray) -> dict[str, dict[str, np.ndarray]]:
    """Convert sums (..., 3, 9) of ``error_sums``, possibly summed over frames, to scores.

    ``scores[mask][metric]`` has shape (...), NaN if the mask covers too little; ``lpips`` is only
    under ``all``, and only if it was measured.
    """
    result: dict[str, dict[str, np.ndarray]] = {}
    everything = sums[..., MASKS.index("all"), SUMS.index("colours")]
    for k, mask in enumerate(MASKS):
        part = {name: sums[..., k, i].astype(np.float64) for i, name in enumerate(SUMS)}
        enough = part["colours"] >= np.maximum(LEAST_SHARE * everything, 1)

        def mean(total: str, count: str, part=part, enough=enough) -> np.ndarray:
            known = enough & (part[count] > 0)
            return np.where(known, part[total] / np.where(known, part[count], 1), np.nan)

        error = np.maximum(mean("squared", "colours"), 10 ** (-PSNR_CEILING / 10))
        result[mask] = {
            "psnr": -10 * np.log10(error),
            "ssim": mean("ssim", "windows"),
            "depth_mae": mean("depth_abs", "depths"),
            "depth_rel": mean("depth_rel", "depths"),
        }
        if part["pictures"].any():
            result[mask]["lpips"] = mean("lpips", "pictures")
    return result


def summary(values: np.ndarray, clusters: np.ndarray) -> dict[str, Any]:
    """Return the average of a value per clip, NaN if a clip has no score.

    Returns ``mean``; ``stderr``, clustered by ``clusters``, the scene (or episode) of each clip
    (None if fewer than two clusters have a value); and ``n``, the number of clips with a value.
    """
    known = np.isfinite(values)
    values, clusters = values[known], clusters[known]
    count = len(values)
    if count == 0:
        return {"mean": None, "stderr": None, "n": 0}
    mean = float(values.mean())
    groups = np.unique(clusters)
    stderr = None
    if len(groups) > 1:
        off = [float((values[clusters == group] - mean).sum()) for group in groups]
        correction = len(groups) / (len(groups) - 1)
        stderr = math.sqrt(correction * sum(total**2 for total in off)) / count
    return {"mean": mean, "stderr": stderr, "n": count}


def table(sums: Mapping[str, np.ndarray], clusters: np.ndarray) -> dict[str, Any]:
    """Return ``results[method][mask][metric] = {mean, stderr, n}``; arguments as for ``margin``."""
    results: dict[str, Any] = {}
    for method, sums_SCT39 in sums.items():
        by_mask = scores(sums_SCT39.sum(2))
        results[method] = {
            mask: {m: summary(values.mean(0), clusters) for m, values in by_mask[mask].items()}
            for mask in MASKS
        }
    return results


def margin(better: np.ndarray, base: np.ndarray, clusters: np.ndarray) -> dict[str, Any]:
    """Compare two methods on the same clips, seeds and noise.

    Args:
        better: (seeds, clips, T, 3, 9) sums of the first method.
        base: sums of the second method.
        clusters: (clips,) the scene (or episode) each clip comes from.

    Returns:
        ``[mask][metric]``: ``mean`` of first − second (for depth errors and LPIPS less is better),
        ``stderr`` over clusters, ``n`` clips, ``clusters``, ``per_seed`` means and
        ``stderr_over_seeds``.
    """
    first, second = scores(better.sum(2)), scores(base.sum(2))
    result: dict[str, Any] = {}
    for mask in MASKS:
        result[mask] = {}
        for metric in (name for name in first[mask] if name in second[mask]):
            gain_SC = first[mask][metric] - second[mask][metric]
            known = np.isfinite(gain_SC).all(0)
            per_seed = gain_SC[:, known].mean(1) if known.any() else np.zeros(0)
            spread = None
            if len(per_seed) > 1:
                spread = float(per_seed.std(ddof=1) / math.sqrt(len(per_seed)))
            result[mask][metric] = {
                **summary(gain_SC.mean(0), clusters),
                "clusters": len(np.unique(clusters[known])),
                "per_seed": [float(value) for value in per_seed],
                "stderr_over_seeds": spread,
            }
    return result


def margins(sums: Mapping[str, np.ndarray], clusters: np.ndarray) -> dict[str, Any]:
    """Compare the model itself (``own_method``) with every other method; see ``margin``."""
    own = own_method(sums)
    return {
        method: margin(sums[own], other, clusters)
        for method, other in sums.items()
        if method != own
    }


def drift(sums: Mapping[str, np.ndarray], clusters: np.ndarray) -> dict[str, Any]:
    """Return how PSNR over pixels seen before changes along long rollouts.

    ``[method]``: ``quarters``, the scores of the four quarters of the frames; and ``first16``,
    ``last16`` and ``difference``, the last 16 frames minus the first 16, paired by rollout, or None
    if a rollout has fewer than 32 frames. Each is ``{mean, stderr, n}``.
    """

    def of(sums_SCT39: np.ndarray) -> np.ndarray:
        return scores(sums_SCT39.sum(2))["seen"]["psnr"].mean(0)

    result: dict[str, Any] = {}
    for method, sums_SCT39 in sums.items():
        quarters = np.array_split(sums_SCT39, 4, axis=2)
        ends: dict[str, Any] = {"first16": None, "last16": None, "difference": None}
        if sums_SCT39.shape[2] >= 2 * ENDS:
            first, last = of(sums_SCT39[:, :, :ENDS]), of(sums_SCT39[:, :, -ENDS:])
            each = {"first16": first, "last16": last, "difference": last - first}
            ends = {name: summary(values, clusters) for name, values in each.items()}
        result[method] = {"quarters": [summary(of(part), clusters) for part in quarters], **ends}
    return result


def per_frame(sums: Mapping[str, np.ndarray], clusters: np.ndarray) -> dict[str, Any]:
    """Score every frame index separately; entry 0 is the first imagined frame.

    ``[method][mask][metric] = {mean: [T], stderr: [T], n: [T]}``, None if no clip has a score.
    """
    result: dict[str, Any] = {}
    for method, sums_SCT39 in sums.items():
        by_mask = scores(sums_SCT39)
        result[method] = {}
        for mask in MASKS:
            result[method][mask] = {}
            for metric, values_SCT in by_mask[mask].items():
                values_CT = values_SCT.mean(0)
                points = [summary(values_CT[:, t], clusters) for t in range(values_CT.shape[1])]
                result[method][mask][metric] = {
                    key: [point[key] for point in points] for key in ("mean", "stderr", "n")
                }
    return result


def seen_share(sums_SCT39: np.ndarray) -> float:
    """Return the share of pixels with depth that were seen before, over all clips."""
    pixels = sums_SCT39[0, ..., SUMS.index("colours")].sum((0, 1))
    seen, unseen = (float(pixels[MASKS.index(mask)]) for mask in ("seen", "unseen"))
    return seen / max(seen + unseen, 1.0)
