"""I3D: features of a video from a network that was trained to classify human actions.

Inception-v1 with its kernels inflated to three dimensions (Carreira and Zisserman 2017), trained on
Kinetics-400. Its 400 logits, averaged over time, are the features of FVD (Unterthiner et al. 2018).
The references are ``i3d.py`` of deepmind/kinetics-i3d and its port piergiovanni/pytorch-i3d.
Padding and windows are TensorFlow's ("same": the odd one at the end). Batch norms become part of
kernels and biases where the weights are read (``models.i3d.convert``).

Pictures are resized to 224 × 224 linearly **with antialiasing**, without cropping. The
first implementation of FVD resized without antialiasing, which is another measure for pictures that
are larger.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.io import tree
from pewm_jax.types import Array, Params

SIDE = 224
"""Height and width, pixels, of what the network is given."""
LEAST = 9
"""The fewest frames for which the last layer has an output."""
LOGITS = 400
"""Actions of Kinetics-400, and so numbers per clip."""
HIGHEST = jax.lax.Precision.HIGHEST
FEW = 8
"""Up to this number of channels, several frames are convolved at once."""


@dataclasses.dataclass(frozen=True)
class Conv:
    """A convolution with a ReLU."""

    name: str
    width: int
    side: int
    stride: int = 1


@dataclasses.dataclass(frozen=True)
class Pool:
    """A maximum over frames and pixels each way; every ``stride`` of them."""

    window: tuple[int, int, int]
    stride: tuple[int, int, int]


@dataclasses.dataclass(frozen=True)
class Mixed:
    """Four branches side by side, an inception module.

    Attributes: name: of the module. widths: channels out of ``b0``, ``b1a``, ``b1b``, ``b2a``,
        ``b2b`` and ``b3b``: b0 has a kernel of 1, b1b and b2b of 3 × 3 × 3 after b1a and b2a, b3b
        follows a maximum over 3 × 3 × 3.
    """

    name: str
    widths: tuple[int, int, int, int, int, int]


PARTS: tuple[Conv | Pool | Mixed, ...] = (
    Conv("Conv3d_1a_7x7", 64, side=7, stride=2),
    Pool((1, 3, 3), (1, 2, 2)),
    Conv("Conv3d_2b_1x1", 64, side=1),
    Conv("Conv3d_2c_3x3", 192, side=3),
    Pool((1, 3, 3), (1, 2, 2)),
    Mixed("Mixed_3b", (64, 96, 128, 16, 32, 32)),
    Mixed("Mixed_3c", (128, 128, 192, 32, 96, 64)),
    Pool((3, 3, 3), (2, 2, 2)),
    Mixed("Mixed_4b", (192, 96, 208, 16, 48, 64)),
    Mixed("Mixed_4c", (160, 112, 224, 24, 64, 64)),
    Mixed("Mixed_4d", (128, 128, 256, 24, 64, 64)),
    Mixed("Mixed_4e", (112, 144, 288, 32, 64, 64)),
    Mixed("Mixed_4f", (256, 160, 320, 32, 128, 128)),
    Pool((2, 2, 2), (2, 2, 2)),
    Mixed("Mixed_5b", (256, 160, 320, 32, 128, 128)),
    Mixed("Mixed_5c", (384, 192, 384, 48, 128, 128)),
)
"""The network, from the video on, under the names of the reference."""


def _units() -> Iterator[tuple[str, int, int, int]]:
    """List every convolution: its path, its side, channels in and out."""
    inward = 3
    for part in PARTS:
        if isinstance(part, Conv):
            yield part.name, part.side, inward, part.width
            inward = part.width
        elif isinstance(part, Mixed):
            b0, b1a, b1b, b2a, b2b, b3b = part.widths
            for branch, side, one, other in (
                ("b0", 1, inward, b0),
                ("b1a", 1, inward, b1a),
                ("b1b", 3, b1a, b1b),
                ("b2a", 1, inward, b2a),
                ("b2b", 3, b2a, b2b),
                ("b3b", 1, inward, b3b),
            ):
                yield f"{part.name}/{branch}", side, one, other
            inward = b0 + b1b + b2b + b3b
    yield "logits", 1, inward, LOGITS


def shapes() -> dict[str, tuple[int, ...]]:
    """Return the shape of every parameter by its path.

    ``UNIT/kernel`` is (frames, height, width, channels in, channels out) and ``UNIT/bias``
    (channels out,), of the units ``Conv3d_1a_7x7``, ``Mixed_3b/b0`` and so on, and ``logits``.
    """
    found: dict[str, tuple[int, ...]] = {}
    for path, side, inward, width in _units():
        found[f"{path}/kernel"] = (side, side, side, inward, width)
        found[f"{path}/bias"] = (width,)
    return found


def init(key: Array) -> Params:
    """Return random parameters: untrained features, for tests."""
    drawn = {}
    for number, (path, shape) in enumerate(shapes().items()):
        x = jax.random.normal(jax.random.fold_in(key, number), shape)
        size = np.sqrt(2 / np.prod(shape[:-1])) if path.endswith("kernel") else 0.1
        drawn[path] = x * size
    return tree.unflatten(drawn)


def apply(params: Params, video_BTHWC: Array) -> Array:
    """Return the logits of each clip, averaged over time, (B, 400) float32.

    The video is of colours in [−1, 1], of at least 9 frames and of any height and width.

    Raises:
        UserError: there are too few frames, or the last axis is not colour.
    """
    video = jnp.asarray(video_BTHWC)
    require_frames(*video.shape)
    x = trunk(params, resize(video.astype(jnp.float32)))
    places = x.mean((2, 3))  # the reference's window of 2 × 7 × 7 covers all of 7 × 7
    pooled = ((places[:, :-1] + places[:, 1:]) / 2).mean(1)
    head = params["logits"]
    kernel = head["kernel"][0, 0, 0].astype(jnp.float32)
    logits = jnp.einsum("bc,cl->bl", pooled, kernel, precision=HIGHEST)
    return logits + head["bias"].astype(jnp.float32)


def require_frames(*shape: int) -> None:
    """Refuse arrays that are not a batch of clips for I3D.

    Raises:
        UserError: wrong shape or too few frames.
    """
    if len(shape) != 5 or shape[-1] != 3:
        raise UserError(f"I3D cannot take a video of shape {shape}: give it as (B, T, H, W, 3).")
    if shape[1] < LEAST:
        raise UserError(
            f"clips of {shape[1]} frames are too short for I3D, which needs at least {LEAST}: add "
            "the observed frames before, or imagine longer clips."
        )


def resize(video_BTHWC: Array) -> Array:
    """Return pictures of 224 × 224 pixels: linear, antialiased, nothing cropped."""
    shape = (*video_BTHWC.shape[:2], SIDE, SIDE, video_BTHWC.shape[-1])
    return jax.image.resize(video_BTHWC, shape, "linear", antialias=True, precision=HIGHEST)


def trunk(params: Params, x_BTHWC: Array) -> Array:
    """Return the last module's output for videos of any size, (B, T/8, H/32, W/32, 1024)."""
    x = x_BTHWC
    for part in PARTS:
        if isinstance(part, Conv):
            x = _conv(params[part.name], x, part.stride)
        elif isinstance(part, Pool):
            x = _pool(x, part.window, part.stride)
        else:
            x = _mixed(params[part.name], x)
    return x


