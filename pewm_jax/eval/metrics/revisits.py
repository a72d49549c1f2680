"""SRC and the mirror test: does a place look the same when the agent returns?

The agent follows a path and returns the same way (``actions.there_and_back``): frames k and T − 1 −
k of a clip have the same camera. The reversed return path is compared with the way out.

- **SRC**, scene revisit consistency (Hong et al. 2024, SlowFast-VGen; PEWM, Sec. 4): the cosine
  similarity of image-encoder features, times 100. PEWM uses DINOv2 but does not specify which
  features and how they are averaged. Here it is the class token, averaged over places.
- **The mirror test** (MIND 2026): any image metric, ``mirror[psnr]``.

Consistency does not imply correctness: a model that always shows one image is perfectly consistent.
So the score of the ground truth (the ceiling) and the score of two different places (the floor) are
reported as well.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp

from pewm_jax.config import UserError
from pewm_jax.eval.metrics.images import Metric, colours, name_with_hash
from pewm_jax.io.store import file_hash
from pewm_jax.models.dinov2 import model as dinov2
from pewm_jax.models.dinov2.config import DINOv2Config, size_name
from pewm_jax.models.lpips import convert as lpips_weights
from pewm_jax.models.lpips import model as lpips
from pewm_jax.models.lpips.model import Net
from pewm_jax.types import Array, Params


@dataclasses.dataclass(frozen=True)
class RevisitScore:
    """Similarity of first and second visits.

    Attributes:
        value_B: for every imagined clip.
        ceiling_B: for its ground truth.
        floor_B: the ground truth's way out against the return path of another clip's ground truth,
            a different place.
    """

    value_B: Array
    ceiling_B: Array
    floor_B: Array

    def facts(self) -> dict[str, float]:
        """Return the means over clips, for a report."""
        return {
            field.name.removesuffix("_B"): float(jnp.mean(getattr(self, field.name)))
            for field in dataclasses.fields(self)
        }


@dataclasses.dataclass(frozen=True)
class Revisit:
    """Compares the return path with the way out by an image metric; a ``Metric``."""

    name: str
    compare: Metric

    def __call__(self, imagined_BTHWC: Array, truth_BTHWC: Array) -> Array:
        """Return the score of every imagined clip, (B,).

        The ground truth only needs the same shape: the two visits of one clip are compared. So a
        clip that does not return does not get the best score even against itself.

        Raises:
            UserError: the clips differ in shape, or have no way out and back.
        """
        colours(imagined_BTHWC, truth_BTHWC)
        out, back = ways(imagined_BTHWC)
        return self.compare(back, out)

    def score(self, imagined_BTHWC: Array, truth_BTHWC: Array) -> RevisitScore:
        """Return the scores of imagined clips with floor and ceiling.

        There must be two clips or more, of different places, frame k and T − 1 − k from one camera.

        Raises:
            UserError: the clips differ in shape, have no way out and back, or there is only one.
        """
        if len(truth_BTHWC) < 2:
            raise UserError(
                "a floor needs a second place: give at least 2 clips of different places."
            )
        value_B = self(imagined_BTHWC, truth_BTHWC)
        out, back = ways(truth_BTHWC)
        floor_B = self.compare(jnp.roll(back, 1, 0), out)
        return RevisitScore(value_B, self.compare(back, out), floor_B)


def ways(clips_BTHWC: Array) -> tuple[Array, Array]:
    """Return the way out and the reversed return path, each (B, T // 2, H, W, 3).

    Frames k and T − 1 − k of a clip have the same camera. The middle frame of an odd number of
    frames belongs to neither.

    Raises:
        UserError: there are fewer than 2 frames.
    """
    clips = jnp.asarray(clips_BTHWC)
    half = clips.shape[1] // 2
    if half < 1:
        raise UserError("a clip of one frame has no return path: give at least 2 frames.")
    return clips[:, :half], clips[:, ::-1][:, :half]


SIDE = 224
"""Height and width of DINOv2's input, pixels: the multiple of the patch size nearest to it."""
PICTURES = 16
"""Images in an encoder at once."""
SMALL = 1e-12
"""Added to the product of norms."""
ENCODERS = ("dinov2", "alex", "vgg")
_CNNS: dict[str, Net] = {"alex": "alex", "vgg": "vgg"}


@dataclasses.dataclass(frozen=True)
class Similarity:
    """Cosine similarity of image features, times 100; a ``Metric``.

    Attributes:
        encoder: its name, as used in the metric's name.
        network: the encoder: settings of a DINOv2, or a network of LPIPS.
        sha256: hash of the weights file.
    """

    encoder: str
    network: DINOv2Config | Net
    params: Params = dataclasses.field(repr=False)
    sha256: str = ""

    def __call__(self, imagined_BTHWC: Array, truth_BTHWC: Array) -> Array:
        """Return the mean over each clip's frames, (B,); 100 for equal ones. See ``Metric``."""
        imagined, truth = colours(imagined_BTHWC, truth_BTHWC)
        return cosine(self.features(imagined), self.features(truth)).mean(1)

    def features(self, clips_BTHWC: Array) -> Array:
        """Return the features (B, T, F) of every frame of clips with colours in [0, 1].

        Raises:
            UserError: the images are too small for the encoder.
        """
        if not isinstance(self.network, DINOv2Config):
            lpips.require_size(self.network, *clips_BTHWC.shape[2:4])
        return _features(self.network, self.params, clips_BTHWC)

    @property
    def about(self) -> str:
        """Return a description for the protocol."""
        if isinstance(self.network, DINOv2Config):
            network = self.network
            what = (
                f"the class token of DINOv2 ({network.layers} layers of width {network.width}), "
                f"images resized to {SIDE} × {SIDE}"
            )
        else:
            name = lpips.NAMES[self.network]
            what = f"the last layer of LPIPS's {name}, averaged over positions, images not resized"
        return f"cosine × 100 between features: {what}"


def cosine(a_XF: Array, b_XF: Array) -> Array:
    """Return the cosine similarity of vectors (..., F), times 100; 0 where a vector is 0."""
    lengths = jnp.linalg.norm(a_XF, axis=-1) * jnp.linalg.norm(b_XF, axis=-1)
    return 100 * (a_XF * b_XF).sum(-1) / (lengths + SMALL)


@functools.partial(jax.jit, static_argnums=0)
def _features(network: DINOv2Config | Net, params: Params, clips_BTHWC: Array) -> Array:
    """Encode colours in [0, 1], a bounded number of images at once."""
    clips, frames, *size = clips_BTHWC.shape

    def one(picture_HWC: Array) -> Array:
        picture = 2 * picture_HWC[None] - 1
        if isinstance(network, DINOv2Config):
            side = max(1, round(SIDE / network.patch)) * network.patch
            images = dinov2.preprocess(picture, side, network.patch)
            return dinov2.summary(network, params, images)[0]
        return lpips.features(network, params, picture)[-1].mean((1, 2))[0]

    pictures = clips_BTHWC.reshape(clips * frames, *size)
    return jax.lax.map(one, pictures, batch_size=PICTURES).reshape(clips, frames, -1)


def read_encoder(encoder: str, path: str | Path | None = None) -> Similarity:
    """Read one of ``ENCODERS``.

    ``path`` is for DINOv2 a folder made by ``pewm-jax convert import dinov2``; for the others a
    file as for LPIPS, by default the installed package's.

    Raises:
        UserError: there is no such encoder, or its weights are missing or damaged.
    """
    if encoder in _CNNS:
        file = lpips_weights.find(_CNNS[encoder], path)
        net, params = lpips_weights.read(file, _CNNS[encoder])
        name = name_with_hash(net, params, lpips_weights.PUBLISHED[net])
        return Similarity(name, net, jax.device_put(params), file_hash(file))
    if encoder != "dinov2":
        raise UserError(f"there is no encoder {encoder!r}; choose one of {', '.join(ENCODERS)}.")
    if path is None:
        raise UserError(
            "DINOv2 needs weights, which ship with no package: give a folder made by `pewm-jax "
            "convert import dinov2`, or use the encoder alex or vgg."
        )
    network, params = dinov2.load(Path(path))
    params = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), params)
    return Similarity(
        f"dinov2-{size_name(network)}",
        network,
        params,
        file_hash(Path(path) / "weights.safetensors"),
    )
