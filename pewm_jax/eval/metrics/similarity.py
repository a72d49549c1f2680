"""How alike pictures are by the features of an image encoder: the cosine between them, times 100.

The encoder's name is part of the measure's: numbers by different encoders cannot be compared.

============ =====================================================================================
dinov2       the class token of a DINOv2 after its last norm; pictures resized to 224 × 224; its
             size is part of the name, such as ``dinov2-small`` or ``dinov2-base-registers``
alex, vgg    the last layer of LPIPS's AlexNet or VGG16, averaged over places; not resized; by
             other weights than the package's with a mark of them, such as ``alex-1a2b3c4d``
============ =====================================================================================
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from pathlib import Path

import jax
import jax.numpy as jnp

from pewm_jax.config import UserError
from pewm_jax.eval.metrics.pictures import colours, marked
from pewm_jax.models.dinov2 import model as dinov2
from pewm_jax.models.dinov2.config import DINOv2Config, size_name
from pewm_jax.models.lpips import convert as lpips_weights
from pewm_jax.models.lpips import model as lpips
from pewm_jax.models.lpips.model import Net
from pewm_jax.types import Array, Params

SIDE = 224
"""Pixels, height and width, of what DINOv2 is given."""
PICTURES = 16
"""Pictures that are in an encoder at once."""
SMALL = 1e-12
"""Added to the product of lengths."""
ENCODERS = ("dinov2", "alex", "vgg")
_CNNS: dict[str, Net] = {"alex": "alex", "vgg": "vgg"}


@dataclasses.dataclass(frozen=True)
class Similarity:
    """The cosine between features of pictures, times 100; a ``Metric``.

    Attributes:
        encoder: its name, as it stands in the measure's.
        network: what the encoder is: settings of a DINOv2, or a network of LPIPS.
        params: its parameters.
        sha256: hash of the file that they were read from.
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
        """Return the features of every frame, (B, T, F).

        Args:
            clips_BTHWC: (B, T, H, W, 3) colours in [0, 1].

        Raises:
            UserError: the pictures are too small for the encoder.
        """
        if not isinstance(self.network, DINOv2Config):
            lpips.require_size(self.network, *clips_BTHWC.shape[2:4])
        return _features(self.network, self.params, clips_BTHWC)

    @property
    def about(self) -> str:
        """What is measured, for the protocol."""
        if isinstance(self.network, DINOv2Config):
            network = self.network
            what = (
                f"the class token of DINOv2 ({network.layers} layers of width {network.width}), "
                f"pictures resized to {SIDE} × {SIDE}"
            )
        else:
            name = lpips.NAMES[self.network]
            what = f"the last layer of LPIPS's {name}, averaged over places, pictures not resized"
        return f"cosine × 100 between features: {what}"


def cosine(a_XF: Array, b_XF: Array) -> Array:
    """Return the cosine between vectors, times 100, (...,); 0 where a vector is 0.

    Args:
        a_XF: (..., F).
        b_XF: the same shape.
    """
    lengths = jnp.linalg.norm(a_XF, axis=-1) * jnp.linalg.norm(b_XF, axis=-1)
    return 100 * (a_XF * b_XF).sum(-1) / (lengths + SMALL)


@functools.partial(jax.jit, static_argnums=0)
def _features(network: DINOv2Config | Net, params: Params, clips_BTHWC: Array) -> Array:
    """Encode colours in [0, 1], a bounded number of pictures at once."""
    clips, frames, *size = clips_BTHWC.shape

    def one(picture_HWC: Array) -> Array:
        picture = 2 * picture_HWC[None] - 1
        if isinstance(network, DINOv2Config):
            images = dinov2.preprocess(picture, _side(network), network.patch)
            return dinov2.summary(network, params, images)[0]
        return lpips.features(network, params, picture)[-1].mean((1, 2))[0]

    pictures = clips_BTHWC.reshape(clips * frames, *size)
    return jax.lax.map(one, pictures, batch_size=PICTURES).reshape(clips, frames, -1)


def _side(network: DINOv2Config) -> int:
    """Return the multiple of the patch that is nearest to 224."""
    return max(1, round(SIDE / network.patch)) * network.patch


def read(encoder: str, path: str | Path | None = None) -> Similarity:
    """Read an encoder.

    Args:
        encoder: one of ``ENCODERS``.
        path: of DINOv2 a folder made by ``python -m pewm_jax.convert import dinov2``; of the others
            a file as of LPIPS, by default the installed package's.

    Raises:
        UserError: there is no such encoder, or its weights are absent or damaged.
    """
    if encoder in _CNNS:
        file = lpips_weights.find(_CNNS[encoder], path)
        net, params = lpips_weights.read(file, _CNNS[encoder])
        name = marked(net, params, lpips_weights.PUBLISHED[net])
        return Similarity(name, net, jax.device_put(params), _hash(file))
    if encoder != "dinov2":
        raise UserError(f"there is no encoder {encoder!r}; there is {', '.join(ENCODERS)}.")
    if path is None:
        raise UserError(
            "DINOv2 needs weights, which come with no package: name a folder made by `python -m "
            "pewm_jax.convert import dinov2`, or take the encoder alex or vgg under its own name."
        )
    network, params = dinov2.load(Path(path))
    params = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), params)
    return Similarity(
        f"dinov2-{size_name(network)}", network, params, _hash(Path(path) / "weights.safetensors")
    )


def _hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
