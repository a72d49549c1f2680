"""Scores from sums under masks: standard errors, intervals over houses, paired differences.

Clips of one scene (house) show the same rooms, so they are not independent. Two uncertainties are
reported, each with sampling seeds averaged within a clip first, because more seeds make a clip's
score more precise but say nothing about new places:

- *Standard errors* of the mean over clips, clustered by scene (Liang & Zeger 1986; with one clip
  per scene this is σ / √n), or by episode if there is only one scene.
- *Intervals over houses*: mean within a house first, then a bootstrap that resamples houses, each
  with all its clips (the percentile bootstrap of Efron & Tibshirani 1993, chapter 13).

Variation over training seeds is separate: it says nothing about other houses, and gets its own
interval (Student's t).
"""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from pewm_jax.eval.metrics.images import MASKS, PSNR_CEILING, SUMS
from pewm_jax.report.labels import own_method

METRICS = ("psnr", "ssim", "depth_mae", "depth_rel")
"""Units: dB; structural similarity; metres; share of the true depth. There is also ``lpips`` if it
was measured."""
ENDS = 16
"""Number of frames at the start and at the end of a long rollout that are compared to measure
drift."""
LEAST_SHARE = 0.01
"""Smallest share of pixels that a mask must cover for a clip or frame to get a score."""
DRAWS, SEED, LEVEL = 10_000, 0, 0.95
"""Number of bootstrap samples, their seed, and the confidence level."""


def scores(sums: np.ndarray) -> dict[str, dict[str, np.ndarray]]:
    """Convert sums (..., 3, 9) of ``error_sums``, possibly summed over frames, to scores.

    ``scores[mask][metric]`` has shape (...), NaN if the mask covers too little; ``lpips`` is there
    only if it was measured.
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


def map_scores(
    function: Callable[..., Any], *tables: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Apply a function to the entries ``[mask][metric]`` that all tables have."""
    return {
        mask: {
            metric: function(*(table[mask][metric] for table in tables))
            for metric in tables[0][mask]
            if all(metric in table[mask] for table in tables)
        }
        for mask in MASKS
    }


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

    def entry_of(values_SC: np.ndarray) -> dict[str, Any]:
        return summary(values_SC.mean(0), clusters)

    return {method: map_scores(entry_of, scores(each.sum(2))) for method, each in sums.items()}


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

    def entry_of(first_SC: np.ndarray, second_SC: np.ndarray) -> dict[str, Any]:
        gain_SC = first_SC - second_SC
        known = np.isfinite(gain_SC).all(0)
        per_seed = gain_SC[:, known].mean(1) if known.any() else np.zeros(0)
        spread = None
        if len(per_seed) > 1:
            spread = float(per_seed.std(ddof=1) / math.sqrt(len(per_seed)))
        return {
            **summary(gain_SC.mean(0), clusters),
            "clusters": len(np.unique(clusters[known])),
            "per_seed": [float(value) for value in per_seed],
            "stderr_over_seeds": spread,
        }

    return map_scores(entry_of, scores(better.sum(2)), scores(base.sum(2)))


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

    def entry_of(values_SCT: np.ndarray) -> dict[str, Any]:
        points = [summary(values_C, clusters) for values_C in values_SCT.mean(0).T]
        return {key: [point[key] for point in points] for key in ("mean", "stderr", "n")}

    return {method: map_scores(entry_of, scores(each)) for method, each in sums.items()}


def seen_share(sums_SCT39: np.ndarray) -> float:
    """Return the share of pixels with depth that were seen before, over all clips."""
    pixels = sums_SCT39[0, ..., SUMS.index("colours")].sum((0, 1))
    seen, unseen = (float(pixels[MASKS.index(mask)]) for mask in ("seen", "unseen"))
    return seen / max(seen + unseen, 1.0)


def interval_facts() -> dict[str, Any]:
    """Return the description of the intervals for ``metrics.json``."""
    return {
        "mean": "over houses, of the means within a house, sampling seeds averaged within a clip",
        "interval": "percentile bootstrap over houses",
        "level": LEVEL,
        "draws": DRAWS,
        "seed": SEED,
    }


