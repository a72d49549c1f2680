"""LPIPS and DreamSim of clips: per frame, with a bounded number of images at once."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from pewm_jax.config import UserError
from pewm_jax.eval.metrics.images import colours, name_with_hash
from pewm_jax.io.store import file_hash
from pewm_jax.models.dreamsim import convert as dreamsim_weights
from pewm_jax.models.dreamsim import model as dreamsim
from pewm_jax.models.lpips import convert as lpips_weights
from pewm_jax.models.lpips import model as lpips
from pewm_jax.models.lpips.model import LEAST, NAMES, Net
from pewm_jax.types import Array, Params

PIXELS = 2**17
"""Pixels of imagined images in the network at once, or one image if it has more."""
KEPT = 2**28
"""Bytes of ground-truth features that are cached; if there are more, they are recomputed each
time."""
OFF = "off"
"""The setting that disables LPIPS."""
PACKAGED: dict[str, Net] = {"alex": "alex", "vgg": "vgg"}
"""The settings that select a network in the installed package."""


@dataclasses.dataclass(frozen=True)
class LPIPS:
    """LPIPS with its weights; a ``Metric``.

    ``sha256`` is the hash of the weights file; ``encoder`` the network's name, with a hash for
    weights other than the package's (``alex-1a2b3c4d``).
    """

    net: Net
    params: Params = dataclasses.field(repr=False)
    sha256: str = ""
    encoder: str = ""

    def __call__(self, imagined_BTHWC: Array, truth_BTHWC: Array) -> Array:
        """Return the mean over each clip's frames, (B,); see ``Metric``."""
        return self.frames(imagined_BTHWC, truth_BTHWC).mean(1)

    def frames(self, imagined_BTHWC: Array, truth_BTHWC: Array) -> Array:
        """Return the distance of every frame, (B, T); arguments as of ``Metric``.

        Raises:
            UserError: the clips differ in shape, or are too small for the network.
        """
        imagined, truth = colours(imagined_BTHWC, truth_BTHWC)
        lpips.require_size(self.net, *imagined.shape[2:4])
        return _distances(self.net, self.params, imagined, truth)

    def in_masks(self, imagined_BTHWC: Array, truth_BTHWC: Array, masks_BTKHW: Array) -> Array:
        """Return the sums over the pixels of K masks of every frame, (B, T, K).

        Divided by the pixels of its mask, a sum is the distance within the mask; see
        ``lpips.sums_in_masks``. Errors are those of ``frames``.
        """
        return self.towards(truth_BTHWC).in_masks(imagined_BTHWC, masks_BTKHW)

    def towards(self, truth_BTHWC: Array) -> Towards:
        """Return ``frames`` with a fixed ground truth, which passes through the network only once.

        ``imagined_BTHWC -> distances (B, T)`` raises the same errors as ``frames``.
        """
        made = jax.eval_shape(self.described, truth_BTHWC)
        large = sum(x.size * x.dtype.itemsize for x in made) > KEPT
        return Towards(self, truth_BTHWC, None if large else self.described(truth_BTHWC))

    def described(self, truth_BTHWC: Array) -> tuple[Array, ...]:
        """Return ``lpips.describe`` of all images of clips."""
        truth, _ = colours(truth_BTHWC, truth_BTHWC)
        lpips.require_size(self.net, *truth.shape[2:4])
        return _describe(self.net, self.params, truth)

    @property
    def about(self) -> str:
        """Return a description for the protocol."""
        return (
            f"version 0.1 with {NAMES[self.net]}, of colours in [−1, 1], whole images, not "
            "resized, averaged over a clip's frames; over pixels seen before or never seen, the "
            "mean of its map over them; lower is better"
        )


