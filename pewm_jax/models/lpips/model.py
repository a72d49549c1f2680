"""LPIPS, a learned distance between pictures (Zhang et al. 2018, version 0.1).

Both pictures go through a network trained on ImageNet, AlexNet (``alex``) or VGG16 (``vgg``), up to
five layers. The features at each position are normalised to length 1; the squared differences,
weighted per channel, are averaged over positions and summed over the layers. Pictures are in [−1,
1] and are **not resized**: distances at 64 × 64 and at 256 × 256 pixels are different measures. The
reference is ``lpips/lpips.py`` and ``pretrained_networks.py`` of richzhang/PerceptualSimilarity.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.io import tree
from pewm_jax.types import Array, Params

Net = Literal["alex", "vgg"]
SHIFT = np.array([-0.030, -0.088, -0.188], np.float32)
"""Subtracted from the colours of a picture in [−1, 1]."""
SCALE = np.array([0.458, 0.448, 0.450], np.float32)
"""Divides the shifted colours."""
SMALL = 1e-10
"""Added to the length of a feature."""


@dataclasses.dataclass(frozen=True)
class Layers:
    """Convolutions with a ReLU each; the last one's output is compared.

    Attributes:
        widths: channels out of each convolution.
        side: pixels of each kernel, each way.
        stride: pixels between the positions of each kernel.
        pad: zeros around the picture.
        pool: pixels each way of the maximum that is taken before, every two pixels; 0 for none.
    """

    widths: tuple[int, ...]
    side: int = 3
    stride: int = 1
    pad: int = 1
    pool: int = 0


NETS: dict[Net, tuple[Layers, ...]] = {
    "alex": (
        Layers((64,), side=11, stride=4, pad=2),
        Layers((192,), side=5, pad=2, pool=3),
        Layers((384,), pool=3),
        Layers((256,)),
        Layers((256,)),
    ),
    "vgg": (
        Layers((64, 64)),
        Layers((128, 128), pool=2),
        Layers((256, 256, 256), pool=2),
        Layers((512, 512, 512), pool=2),
        Layers((512, 512, 512), pool=2),
    ),
}
"""The networks, from the picture on."""
NAMES: dict[Net, str] = {"alex": "AlexNet", "vgg": "VGG16"}
LEAST: dict[Net, int] = {"alex": 31, "vgg": 16}
"""The smallest height and width, in pixels, for which the last layer has an output."""


def shapes(net: Net) -> dict[str, tuple[int, ...]]:
    """Return the shape of every parameter by its path.

    ``net/conv_i/kernel`` is (side, side, channels in, channels out), ``net/conv_i/bias`` (channels
    out,), and ``lin/layer_k`` (channels,), the weights of the k-th compared layer.
    """
    found: dict[str, tuple[int, ...]] = {}
    number, inward = 0, 3
    for k, layers in enumerate(NETS[net]):
        for width in layers.widths:
            found[f"net/conv_{number}/kernel"] = (layers.side, layers.side, inward, width)
            found[f"net/conv_{number}/bias"] = (width,)
            number, inward = number + 1, width
        found[f"lin/layer_{k}"] = (inward,)
    return found


def init(net: Net, key: Array) -> Params:
    """Return random parameters: an untrained distance, for tests."""
    drawn = {}
    for number, (path, shape) in enumerate(shapes(net).items()):
        x = jax.random.normal(jax.random.fold_in(key, number), shape)
        if path.endswith("kernel"):
            drawn[path] = x * np.sqrt(2 / np.prod(shape[:-1]))
        else:
            drawn[path] = 0.1 * x if path.endswith("bias") else jnp.abs(x)
    return tree.unflatten(drawn)


def apply(net: Net, params: Params, a_NHWC: Array, b_NHWC: Array) -> Array:
    """Return the distance of each pair of pictures in [−1, 1], (N,) float32; 0 for equal ones.

    It can be differentiated: where all features of a position are 0, so is the gradient.

    Raises:
        UserError: the pictures are smaller than the network takes, or of different shapes.
    """
    a, b = jnp.asarray(a_NHWC), jnp.asarray(b_NHWC)
    if a.shape != b.shape or a.ndim != 4 or a.shape[-1] != 3:
        raise UserError(
            f"pictures of shapes {a.shape} and {b.shape} cannot be compared by LPIPS: give both as "
            "(N, H, W, 3)."
        )
    require_size(net, *a.shape[1:3])
    both = describe(net, params, jnp.concatenate([a, b]))
    one, other = zip(*(jnp.split(x, 2) for x in both), strict=True)
    return distance(params, one, other)


def describe(net: Net, params: Params, x_NHWC: Array) -> tuple[Array, ...]:
    """Return the layers' features (N, h, w, C), of length 1 at each position, float32.

    The pictures are in [−1, 1] and at least as large as ``require_size`` requires.
    """
    found = features(net, params, jnp.asarray(x_NHWC).astype(jnp.float32))
    return tuple(_of_length_one(x) for x in found)


def distance(params: Params, a: Sequence[Array], b: Sequence[Array]) -> Array:
    """Return the distances of described pictures, (N,); one of the two may have a batch of 1."""
    total = jnp.zeros(())
    for apart in _maps(params, a, b):
        total = total + apart.mean((1, 2))
    return total


def sums_in_masks(
    params: Params, a: Sequence[Array], b: Sequence[Array], masks_NKHW: Array
) -> Array:
    """Return the sums, over the pixels of masks, of the map of distances of described pictures.

    The map is the sum of the layers' distances, each enlarged to the picture: a position of a layer
    covers an equal part of it, h × w positions H/h × W/w pixels each. So the mean over all pixels
    is ``distance``, and a sum divided by the mask's pixels is the distance within the mask. The
    features of a position see pixels outside the mask, too.

    Args:
        params: the network's parameters.
        a: descriptions of N pictures; see ``describe``.
        b: of N or of 1.
        masks_NKHW: K masks of each picture, bool or numbers.

    Returns:
        (N, K) float32.
    """
    masks = masks_NKHW.astype(jnp.float32)
    total = jnp.zeros(masks.shape[:2])
    for apart in _maps(params, a, b):
        rows, columns = (
            jnp.asarray(_shares(few, many))
            for few, many in zip(apart.shape[1:], masks.shape[2:], strict=True)
        )
        parts = (rows, masks, columns, apart)
        total = total + jnp.einsum("hH,nkHW,wW,nhw->nk", *parts, precision="highest")
    return total


def _maps(params: Params, a: Sequence[Array], b: Sequence[Array]) -> Iterator[Array]:
    """Yield the distances of each layer's positions, (N, h, w)."""
    for k, (one, other) in enumerate(zip(a, b, strict=True)):
        weights_C = params["lin"][f"layer_{k}"].astype(jnp.float32)
        yield (jnp.square(one - other) * weights_C).sum(-1)


