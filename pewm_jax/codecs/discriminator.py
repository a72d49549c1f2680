"""PatchGAN: a network that tells patches of recorded pictures from patches of decoded ones.

It sharpens a decoder that has converged (``worlds.sharpen``), and serves training alone: weights do
not contain it. Convolutions of 4 × 4 pixels follow each other: one with stride 2, two with stride 2
and normalisation, one with stride 1 and normalisation, and one that returns a logit for each patch,
70 × 70 pixels large (Isola et al. 2017, ``NLayerDiscriminator`` with 3 layers). As it never
judges a picture outside training, it normalises by the statistics of the batch and keeps none.

The weight of its gradient follows latent diffusion (Rombach et al. 2022, ``contperceptual.py`` of
CompVis/latent-diffusion): the adversarial and the reconstruction term pull at the decoder's last
layer in a fixed proportion.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from pewm_jax.errors import UserError
from pewm_jax.nn.convolution import PICTURES
from pewm_jax.types import Array, Params

WIDTHS = (32, 64, 128, 256, 1)
"""Channels out of each convolution; the last are the logits."""
STRIDES = (2, 2, 2, 1, 1)
SIDE = 4
SLOPE = 0.2
"""Slope of the leaky ReLU below 0."""
SPREAD = 0.02
"""Standard deviation of the kernels, and of the scales around 1, at initialization."""
SMALL = 1e-5
"""Added to variances."""
LEAST = 24
"""The smallest height and width, in pixels, with a logit."""
FLOOR, MOST = 1e-4, 1e4
"""Added to the adversarial gradient's norm, and the largest adaptive weight before its factor."""


def init(key: Array) -> Params:
    """Return random parameters, about 0.7 million."""
    params: Params = {}
    inward = 3
    for number, outward in enumerate(WIDTHS):
        kernel_key, scale_key = jax.random.split(jax.random.fold_in(key, number))
        kernel = SPREAD * jax.random.normal(kernel_key, (SIDE, SIDE, inward, outward))
        layer = {"kernel": kernel, "bias": jnp.zeros((outward,))}
        if _is_normalised(number):
            layer["scale"] = 1 + SPREAD * jax.random.normal(scale_key, (outward,))
        params[f"conv_{number}"] = layer
        inward = outward
    return params


def apply(params: Params, x_NHWC: Array) -> Array:
    """Return a logit for each patch of pictures in [−1, 1], (N, h, w): high for recorded ones."""
    x = x_NHWC
    for number, stride in enumerate(STRIDES):
        layer = params[f"conv_{number}"]
        x = _convolve(x, layer["kernel"], stride)
        if _is_normalised(number):
            mean, variance = x.mean((0, 1, 2)), x.var((0, 1, 2))
            x = (x - mean) * jax.lax.rsqrt(variance + SMALL) * layer["scale"]
        x = x + layer["bias"]
        if number < len(STRIDES) - 1:
            x = jax.nn.leaky_relu(x, SLOPE)
    return x[..., 0]


def hinge(true_logits: Array, made_logits: Array) -> Array:
    """Return the discriminator's loss: recorded patches above 1, decoded ones below −1."""
    return (jax.nn.relu(1 - true_logits).mean() + jax.nn.relu(1 + made_logits).mean()) / 2


def adaptive_weight(reconstruction: Array, adversarial: Array, factor: float) -> Array:
    """Return the weight of the adversarial term from two gradients of the decoder's last layer.

    It is ``factor`` × |reconstruction| / (|adversarial| + 10⁻⁴), the quotient at most 10⁴.
    """
    one, other = (jnp.sqrt(jnp.square(x).sum()) for x in (reconstruction, adversarial))
    return factor * jnp.clip(one / (other + FLOOR), 0, MOST)


def require_size(height: int, width: int) -> None:
    """Refuse pictures that are too small.

    Raises:
        UserError: they have no logit.
    """
    if min(height, width) < LEAST:
        raise UserError(
            f"pictures of {height}×{width} pixels are too small for the discriminator, which needs "
            f"at least {LEAST}×{LEAST}: set train.sharpen.steps 0, or train on larger pictures."
        )


def _is_normalised(number: int) -> bool:
    return 0 < number < len(WIDTHS) - 1


def _convolve(x_NHWC: Array, kernel_HWIO: Array, stride: int) -> Array:
    """Convolve with zeros around the picture, one pixel wide."""
    return jax.lax.conv_general_dilated(
        x_NHWC, kernel_HWIO, (stride, stride), ((1, 1), (1, 1)), None, None, PICTURES
    )
