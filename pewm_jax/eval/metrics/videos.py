"""FVD and KVD: distances between the sets of imagined and of true clips in I3D's feature space.

The Fréchet and the kernel distance between the logits of I3D (``models.i3d``), as in Unterthiner et
al. 2018. The Fréchet distance is biased: two sets of n vectors of one distribution differ by an
amount that depends on n. Its floor, ground truth against ground truth at the same number of clips,
is reported with it. The kernel distance is unbiased. Both are computed in float64 on the host.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from pewm_jax.config import UserError
from pewm_jax.eval.metrics.images import colours, name_with_hash
from pewm_jax.io.store import file_hash
from pewm_jax.models.i3d import convert as i3d_weights
from pewm_jax.models.i3d import model as i3d
from pewm_jax.types import Array, Params

SPLITS = 10
"""Number of random halves over which a floor is averaged."""
Distance = Callable[[np.ndarray, np.ndarray], float]
"""A distance between two sets (N, F) of features."""


def frechet(a_NF: np.ndarray, b_MF: np.ndarray) -> float:
    """Return the squared Fréchet distance between Gaussians fitted to two sets; 0 for equal ones.

    |μa − μb|² + tr Σa + tr Σb − 2 tr (Σa Σb)^½, covariances over n − 1 (Dowson and Landau 1982;
    Heusel et al. 2017, Eq. 6). With Σ = RᵀR, R of the QR decomposition of the centred vectors, the
    last trace is the sum of the singular values of Ra Rbᵀ: no matrix root is needed, and sets with
    fewer than F vectors need no special case.

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

    The kernel is (xᵀy / F + 1)³ (Bińkowski et al. 2018). The estimate excludes every pair of a
    vector with itself and with its partner of the same index (Gretton et al. 2012, Eq. 4), so it is
    unbiased even if partners are dependent, as an imagined clip and its ground truth are. It may be
    negative.

    Raises:
        UserError: the sets are too small, of different sizes or widths, or not finite.
    """
    a, b = _sets(a_NF, b_NF)
    if len(a) != len(b):
        raise UserError(
            f"sets of {len(a)} and {len(b)} vectors have no kernel distance: give sets of equal "
            "size."
        )
    own_a, own_b, across = ((x @ y.T / a.shape[1] + 1) ** 3 for x, y in ((a, a), (b, b), (a, b)))
    pairs = own_a + own_b - across - across.T
    return float((pairs.sum() - np.trace(pairs)) / (len(a) * (len(a) - 1)))


@dataclasses.dataclass(frozen=True)
class Spread:
    """A mean over random splits, and its standard deviation over them."""

    mean: float
    std: float


def distance_floor(
    distance: Distance, truth_NF: np.ndarray, n: int | None = None, **draws: int
) -> Spread:
    """Return ``distance_of_halves`` of true clips: a distance between two disjoint sets of them."""
    return distance_of_halves(distance, truth_NF, truth_NF, n, **draws)


def distance_of_halves(
    distance: Distance,
    imagined_NF: np.ndarray,
    truth_NF: np.ndarray,
    n: int | None = None,
    *,
    splits: int = SPLITS,
    seed: int = 0,
) -> Spread:
    """Return a distance of n imagined clips from the ground truth of n others.

    It is averaged over ``splits`` random draws; n is by default half of the clips. With equal
    arguments the same clips are drawn as in ``distance_floor``, so that the two can be compared.

    Raises:
        UserError: there are fewer than 2 n vectors, n is below 2, or the two are not pairs.
    """
    count = len(truth_NF)
    n = count // 2 if n is None else n
    if len(imagined_NF) != count:
        raise UserError(f"{len(imagined_NF)} imagined and {count} true clips are not pairs.")
    if n < 2 or 2 * n > count:
        raise UserError(
            f"two sets of {n} clips cannot be drawn from {count}: each needs at least 2 clips, and "
            "none in common."
        )
    rng, found = np.random.default_rng(seed), []
    for _ in range(splits):
        order = rng.permutation(count)
        found.append(distance(imagined_NF[order[:n]], truth_NF[order[n : 2 * n]]))
    return Spread(float(np.mean(found)), float(np.std(found)))


def _root(x_NF: np.ndarray) -> np.ndarray:
    """Return R, (K, F), such that RᵀR is the covariance."""
    scaled = (x_NF - x_NF.mean(0)) / np.sqrt(len(x_NF) - 1)
    return np.asarray(np.linalg.qr(scaled, mode="r"))


def _sets(a_NF: np.ndarray, b_MF: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return both sets in float64, or raise a ``UserError`` if they cannot be compared."""
    a, b = (np.asarray(x, np.float64) for x in (a_NF, b_MF))
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[1]:
        raise UserError(
            f"features of shapes {a.shape} and {b.shape} cannot be compared: give (N, F) of one F."
        )
    if min(len(a), len(b)) < 2:
        raise UserError(
            f"sets of {len(a)} and {len(b)} clips have no covariance: give at least 2 of each."
        )
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise UserError("features that are not finite cannot be compared: check the clips.")
    return a, b