def _conv(part: Params, x_BTHWC: Array, stride: int = 1) -> Array:
    """Convolve, add the bias, apply ReLU.

    Frames are convolved as images, which on a CPU is faster than XLA's 3D convolution: all frames
    under the kernel at once if there are few channels, else frame by frame.
    """
    kernel = part["kernel"].astype(x_BTHWC.dtype)
    frames, height, width, inward, outward = kernel.shape
    clips, count = x_BTHWC.shape[:2]
    made = -(-count // stride)
    missing = max((made - 1) * stride + frames - count, 0)
    ends = (missing // 2, missing - missing // 2)
    x = jnp.pad(x_BTHWC, ((0, 0), ends, (0, 0), (0, 0), (0, 0)))
    under = [x[:, k : k + (made - 1) * stride + 1 : stride] for k in range(frames)]
    kernels = list(kernel)
    if inward <= FEW:
        under = [jnp.concatenate(under, -1)]
        kernels = [kernel.transpose(1, 2, 0, 3, 4).reshape(height, width, -1, outward)]
    total = sum(
        jax.lax.conv_general_dilated(
            pictures.reshape(clips * made, *pictures.shape[2:]),
            weights,
            (stride, stride),
            "SAME",
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
            precision=HIGHEST,  # TensorFloat-32 changes the third digit
        )
        for pictures, weights in zip(under, kernels, strict=True)
    )
    total = jax.nn.relu(total + part["bias"].astype(x.dtype))
    return total.reshape(clips, made, *total.shape[1:])


def _pool(x_BTHWC: Array, window: tuple[int, ...], stride: tuple[int, ...]) -> Array:
    """Compute the maximum of every window, axis by axis."""
    x = x_BTHWC
    for axis, (size, step) in enumerate(zip(window, stride, strict=True), 1):
        sizes, steps = ([n if at == axis else 1 for at in range(5)] for n in (size, step))
        x = jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, sizes, steps, "SAME")
    return x


def _mixed(part: Params, x_BTHWC: Array) -> Array:
    """Join the four branches."""
    x = x_BTHWC
    branches = (
        _conv(part["b0"], x),
        _conv(part["b1b"], _conv(part["b1a"], x)),
        _conv(part["b2b"], _conv(part["b2a"], x)),
        _conv(part["b3b"], _pool(x, (3, 3, 3), (1, 1, 1))),
    )
    return jnp.concatenate(branches, -1)
