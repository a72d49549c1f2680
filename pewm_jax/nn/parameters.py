"""Parameters as a table ``{path: shape}``: the leaves of layers, and random values for them.

Initialisation and the import of published weights both use such a table. A convolution is
``kernel (k…, in, out)`` and ``bias``, a linear layer ``kernel (in, out)`` and ``bias``, a norm
``scale`` and ``bias``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence

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


def mlp(where: str, inward: int, hidden: int, outward: int) -> Iterator[Leaf]:
    """Yield the leaves of ``layers.mlp``."""
    yield from linear(f"{where}/linear_1", inward, hidden)
    yield from linear(f"{where}/linear_2", hidden, outward)


def levels(
    where: str, widths: Sequence[int], count: int, block: Callable[[str, int, int], Iterator[Leaf]]
) -> Iterator[Leaf]:
    """Yield the leaves of levels of ``count`` residual blocks; each but the last is resampled.

    ``block(where, inward, outward)`` yields the leaves of a residual block.
    """
    inward = widths[0]
    for level, width in enumerate(widths):
        for k in range(count):
            yield from block(f"{where}_{level}/resnet_{k}", inward, width)
            inward = width
        if level + 1 < len(widths):
            yield from convolution(f"{where}_{level}/resample", (3, 3), width, width)


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

    With ``key_per_leaf`` each kernel has a key of its own, which follows from its place in the
    table. Otherwise one array is drawn and cut, which compiles much faster.
    """
    kernels = {path: shape for path, shape in shapes.items() if _name(path) == "kernel"}
    if key_per_leaf:
        values = {
            path: 1
            / math.sqrt(math.prod(shape[:-1]))
            * jax.random.normal(jax.random.fold_in(key, index), shape)
            for index, (path, shape) in enumerate(shapes.items())
            if path in kernels
        }
    else:
        ends = list(itertools.accumulate(map(math.prod, kernels.values()), initial=0))
        drawn = jax.random.normal(key, (ends[-1],))
        values = {
            path: jax.lax.slice(drawn, (start,), (end,)).reshape(shape)
            / math.sqrt(math.prod(shape[:-1]))
            for (path, shape), (start, end) in zip(
                kernels.items(), itertools.pairwise(ends), strict=True
            )
        }
    rest = {"scale": jnp.ones}
    return tree.unflatten(
        {
            path: values[path] if path in kernels else rest.get(_name(path), jnp.zeros)(shape)
            for path, shape in shapes.items()
        }
    )


def _name(path: str) -> str:
    return path.rsplit("/", 1)[-1]
