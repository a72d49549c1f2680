"""FVD and KVD: how far imagined clips, as a set, are from true ones, seen by I3D.

The Fréchet and the kernel distance (``metrics.distributions``) between the logits of I3D
(``models.i3d``), as in Unterthiner et al. 2018. FVD falls with the number of clips even where there
is no difference at all: its floor, truth against truth at the same number, stands beside it.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from pewm_jax.eval.metrics import distributions
from pewm_jax.eval.metrics.distributions import Distance, Spread
from pewm_jax.eval.metrics.pictures import colours, marked
from pewm_jax.models.i3d import convert as i3d_weights
from pewm_jax.models.i3d import model as i3d
from pewm_jax.types import Array, Params

FRAMES = 32
"""Frames that are in the network at once, or one clip if it has more."""
NAME = "i3d"
"""The network; a distance by its published weights goes without it."""
Kind = Literal["fvd", "kvd"]
DISTANCES: Mapping[Kind, Distance] = {"fvd": distributions.frechet, "kvd": distributions.kernel}


@dataclasses.dataclass(frozen=True)
class SetScore:
    """A distance between sets of clips, and what it says where there is no difference.

    Attributes:
        value: between all imagined clips and all true ones.
        clips: how many of each.
        half: between half of the imagined clips and the truth of the others, over random halves;
            None with fewer than 4 clips.
        floor: between the truth of the one half and that of the other, over the same halves.
        half_clips: how many clips there are in a half: ``half`` is to be compared with ``floor``.
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

    Attributes:
        kind: which of them.
        params: parameters of I3D.
        sha256: hash of the file that they were read from.
        encoder: the network's name, with a mark of other weights than the package's.
    """

    kind: Kind
    params: Params = dataclasses.field(repr=False)
    sha256: str = ""
    encoder: str = NAME

    def __call__(self, imagined_BTHWC: Array, truth_BTHWC: Array) -> np.ndarray:
        """Return one number for the whole set, () float64; lower is better, 0 for equal sets.

        Args:
            imagined_BTHWC: (B, T, H, W, 3) floats in [−1, 1], or uint8; B ≥ 2, T ≥ 9.
            truth_BTHWC: the same shape.

        Raises:
            UserError: the clips are not alike, too few or too short.
        """
        colours(imagined_BTHWC, truth_BTHWC)
        return np.asarray(
            self.distance(self.features(imagined_BTHWC), self.features(truth_BTHWC)), np.float64
        )

    @property
    def distance(self) -> Distance:
        """The distance between sets of features."""
        return DISTANCES[self.kind]

    def features(self, video_BTHWC: Array) -> np.ndarray:
        """Return the features of clips, (B, 400); those of several batches can be joined.

        Args:
            video_BTHWC: (B, T, H, W, 3) floats in [−1, 1], or uint8; T ≥ 9.

        Raises:
            UserError: the clips are too short, or no colours.
        """
        i3d.require_frames(*np.shape(video_BTHWC))
        return np.asarray(_features(self.params, colours(video_BTHWC, video_BTHWC)[0]))

    def score(self, imagined_NF: np.ndarray, truth_NF: np.ndarray, seed: int = 0) -> SetScore:
        """Compare sets of features, and the truth with itself.

        Args:
            imagined_NF: ``features`` of all imagined clips.
            truth_NF: those of their truth, in the same order.
            seed: of the random halves.

        Raises:
            UserError: the sets are too small, not alike or not finite.
        """
        half = floor = None
        count = len(truth_NF)
        if count >= 4:
            half = distributions.against(self.distance, imagined_NF, truth_NF, seed=seed)
            floor = distributions.floor(self.distance, truth_NF, seed=seed)
        value = self.distance(imagined_NF, truth_NF)
        return SetScore(value, count, half, floor, count // 2)

    def name(self, frames: int, clips: int) -> str:
        """Return the name that says what the number depends on, such as ``FVD-9f@48``.

        By other weights than the package's it is ``FVD[i3d-1a2b3c4d]-9f@48``.
        """
        by = "" if self.encoder == NAME else f"[{self.encoder}]"
        return f"{self.kind.upper()}{by}-{frames}f@{clips}"

    @property
    def about(self) -> str:
        """What is measured, for the protocol."""
        how = {
            "fvd": "squared Fréchet distance",
            "kvd": "unbiased squared MMD under the kernel (xᵀy/400 + 1)³",
        }[self.kind]
        return (
            f"{how} between the 400 logits of I3D (Kinetics-400, colours), averaged over time, of "
            "clips resized to 224 × 224 (linear, antialiased); lower is better"
        )


@jax.jit
def _features(params: Params, video_BTHWC: Array) -> Array:
    """Return the logits of clips with colours in [0, 1], a bounded number of them at once."""
    at_once = max(1, FRAMES // video_BTHWC.shape[1])
    one = functools.partial(_of_one, params)
    return jax.lax.map(one, 2 * video_BTHWC - 1, batch_size=at_once)


def _of_one(params: Params, video_THWC: Array) -> Array:
    return i3d.apply(params, video_THWC[None])[0]


def read(path: Path, kind: Kind) -> VideoDistance:
    """Read FVD or KVD from a file with the weights of I3D.

    Raises:
        UserError: see ``models.i3d.convert.read``.
    """
    params = i3d_weights.read(path)
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    encoder = marked(NAME, params, i3d_weights.PUBLISHED)
    return VideoDistance(kind, jax.device_put(params), digest, encoder)