@dataclasses.dataclass(frozen=True)
class Towards:
    """LPIPS with a fixed ground truth; ``described`` are its features, None if they are large."""

    metric: LPIPS
    truth_BTHWC: Array = dataclasses.field(repr=False)
    described: tuple[Array, ...] | None = dataclasses.field(repr=False)

    def __call__(self, imagined_BTHWC: Array) -> Array:
        """Return ``LPIPS.frames``."""
        if self.described is None:
            return self.metric.frames(imagined_BTHWC, self.truth_BTHWC)
        imagined, _ = colours(imagined_BTHWC, self.truth_BTHWC)
        return _distances_to_features(self.metric.net, self.metric.params, imagined, self.described)

    def in_masks(self, imagined_BTHWC: Array, masks_BTKHW: Array) -> Array:
        """Return ``LPIPS.in_masks``."""
        imagined, truth = colours(imagined_BTHWC, self.truth_BTHWC)
        net, params = self.metric.net, self.metric.params
        lpips.require_size(net, *imagined.shape[2:4])
        if self.described is None:
            return _sums_in_masks(net, params, imagined, truth, masks_BTKHW)
        return _sums_to_features(net, params, imagined, self.described, masks_BTKHW)


@functools.partial(jax.jit, static_argnums=0)
def _distances(net: Net, params: Params, imagined_BTHWC: Array, truth_BTHWC: Array) -> Array:
    """Compare colours in [0, 1], frame by frame."""

    def one(pair: tuple[Array, Array]) -> Array:
        return lpips.apply(net, params, pair[0][None], pair[1][None])[0]

    found = _map_images(one, (_signals(imagined_BTHWC), _signals(truth_BTHWC)))
    return found.reshape(imagined_BTHWC.shape[:2])


@functools.partial(jax.jit, static_argnums=0)
def _describe(net: Net, params: Params, truth_BTHWC: Array) -> tuple[Array, ...]:
    """Return the features of colours in [0, 1]; the image axis comes first."""

    def one(images: tuple[Array]) -> tuple[Array, ...]:
        return tuple(x[0] for x in lpips.describe(net, params, images[0][None]))

    return _map_images(one, (_signals(truth_BTHWC),))


@functools.partial(jax.jit, static_argnums=0)
def _distances_to_features(
    net: Net, params: Params, imagined_BTHWC: Array, truth: tuple[Array, ...]
) -> Array:
    """Compare colours in [0, 1] with precomputed features."""

    def one(pair: tuple[Array, tuple[Array, ...]]) -> Array:
        mine = lpips.describe(net, params, pair[0][None])
        return lpips.distance(params, mine, [x[None] for x in pair[1]])[0]

    return _map_images(one, (_signals(imagined_BTHWC), truth)).reshape(imagined_BTHWC.shape[:2])


@functools.partial(jax.jit, static_argnums=0)
def _sums_to_features(
    net: Net, params: Params, imagined_BTHWC: Array, truth: tuple[Array, ...], masks_BTKHW: Array
) -> Array:
    """Sum the map of distances from precomputed features under masks."""

    def one(parts: tuple[Array, tuple[Array, ...], Array]) -> Array:
        picture, described, masks_KHW = parts
        mine = lpips.describe(net, params, picture[None])
        theirs = [x[None] for x in described]
        return lpips.sums_in_masks(params, mine, theirs, masks_KHW[None])[0]

    masks = masks_BTKHW.reshape(-1, *masks_BTKHW.shape[2:])
    found = _map_images(one, (_signals(imagined_BTHWC), truth, masks))
    return found.reshape(masks_BTKHW.shape[:3])


@functools.partial(jax.jit, static_argnums=0)
def _sums_in_masks(
    net: Net, params: Params, imagined_BTHWC: Array, truth_BTHWC: Array, masks_BTKHW: Array
) -> Array:
    """Sum the map of distances of colours in [0, 1] under masks, frame by frame."""

    def one(parts: tuple[Array, Array, Array]) -> Array:
        imagined, truth, masks_KHW = parts
        a, b = (lpips.describe(net, params, picture[None]) for picture in (imagined, truth))
        return lpips.sums_in_masks(params, a, b, masks_KHW[None])[0]

    masks = masks_BTKHW.reshape(-1, *masks_BTKHW.shape[2:])
    found = _map_images(one, (_signals(imagined_BTHWC), _signals(truth_BTHWC), masks))
    return found.reshape(masks_BTKHW.shape[:3])


