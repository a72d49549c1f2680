"""Means over houses with 95 % intervals: mean within a house first, then a bootstrap over houses.

Clips of one house show the same rooms, so houses are resampled, each with all its clips (the
percentile bootstrap of Efron & Tibshirani 1993, chapter 13). Variation over training seeds is
separate: it says nothing about other houses, and gets its own interval (Student's t).
"""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from pewm_jax.eval.metrics.images import MASKS
from pewm_jax.eval.statistics import scores
from pewm_jax.report.labels import own_method

DRAWS, SEED, LEVEL = 10_000, 0, 0.95
"""Number of bootstrap samples, their seed, and the confidence level."""


def how() -> dict[str, Any]:
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


def entry(values_CX: np.ndarray, houses_C: np.ndarray) -> dict[str, Any]:
    """Return ``over_houses`` for JSON: numbers, or lists if there are several; None for NaN."""
    found = over_houses(values_CX, houses_C)
    nothing = np.array(None)
    return {n: np.where(np.isfinite(array), array, nothing).tolist() for n, array in found.items()}


def table(sums: Mapping[str, np.ndarray], houses_C: np.ndarray) -> dict[str, Any]:
    """Return every method's scores, and the paired differences from the model itself.

    Args:
        sums: method → (seeds, clips, T, 3, 9) as ``images.error_sums``.
        houses_C: (clips,) index of each clip's house.

    Returns:
        ``results[method][mask][metric]`` and ``margins[method][mask][metric]`` (the model minus
        that method, paired by clip) as ``entry``; ``per_frame`` and ``per_frame_margins`` likewise,
        with a list over imagined frames in place of each number.
    """
    whole = {method: scores(sums_SCT39.sum(2)) for method, sums_SCT39 in sums.items()}
    frame = {method: scores(sums_SCT39) for method, sums_SCT39 in sums.items()}
    return {
        "results": _each(whole, houses_C),
        "margins": _each(_minus(whole), houses_C),
        "per_frame": _each(frame, houses_C),
        "per_frame_margins": _each(_minus(frame), houses_C),
    }


def _minus(by_method: Mapping[str, Any]) -> dict[str, Any]:
    """Subtract every other method's scores from the model's, averaged over sampling seeds."""
    own = own_method(by_method)
    mine = by_method[own]
    return {
        method: {
            mask: {
                metric: mine[mask][metric].mean(0)[None] - values.mean(0)[None]
                for metric, values in by_mask[mask].items()
                if metric in mine[mask]
            }
            for mask in MASKS
        }
        for method, by_mask in by_method.items()
        if method != own
    }


def _each(by_method: Mapping[str, Any], houses_C: np.ndarray) -> dict[str, Any]:
    return {
        method: {
            mask: {
                metric: entry(values.mean(0), houses_C) for metric, values in by_mask[mask].items()
            }
            for mask in MASKS
        }
        for method, by_mask in by_method.items()
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