def _shares(few: int, many: int) -> np.ndarray:
    """Return which share of each of ``many`` pixels lies in each of ``few`` equal parts of them."""
    ends = np.arange(few + 1) * (many / few)
    pixels = np.arange(many)
    left = np.maximum(ends[:-1, None], pixels)
    return np.maximum(np.minimum(ends[1:, None], pixels + 1) - left, 0).astype(np.float32)


def require_size(net: Net, height: int, width: int) -> None:
    """Refuse pictures that are too small for a network."""
    least = LEAST[net]
    if min(height, width) < least:
        better = "; use VGG16." * (min(height, width) >= LEAST["vgg"])
        raise UserError(
            f"pictures of {height}×{width} pixels are too small for LPIPS with {NAMES[net]}, which "
            f"needs at least {least}×{least}{better}"
        )


def features(net: Net, params: Params, x_NHWC: Array) -> list[Array]:
    """Return the outputs of the five layers for pictures in [−1, 1]."""
    x, number, found = (x_NHWC - SHIFT) / SCALE, 0, []
    for layers in NETS[net]:
        if layers.pool:
            window = (1, layers.pool, layers.pool, 1)
            x = jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, window, (1, 2, 2, 1), "VALID")
        for _ in layers.widths:
            part = params["net"][f"conv_{number}"]
            x = jax.lax.conv_general_dilated(
                x,
                part["kernel"].astype(x.dtype),
                (layers.stride, layers.stride),
                ((layers.pad, layers.pad),) * 2,
                dimension_numbers=("NHWC", "HWIO", "NHWC"),
                precision="highest",  # TensorFloat-32 changes the third digit
            )
            x = jax.nn.relu(x + part["bias"].astype(x.dtype))
            number += 1
        found.append(x)
    return found


def _of_length_one(x_NHWC: Array) -> Array:
    """Divide features by their length; those that are all 0 stay 0, and so does their gradient."""
    squares = jnp.square(x_NHWC).sum(-1, keepdims=True)
    length = jnp.sqrt(jnp.where(squares > 0, squares, 1))
    return x_NHWC / (jnp.where(squares > 0, length, 0) + SMALL)
