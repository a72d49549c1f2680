"""DreamSim as a measure of imagined frames; see ``models.dreamsim``."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path

import jax

from pewm_jax.config import UserError
from pewm_jax.eval.metrics.pictures import colours
from pewm_jax.models.dreamsim import convert as dreamsim_weights
from pewm_jax.models.dreamsim import model as dreamsim
from pewm_jax.types import Array, Params

PICTURES = 8
"""Pairs of pictures that are in the networks at once."""


@dataclasses.dataclass(frozen=True)
class DreamSim:
    """DreamSim's distance, averaged over a clip's frames; a ``Metric``, lower is better.

    Attributes:
        params: parameters of the three encoders.
        sha256: hash of them.
    """

    params: Params = dataclasses.field(repr=False)
    sha256: str = ""

    def __call__(self, imagined_BTHWC: Array, truth_BTHWC: Array) -> Array:
        """Return (B,) distances; 0 for equal clips. See ``Metric``."""
        imagined, truth = colours(imagined_BTHWC, truth_BTHWC)
        return _distances(self.params, imagined, truth)

    @property
    def about(self) -> str:
        """What is measured, for the protocol."""
        return (
            "DreamSim 0.2, the ensemble of DINO, CLIP and OpenCLIP; pictures resized to 224 × 224 "
            "(bicubic, antialiased); lower is better"
        )


@jax.jit
def _distances(params: Params, a_BTHWC: Array, b_BTHWC: Array) -> Array:
    clips, frames, *size = a_BTHWC.shape
    pairs = tuple(x.reshape(clips * frames, *size) for x in (a_BTHWC, b_BTHWC))

    def one(pair: tuple[Array, Array]) -> Array:
        a, b = (picture[None] for picture in pair)
        return dreamsim.distance(params, a, b)[0]

    return jax.lax.map(one, pairs, batch_size=PICTURES).reshape(clips, frames).mean(1)


def read(folder: str | Path | None) -> DreamSim:
    """Read DreamSim from a folder; see ``models.dreamsim.convert``.

    Raises:
        UserError: none is named, or it is absent or damaged.
    """
    if folder is None:
        raise UserError(
            "DreamSim needs weights, which come with no package: name the folder that the package "
            "dreamsim 0.2 keeps them in."
        )
    params = dreamsim_weights.read(Path(folder))
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(jax.device_get(params)):
        digest.update(leaf.tobytes())
    return DreamSim(params, digest.hexdigest())
