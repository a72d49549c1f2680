"""How far apart two sets of feature vectors are, as sets; and how far equal ones seem to be.

The Fréchet distance is biased: two sets of n vectors of one distribution are apart by what depends
on n. ``floor`` measures that. The kernel distance has no such bias. In float64, on the host.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from pewm_jax.config import UserError

SPLITS = 10
"""Random halves that a floor is averaged over."""
Distance = Callable[[np.ndarray, np.ndarray], float]
"""Compares two sets (N, F) of features."""


def frechet(a_NF: np.ndarray, b_MF: np.ndarray) -> float:
    """Return the squared Fréchet distance between Gaussians fitted to two sets; 0 for equal ones.

    |μa − μb|² + tr Σa + tr Σb − 2 tr (Σa Σb)^½, covariances over n − 1 (Dowson and Landau 1982;
    Heusel et al. 2017, Eq. 6). With Σ = RᵀR, R of the QR decomposition of the centred vectors, the
    last trace is the sum of the singular values of Ra Rbᵀ: no root of a matrix is taken, and sets
    smaller than F are no special case.

    Args:
        a_NF: N ≥ 2 vectors.
        b_MF: M ≥ 2 vectors.

    Raises:
        UserError: the sets are too small, of different widths, or not finite.
    """
    a, b = _sets(a_NF, b_MF)
    roots = [_root(x) for x in (a, b)]
    apart = np.square(a.mean(0) - b.mean(0)).sum()
    spread = sum(np.square(root).sum() for root in roots)
    shared = np.linalg.svd(roots[0] @ roots[1].T, compute_uv=False).sum()
    return float(max(apart + spread - 2 * shared, 0))


def kernel(a_NF: np.ndarray, b_NF: np.ndarray) -> float:
    """Return the squared maximum mean discrepancy under a cubic kernel; 0 for equal sets.

    The kernel is (xᵀy / F + 1)³ (Bińkowski et al. 2018). The estimate leaves out every pair of a
    vector with itself and with its partner of the same number (Gretton et al. 2012, Eq. 4), so that
    it has no bias also where partners belong together, as an imagined clip and its truth do. It may
    be negative.

    Args:
        a_NF: N ≥ 2 vectors.
        b_NF: as many.

    Raises:
        UserError: the sets are too small, of different sizes or widths, or not finite.
    """
    a, b = _sets(a_NF, b_NF)
    if len(a) != len(b):
        raise UserError(
            f"sets of {len(a)} and {len(b)} vectors have no kernel distance: give as many of both."
        )
    inside = _cubic(a, a) + _cubic(b, b)
    across = _cubic(a, b)
    pairs = inside - across - across.T
    return float((pairs.sum() - np.trace(pairs)) / (len(a) * (len(a) - 1)))


def _cubic(a_NF: np.ndarray, b_MF: np.ndarray) -> np.ndarray:
    return (a_NF @ b_MF.T / a_NF.shape[1] + 1) ** 3


@dataclasses.dataclass(frozen=True)
class Spread:
    """A mean over random splits, and its standard deviation over them."""

    mean: float
    std: float


def floor(
    distance: Distance,
    truth_NF: np.ndarray,
    n: int | None = None,
    *,
    splits: int = SPLITS,
    seed: int = 0,
) -> Spread:
    """Return what a distance says of two sets of n true clips that have no clip in common.

    Args:
        distance: ``frechet`` or ``kernel``.
        truth_NF: features of true clips.
        n: vectors in each set; by default half of them.
        splits: how often sets are drawn.
        seed: of the drawing.

    Raises:
        UserError: there are fewer than 2 n vectors, or n is below 2.
    """
    return against(distance, truth_NF, truth_NF, n, splits=splits, seed=seed)


def against(
    distance: Distance,
    imagined_NF: np.ndarray,
    truth_NF: np.ndarray,
    n: int | None = None,
    *,
    splits: int = SPLITS,
    seed: int = 0,
) -> Spread:
    """Return what a distance says of n imagined clips against the truth of n others.

    With the arguments of ``floor`` the same clips are drawn, so that the two can be compared.

    Args:
        distance: ``frechet`` or ``kernel``.
        imagined_NF: features of imagined clips.
        truth_NF: of their truth, in the same order.
        n: vectors in each set; by default half of them.
        splits: how often sets are drawn.
        seed: of the drawing.

    Raises:
        UserError: see ``floor``.
    """
    count = len(truth_NF)
    n = count // 2 if n is None else n
    if len(imagined_NF) != count:
        raise UserError(f"{len(imagined_NF)} imagined and {count} true clips are not partners.")
    if n < 2 or 2 * n > count:
        raise UserError(
            f"two sets of {n} clips cannot be drawn from {count}: each needs at least 2, and none "
            "in common."
        )
    rng, found = np.random.default_rng(seed), []
    for _ in range(splits):
        order = rng.permutation(count)
        found.append(distance(imagined_NF[order[:n]], truth_NF[order[n : 2 * n]]))
    return Spread(float(np.mean(found)), float(np.std(found)))


def _root(x_NF: np.ndarray) -> np.ndarray:
    """Return R, (K, F), of which RᵀR is the covariance."""
    scaled = (x_NF - x_NF.mean(0)) / np.sqrt(len(x_NF) - 1)
    return np.asarray(np.linalg.qr(scaled, mode="r"))


def _sets(a_NF: np.ndarray, b_MF: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return both sets in float64.

    Raises:
        UserError: they are no sets that can be compared.
    """
    a, b = (np.asarray(x, np.float64) for x in (a_NF, b_MF))
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[1]:
        raise UserError(
            f"features of shapes {a.shape} and {b.shape} cannot be compared: give (N, F) of one F."
        )
    if min(len(a), len(b)) < 2:
        raise UserError(
            f"sets of {len(a)} and {len(b)} clips have no spread: give at least 2 of each."
        )
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise UserError("features that are not finite cannot be compared: look at the clips.")
    return a, b
