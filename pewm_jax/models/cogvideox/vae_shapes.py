"""The parameters of the video autoencoder: path and shape of every leaf.

Initialisation and the import of published weights both use this list. A convolution
is ``kernel (kt, kh, kw, in, out)`` (2D ones without kt) and ``bias``; a norm is ``scale`` and
``bias``; a norm of the decoder also holds the 1×1×1 convolutions ``scale_by`` and ``shift_by``
from latents to its channels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import jax
import jax.numpy as jnp

from pewm_jax.config import VAEConfig
from pewm_jax.io import tree
from pewm_jax.types import Array, Params

Leaf = tuple[str, tuple[int, ...]]


def layout(config: VAEConfig) -> dict[str, tuple[int, ...]]:
    """Return ``{path: shape}`` of the parameters."""
    return dict([*_encoder(config), *_decoder(config)])


def init(config: VAEConfig, key: Array) -> Params:
    """Return random parameters: float32, kernels of variance 1/inputs, scales 1, biases 0.

    Args:
        config: the autoencoder.
        key: a random key.

    Returns:
        ``{"encoder": …, "decoder": …}``.
    """
    return draw(layout(config), key)


def draw(layout: Mapping[str, tuple[int, ...]], key: Array) -> Params:
    """Return random parameters of ``{path: shape}``: ``kernel`` drawn, ``scale`` 1, others 0."""
    leaves = {}
    for index, (path, shape) in enumerate(layout.items()):
        name = path.rsplit("/", 1)[1]
        if name == "kernel":
            spread = 1 / math.sqrt(math.prod(shape[:-1]))
            leaves[path] = spread * jax.random.normal(jax.random.fold_in(key, index), shape)
        elif name == "scale":
            leaves[path] = jnp.ones(shape)
        else:
            leaves[path] = jnp.zeros(shape)
    return tree.unflatten(leaves)


def _encoder(config: VAEConfig) -> Iterator[Leaf]:
    widths = config.widths
    yield from _conv("encoder/conv_in", (3, 3, 3), config.in_channels, widths[0])
    inside = widths[0]
    for level, width in enumerate(widths):
        where = f"encoder/down_{level}"
        for k in range(config.resnets):
            yield from _resnet(f"{where}/resnet_{k}", inside if k == 0 else width, width)
        if level + 1 < len(widths):
            yield from _conv(f"{where}/resample", (3, 3), width, width)
        inside = width
    for k in range(2):
        yield from _resnet(f"encoder/mid/resnet_{k}", inside, inside)
    yield from _norm("encoder/norm_out", inside)
    yield from _conv("encoder/conv_out", (3, 3, 3), inside, 2 * config.latent_channels)


def _decoder(config: VAEConfig) -> Iterator[Leaf]:
    widths, latent = config.widths[::-1], config.latent_channels
    yield from _conv("decoder/conv_in", (3, 3, 3), latent, widths[0])
    for k in range(2):
        yield from _resnet(f"decoder/mid/resnet_{k}", widths[0], widths[0], latent)
    inside = widths[0]
    for level, width in enumerate(widths):
        where = f"decoder/up_{level}"
        for k in range(config.resnets + 1):
            yield from _resnet(f"{where}/resnet_{k}", inside if k == 0 else width, width, latent)
        if level + 1 < len(widths):
            yield from _conv(f"{where}/resample", (3, 3), width, width)
        inside = width
    yield from _norm("decoder/norm_out", inside, latent)
    yield from _conv("decoder/conv_out", (3, 3, 3), inside, config.out_channels)


def _conv(where: str, kernel: tuple[int, ...], inside: int, outside: int) -> Iterator[Leaf]:
    yield f"{where}/kernel", (*kernel, inside, outside)
    yield f"{where}/bias", (outside,)


def _norm(where: str, width: int, latent: int = 0) -> Iterator[Leaf]:
    yield f"{where}/scale", (width,)
    yield f"{where}/bias", (width,)
    if latent:
        yield from _conv(f"{where}/scale_by", (1, 1, 1), latent, width)
        yield from _conv(f"{where}/shift_by", (1, 1, 1), latent, width)


def _resnet(where: str, inside: int, outside: int, latent: int = 0) -> Iterator[Leaf]:
    yield from _norm(f"{where}/norm1", inside, latent)
    yield from _conv(f"{where}/conv1", (3, 3, 3), inside, outside)
    yield from _norm(f"{where}/norm2", outside, latent)
    yield from _conv(f"{where}/conv2", (3, 3, 3), outside, outside)
    if inside != outside:
        yield from _conv(f"{where}/shortcut", (1, 1, 1), inside, outside)