def _signals(clips_BTHWC: Array) -> Array:
    """Return the images of clips with colours in [0, 1] as signals in [−1, 1], (B T, H, W, 3)."""
    return 2 * clips_BTHWC.reshape(-1, *clips_BTHWC.shape[2:]) - 1


def _map_images(function: Callable[[Any], Any], images: tuple[Any, ...]) -> Any:
    """Apply a function to images and what belongs to them, a bounded number at once."""
    at_once = max(1, PIXELS // (images[0].shape[1] * images[0].shape[2]))
    return jax.lax.map(function, images, batch_size=at_once)


def read_lpips(path: Path, net: Net | None = None) -> LPIPS:
    """Read LPIPS from a file of weights; see ``models.lpips.convert.read``."""
    found, params = lpips_weights.read(path, net)
    name = name_with_hash(found, params, lpips_weights.PUBLISHED[found])
    return LPIPS(found, jax.device_put(params), file_hash(path), name)


def select_lpips(setting: str, height: int, width: int) -> tuple[LPIPS | None, str]:
    """Return the LPIPS that ``evaluate.lpips`` selects, and a description or the reason for None.

    Raises:
        UserError: explicitly requested weights are missing, damaged, or unsuitable for images of
            ``height`` × ``width`` pixels.
    """
    if setting == OFF:
        return None, "LPIPS is not measured (evaluate.lpips)."
    if setting:
        net = PACKAGED.get(setting)
        metric = read_lpips(lpips_weights.find(net) if net else Path(setting), net)
        lpips.require_size(metric.net, height, width)
        return metric, metric.about
    path = lpips_weights.installed("alex")
    if path is None:
        return None, (
            f"LPIPS is not measured, because no weights are installed: {lpips_weights.INSTALL}, or "
            "give a weights file by --lpips."
        )
    if min(height, width) < LEAST["alex"]:
        return None, (
            f"LPIPS is not measured: {NAMES['alex']} needs images of at least {LEAST['alex']} "
            f"pixels per side and these have {width} × {height}; --lpips vgg accepts smaller ones."
        )
    metric = read_lpips(path, "alex")
    return metric, metric.about


PICTURES = 8
"""Pairs of images in the networks of DreamSim at once."""


@dataclasses.dataclass(frozen=True)
class DreamSim:
    """DreamSim's distance, averaged over a clip's frames; a ``Metric``, lower is better."""

    params: Params = dataclasses.field(repr=False)
    sha256: str = ""

    def __call__(self, imagined_BTHWC: Array, truth_BTHWC: Array) -> Array:
        """Return (B,) distances; 0 for equal clips. See ``Metric``."""
        imagined, truth = colours(imagined_BTHWC, truth_BTHWC)
        return _dreamsim_distances(self.params, imagined, truth)

    @property
    def about(self) -> str:
        """Return a description for the protocol."""
        return (
            "DreamSim 0.2, the ensemble of DINO, CLIP and OpenCLIP; images resized to 224 × 224 "
            "(bicubic, antialiased); lower is better"
        )


@jax.jit
def _dreamsim_distances(params: Params, a_BTHWC: Array, b_BTHWC: Array) -> Array:
    clips, frames, *size = a_BTHWC.shape
    pairs = tuple(x.reshape(clips * frames, *size) for x in (a_BTHWC, b_BTHWC))

    def one(pair: tuple[Array, Array]) -> Array:
        a, b = (picture[None] for picture in pair)
        return dreamsim.distance(params, a, b)[0]

    return jax.lax.map(one, pairs, batch_size=PICTURES).reshape(clips, frames).mean(1)


def read_dreamsim(folder: str | Path | None) -> DreamSim:
    """Read DreamSim from a folder; see ``models.dreamsim.convert``.

    Raises:
        UserError: no folder is given, or it is missing or damaged.
    """
    if folder is None:
        raise UserError(
            "DreamSim needs weights, which ship with no package: give the folder in which the "
            "package dreamsim 0.2 stores them."
        )
    params = dreamsim_weights.read(Path(folder))
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(jax.device_get(params)):
        digest.update(leaf.tobytes())
    return DreamSim(params, digest.hexdigest())