FRAMES = 32
"""Frames in the network at once, or one clip if it has more."""
NAME = "i3d"
"""Name of the network; names of distances with its published weights omit it."""
Kind = Literal["fvd", "kvd"]
DISTANCES: Mapping[Kind, Distance] = {"fvd": frechet, "kvd": kernel}


@dataclasses.dataclass(frozen=True)
class SetScore:
    """A distance between sets of clips, with its floor.

    Attributes:
        value: between all imagined clips and all true ones.
        half: between half of the imagined clips and the ground truth of the others, over random
            halves; None with fewer than 4 clips.
        floor: between the ground truth of the two halves, over the same halves.
        half_clips: number of clips in a half; compare ``half`` with ``floor``.
    """

    value: float
    clips: int
    half: Spread | None
    floor: Spread | None
    half_clips: int

    def facts(self) -> dict[str, Any]:
        """Return plain values, for a report."""
        return dataclasses.asdict(self)


@dataclasses.dataclass(frozen=True)
class VideoDistance:
    """FVD or KVD with the weights of I3D.

    ``sha256`` is the hash of the weights file; ``encoder`` the network's name, with a hash for
    weights other than the package's.
    """

    kind: Kind
    params: Params = dataclasses.field(repr=False)
    sha256: str = ""
    encoder: str = NAME

    def __call__(self, imagined_BTHWC: Array, truth_BTHWC: Array) -> np.ndarray:
        """Return one value for the whole set, () float64; lower is better, 0 for equal sets.

        Both are (B, T, H, W, 3) floats in [−1, 1], or uint8; B ≥ 2, T ≥ 9.

        Raises:
            UserError: the clips differ in shape, or are too few or too short.
        """
        colours(imagined_BTHWC, truth_BTHWC)
        return np.asarray(
            self.distance(self.features(imagined_BTHWC), self.features(truth_BTHWC)), np.float64
        )

    def kinds(self) -> dict[Kind, VideoDistance]:
        """Return FVD and KVD with the same weights."""
        return {kind: dataclasses.replace(self, kind=kind) for kind in DISTANCES}

    @property
    def distance(self) -> Distance:
        """Return the distance between sets of features."""
        return DISTANCES[self.kind]

    def features(self, video_BTHWC: Array) -> np.ndarray:
        """Return the features of clips, (B, 400); those of several batches can be joined.

        Raises:
            UserError: the clips are too short, or not colours.
        """
        i3d.require_frames(*np.shape(video_BTHWC))
        return np.asarray(_features(self.params, colours(video_BTHWC, video_BTHWC)[0]))

    def score(self, imagined_NF: np.ndarray, truth_NF: np.ndarray, seed: int = 0) -> SetScore:
        """Return the distance between the features of all imagined clips and of their ground truth.

        ``seed`` is that of the random halves.

        Raises:
            UserError: the sets are too small, of different shapes, or not finite.
        """
        half = floor = None
        count = len(truth_NF)
        if count >= 4:
            half = distance_of_halves(self.distance, imagined_NF, truth_NF, seed=seed)
            floor = distance_floor(self.distance, truth_NF, seed=seed)
        value = self.distance(imagined_NF, truth_NF)
        return SetScore(value, count, half, floor, count // 2)

    def name(self, frames: int, clips: int) -> str:
        """Return the name including frames and clips, such as ``FVD-9f@48``.

        With other weights than the package's it is ``FVD[i3d-1a2b3c4d]-9f@48``.
        """
        by = "" if self.encoder == NAME else f"[{self.encoder}]"
        return f"{self.kind.upper()}{by}-{frames}f@{clips}"

    @property
    def about(self) -> str:
        """Return a description for the protocol."""
        how = {
            "fvd": "squared Fréchet distance",
            "kvd": "unbiased squared MMD under the kernel (xᵀy/400 + 1)³",
        }[self.kind]
        return (
            f"{how} between the 400 logits of I3D (Kinetics-400, colours), averaged over time, of "
            "clips resized to 224 × 224 (linear, antialiased); over pixels "
            "seen before or never seen, of clips that show the truth elsewhere; lower is better"
        )


@jax.jit
def _features(params: Params, video_BTHWC: Array) -> Array:
    """Return the logits of clips with colours in [0, 1], a bounded number of them at once."""
    at_once = max(1, FRAMES // video_BTHWC.shape[1])
    return jax.lax.map(
        lambda video_THWC: i3d.apply(params, video_THWC[None])[0],
        2 * video_BTHWC - 1,
        batch_size=at_once,
    )


def read_i3d(path: Path, kind: Kind) -> VideoDistance:
    """Read FVD or KVD from the weights of I3D; see ``models.i3d.convert.read``."""
    params = i3d_weights.read(path)
    encoder = name_with_hash(NAME, params, i3d_weights.PUBLISHED)
    return VideoDistance(kind, jax.device_put(params), file_hash(path), encoder)
