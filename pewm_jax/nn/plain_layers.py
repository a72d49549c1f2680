"""Layers as functions of their parameters, ``{"kernel", "bias"}`` or ``{"scale", "bias"}``.

For networks whose layers differ so much in shape that a table of shapes says more than modules.
Computation is in the dtype of the activations, norms are in float32.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp

from pewm_jax.io import tree
from pewm_jax.types import Array, Params

EPSILON = 1e-5
"""Added to variances, as torch does by default."""


def draw(shapes: Mapping[str, tuple[int, ...]], key: Array) -> Params:
    """Return random parameters of shapes by path.

    A ``kernel`` (…, in, out) is normal with variance 1 / (product of all but out), a ``scale`` is
    1, a ``bias`` 0.
    """
    sizes = {p: math.prod(shape) for p, shape in shapes.items() if p.endswith("kernel")}
    drawn = jax.random.normal(key, (sum(sizes.values()),))  # at once: it compiles much faster
    leaves, at = {}, 0
    for path, shape in shapes.items():
        if path in sizes:
            values = jax.lax.slice(drawn, (at,), (at + sizes[path],))
            leaves[path] = values.reshape(shape) / math.sqrt(math.prod(shape[:-1]))
            at += sizes[path]
        else:
            leaves[path] = jnp.ones(shape) if path.endswith("scale") else jnp.zeros(shape)
    return tree.unflatten(leaves)


def linear(part: Params, x: Array) -> Array:
    """Multiply the last axis by the kernel (in, out) and add the bias."""
    return x @ part["kernel"].astype(x.dtype) + part["bias"].astype(x.dtype)


def group_norm(part: Params, x: Array, groups: int) -> Array:
    """Normalise (B, …, C) over places and each group of channels."""
    grouped = x.astype(jnp.float32).reshape(len(x), -1, groups, x.shape[-1] // groups)
    mean = grouped.mean((1, 3), keepdims=True)
    variance = jnp.square(grouped - mean).mean((1, 3), keepdims=True)
    normed = ((grouped - mean) * jax.lax.rsqrt(variance + EPSILON)).reshape(x.shape)
    return (normed * part["scale"] + part["bias"]).astype(x.dtype)


def layer_norm(part: Params, x: Array) -> Array:
    """Normalise over the last axis."""
    wide = x.astype(jnp.float32)
    apart = wide - wide.mean(-1, keepdims=True)
    normed = apart * jax.lax.rsqrt(jnp.square(apart).mean(-1, keepdims=True) + EPSILON)
    return (normed * part["scale"] + part["bias"]).astype(x.dtype)