def within_houses(values_CX: np.ndarray, houses_C: np.ndarray) -> np.ndarray:
    """Return the means (H, …) of each house's clips, in the order of house indices.

    ``values_CX`` has a value per clip (C, …), NaN if a clip has none; the mean is NaN if no clip of
    a house has a value.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # the mean of an empty set is NaN
        means = [np.nanmean(values_CX[houses_C == house], axis=0) for house in np.unique(houses_C)]
    return np.stack(means)


@functools.cache
def drawn(houses: int) -> np.ndarray:
    """Return the count of each house in each bootstrap sample, (draws, houses)."""
    indices = np.random.default_rng(SEED).integers(houses, size=(DRAWS, houses))
    counts = np.zeros((DRAWS, houses))
    np.add.at(counts, (np.arange(DRAWS)[:, None], indices), 1)
    return counts


def over_houses(values_CX: np.ndarray, houses_C: np.ndarray) -> dict[str, np.ndarray]:
    """Return the mean over houses and its interval.

    The bootstrap samples do not depend on the values, so intervals of methods that are scored in
    the same houses are comparable.

    Args:
        values_CX: (C, …) a value per clip; NaN if a clip has none.
        houses_C: (C,) index of each clip's house.

    Returns:
        ``mean``, ``low``, ``high`` and ``houses``, each (…): NaN if there is no value; ``low`` and
        ``high`` also if fewer than two houses have a value.
    """
    means_HX = within_houses(np.asarray(values_CX, np.float64), np.asarray(houses_C))
    shape, means_HN = means_HX.shape[1:], means_HX.reshape(len(means_HX), -1)
    known_HN = np.isfinite(means_HN)
    houses_N, filled_HN = known_HN.sum(0), np.where(known_HN, means_HN, 0)
    with np.errstate(invalid="ignore"):
        mean_N = filled_HN.sum(0) / houses_N
    sample_DN = _samples(means_HN)
    tail = (1 - LEVEL) / 2
    ends_2N = np.full((2, len(mean_N)), np.nan)
    for n in np.flatnonzero(houses_N > 1):
        sample_D = sample_DN[np.isfinite(sample_DN[:, n]), n]  # skip samples without values
        ends_2N[:, n] = np.quantile(sample_D, [tail, 1 - tail])
    found = {"mean": mean_N, "low": ends_2N[0], "high": ends_2N[1], "houses": houses_N}
    return {name: array.reshape(shape) for name, array in found.items()}


def _samples(means_HN: np.ndarray) -> np.ndarray:
    """Return the mean of each bootstrap sample of houses, (draws, N); NaN if it has no value."""
    known_HN = np.isfinite(means_HN)
    counts_DH = drawn(len(means_HN))
    with np.errstate(invalid="ignore"):
        return (counts_DH @ np.where(known_HN, means_HN, 0)) / (counts_DH @ known_HN)


def p_over_houses(values_C: np.ndarray, houses_C: np.ndarray) -> float | None:
    """Return the two-sided p value of the null hypothesis "mean = 0", from the same bootstrap.

    It is twice the smaller share of samples on one side of 0, counted as (k + 1) / (draws + 1)
    (Davison & Hinkley 1997, section 4.4), so that it is below 0.05 if the 95 % interval excludes 0.
    None if fewer than two houses have a value.
    """
    means_H = within_houses(np.asarray(values_C, np.float64), np.asarray(houses_C))
    if np.isfinite(means_H).sum() < 2:
        return None
    sample_D = _samples(means_H[:, None])[:, 0]
    sample_D = sample_D[np.isfinite(sample_D)]
    side = min(int((sample_D <= 0).sum()), int((sample_D >= 0).sum()))
    return min(1.0, 2 * (side + 1) / (len(sample_D) + 1))


def entry(values_CX: np.ndarray, houses_C: np.ndarray) -> dict[str, Any]:
    """Return ``over_houses`` for JSON: numbers, or lists if there are several; None for NaN."""
    found = over_houses(values_CX, houses_C)
    nothing = np.array(None)
    return {n: np.where(np.isfinite(array), array, nothing).tolist() for n, array in found.items()}


def entries(values: Mapping[str, np.ndarray], houses_C: np.ndarray) -> dict[str, Any]:
    """Return ``entry`` of values by name."""
    return {name: entry(values_CX, houses_C) for name, values_CX in values.items()}


def house_table(sums: Mapping[str, np.ndarray], houses_C: np.ndarray) -> dict[str, Any]:
    """Return every method's scores, and the paired differences from the model itself.

    Args:
        sums: method → (seeds, clips, T, 3, 9) as ``images.error_sums``.
        houses_C: (clips,) index of each clip's house.

    Returns:
        ``results[method][mask][metric]`` and ``margins[method][mask][metric]`` (the model minus
        that method, paired by clip) as ``entry``; ``per_frame`` and ``per_frame_margins`` likewise,
        with a list over imagined frames in place of each number.
    """
    own = own_method(sums)
    whole = {method: scores(sums_SCT39.sum(2)) for method, sums_SCT39 in sums.items()}
    frame = {method: scores(sums_SCT39) for method, sums_SCT39 in sums.items()}

    def means(values: Mapping[str, Any]) -> dict[str, Any]:
        return {m: map_scores(lambda x: entry(x.mean(0), houses_C), v) for m, v in values.items()}

    def minus(values: Mapping[str, Any]) -> dict[str, Any]:
        def gain(mine: np.ndarray, theirs: np.ndarray) -> dict[str, Any]:
            return entry(mine.mean(0) - theirs.mean(0), houses_C)

        return {m: map_scores(gain, values[own], v) for m, v in values.items() if m != own}

    return {
        "results": means(whole),
        "margins": minus(whole),
        "per_frame": means(frame),
        "per_frame_margins": minus(frame),
    }


def over_seeds(values: Sequence[float], others: Sequence[float] = ()) -> dict[str, Any]:
    """Return ``mean``, ``low`` and ``high`` over training seeds: Student's 95 % interval.

    With ``others``, the values of another model's training seeds, possibly of another number, the
    difference first − second is returned (Welch 1947, degrees of freedom rounded down). The ends
    are None unless all groups have two seeds or more.
    """
    groups = [np.asarray(group, np.float64) for group in (values, others) if len(group)]
    mean = float(groups[0].mean() - (groups[1].mean() if len(groups) > 1 else 0))
    if min(map(len, groups)) < 2:
        return {"mean": mean, "low": None, "high": None}
    squares = [float(group.var(ddof=1)) / len(group) for group in groups]
    total = sum(squares)
    if total == 0:
        return {"mean": mean, "low": mean, "high": mean}
    parts = zip(squares, groups, strict=True)
    freedom = int(total**2 / sum(s**2 / (len(group) - 1) for s, group in parts) + 1e-9)
    half = float(stats.t.ppf((1 + LEVEL) / 2, max(freedom, 1))) * math.sqrt(total)
    return {"mean": mean, "low": mean - half, "high": mean + half}


def p_over_seeds(values: Sequence[float]) -> float | None:
    """Return the two-sided p value of "mean = 0" over training seeds (one-sample t-test).

    None for fewer than two values.
    """
    if len(values) < 2:
        return None
    mean, spread = float(np.mean(values)), float(np.std(values, ddof=1))
    if spread == 0:
        return 1.0 if mean == 0 else 0.0
    statistic = abs(mean) / (spread / math.sqrt(len(values)))
    return float(2 * stats.t.sf(statistic, len(values) - 1))


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Adjust the p values of one family of comparisons by Holm's step-down method (Holm 1979).

    If the comparisons whose adjusted value is below α are called significant, the probability that
    any of them is a false positive is at most α. None entries are not counted.
    """
    known = sorted((p, k) for k, p in enumerate(p_values) if p is not None)
    adjusted: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for rank, (p, k) in enumerate(known):
        largest = max(largest, min(1.0, (len(known) - rank) * p))
        adjusted[k] = largest
    return adjusted
