"""Parameters as a table ``{path: shape}``: the leaves of layers, and random values for them.

Initialisation and the import of published weights both use such a table. A convolution is
``kernel (k…, in, out)`` and ``bias``, a linear layer ``kernel (in, out)`` and ``bias``, a norm
``scale`` and ``bias``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import jax
import jax.numpy as jnp

from pewm_jax.io import tree
from pewm_jax.types import Array, Params

Leaf = tuple[str, tuple[int, ...]]
"""Path and shape of a parameter."""


def convolution(where: str, kernel: tuple[int, ...], inward: int, outward: int) -> Iterator[Leaf]:
    """Yield the leaves of a convolution."""
    yield f"{where}/kernel", (*kernel, inward, outward)
    yield f"{where}/bias", (outward,)


def linear(where: str, inward: int, outward: int) -> Iterator[Leaf]:
    """Yield the leaves of a linear layer."""
    yield from convolution(where, (), inward, outward)


def norm(where: str, width: int) -> Iterator[Leaf]:
    """Yield the scale and bias of a norm."""
    yield f"{where}/scale", (width,)
    yield f"{where}/bias", (width,)


def draw(
    shapes: Mapping[str, tuple[int, ...]], key: Array, *, key_per_leaf: bool = False
) -> Params:
    """Return random parameters, float32.

    A ``kernel`` (…, in, out) is normal with variance 1 / (product of all but out), a ``scale`` is
    1, everything else 0.

    Args:
        shapes: shape of each parameter by path.
        key: a random key.
        key_per_leaf: whether each kernel has a key of its own, which follows from its place in the
            table. Otherwise one array is drawn and cut, which compiles much faster.
    """
    kernels = {path: shape for path, shape in shapes.items() if _name(path) == "kernel"}
    values = (_drawn_apart if key_per_leaf else _drawn_together)(shapes, kernels, key)
    leaves = {}
    for path, shape in shapes.items():
        if path in kernels:
            leaves[path] = values[path]
        else:
            leaves[path] = jnp.ones(shape) if _name(path) == "scale" else jnp.zeros(shape)
    return tree.unflatten(leaves)


def _name(path: str) -> str:
    return path.rsplit("/", 1)[-1]


def _drawn_apart(
    shapes: Mapping[str, tuple[int, ...]], kernels: Mapping[str, tuple[int, ...]], key: Array
) -> dict[str, Array]:
    return {
        path: 1
        / math.sqrt(math.prod(shape[:-1]))
        * jax.random.normal(jax.random.fold_in(key, index), shape)
        for index, (path, shape) in enumerate(shapes.items())
        if path in kernels
    }


def _drawn_together(
    shapes: Mapping[str, tuple[int, ...]], kernels: Mapping[str, tuple[int, ...]], key: Array
) -> dict[str, Array]:
    del shapes
    drawn = jax.random.normal(key, (sum(map(math.prod, kernels.values())),))
    values, at = {}, 0
    for path, shape in kernels.items():
        size = math.prod(shape)
        cut = jax.lax.slice(drawn, (at,), (at + size,))
        values[path] = cut.reshape(shape) / math.sqrt(math.prod(shape[:-1]))
        at += size
    return values
