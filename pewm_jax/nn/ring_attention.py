"""Ring attention: queries, keys and values are all split over a mesh axis, for very long clips.

Each device has a part of the tokens. It computes attention of its queries to its own keys, then
passes keys and values on to its neighbour and gets the other neighbour's, until all have gone
around (Liu et al. 2023, arXiv 2310.01889). Results of parts are combined by the logarithm of each
query's normaliser, in float32. So no device ever holds all keys. The backward pass goes around
again: it recomputes the weights from the normaliser, and the gradients of keys and values travel
with them.

Within a device one block of queries is computed at a time, so few logits are held. The public
``jax.nn.dot_product_attention`` returns normalisers, too, but in 16 bits where its arguments are:
too coarse to combine parts.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.types import Array

LOGITS = 2**26
"""Logits of one clip's heads that a device holds at once: 256 MB in float32."""
NOTHING = -1e30
"""The logit of a key that is padding."""


def ring(
    q_BKND: Array, k_BKMD: Array, v_BKMD: Array, axis: str, real_M: np.ndarray | None = None
) -> Array:
    """Compute attention (B, K, N, d) of a device's queries to the keys of all devices.

    Call it inside ``jax.shard_map``.

    Args:
        q_BKND: the queries of this device.
        k_BKMD: the keys of this device, an equal part of all.
        v_BKMD: their values.
        axis: the mesh axis along which the tokens are split.
        real_M: indices, among the keys of all devices, of those that are not padding.
    """
    keys = k_BKMD.shape[2] * jax.lax.axis_size(axis)
    real = np.ones(keys, bool)
    if real_M is not None:
        real = np.isin(np.arange(keys), real_M)
    return _ring(q_BKND, k_BKMD, v_BKMD, axis, tuple(real.tolist()))


@partial(jax.custom_vjp, nondiff_argnums=(3, 4))
def _ring(q: Array, k: Array, v: Array, axis: str, real: tuple[bool, ...]) -> Array:
    return _forward(q, k, v, axis, real)[0]


def _forward(
    q: Array, k: Array, v: Array, axis: str, real: tuple[bool, ...]
) -> tuple[Array, tuple[Array, ...]]:
    masks = _masks(axis, real)

    def combine(sums: tuple[Array, Array], k: Array, v: Array, mask: Array) -> tuple[Array, Array]:
        out, normaliser = sums
        part, own = _blocks(partial(_piece, k=k, v=v, mask=mask), (q,))
        total = jnp.logaddexp(normaliser, own)
        return out * jnp.exp(normaliser - total) + part * jnp.exp(own - total), total

    def step(carry: Any, mask: Array) -> tuple[Any, None]:
        sums, k, v = carry
        sums = combine(sums, k, v, mask)
        return (sums, _next(k, axis), _next(v, axis)), None

    empty = jnp.zeros(q.shape, jnp.float32), jnp.full((*q.shape[:-1], 1), NOTHING, jnp.float32)
    (sums, k_last, v_last), _ = jax.lax.scan(step, (empty, k, v), masks[:-1])
    out, normaliser = combine(sums, k_last, v_last, masks[-1])
    out = out.astype(v.dtype)
    return out, (q, k, v, out, normaliser)


def _backward(axis: str, real: tuple[bool, ...], saved: tuple[Array, ...], grad: Array) -> Any:
    q, k, v, out, normaliser = saved
    shared = (grad.astype(jnp.float32) * out.astype(jnp.float32)).sum(-1, keepdims=True)
    queries = q, normaliser, shared, grad

    def step(carry: Any, mask: Array) -> tuple[Any, None]:
        k, v, dq, dk, dv = carry

        def block(sums: tuple[Array, Array], parts: tuple[Array, ...]) -> Any:
            new, more_k, more_v = _piece_backward(*parts, k=k, v=v, mask=mask)
            return (sums[0] + more_k, sums[1] + more_v), new

        (dk, dv), more = jax.lax.scan(block, (dk, dv), tuple(_cut(x, k) for x in queries))
        dq = dq + _join(more, q.shape[2])
        return (*(_next(x, axis) for x in (k, v)), dq, *(_next(x, axis) for x in (dk, dv))), None

    zeros = [jnp.zeros(x.shape, jnp.float32) for x in (q, k, v)]
    (_, _, dq, dk, dv), _ = jax.lax.scan(step, (k, v, *zeros), _masks(axis, real))
    return dq.astype(q.dtype), dk.astype(k.dtype), dv.astype(v.dtype)


_ring.defvjp(_forward, _backward)


def _next(x: Array, axis: str) -> Array:
    """Pass an array on to the next device of the ring; return that of the one before."""
    size = jax.lax.axis_size(axis)
    return jax.lax.ppermute(x, axis, [(here, (here + 1) % size) for here in range(size)])


def _masks(axis: str, real: tuple[bool, ...]) -> Array:
    """Return which keys are real, (devices, keys of one), in the order in which they arrive."""
    size = jax.lax.axis_size(axis)
    arrivals = (jax.lax.axis_index(axis) - jnp.arange(size)) % size
    return jnp.asarray(np.array(real).reshape(size, -1))[arrivals]


def _logits(q: Array, k: Array, mask: Array) -> Array:
    scaled = q * q.shape[-1] ** -0.5
    return jnp.where(mask, _dot("bknd,bkmd->bknm", scaled, k), NOTHING)


def _dot(equation: str, *operands: Array) -> Array:
    return jnp.einsum(equation, *operands, preferred_element_type=jnp.float32)


def _piece(q: Array, *, k: Array, v: Array, mask: Array) -> tuple[Array, Array]:
    """Return attention to some keys and each query's log normaliser, in float32."""
    logits = _logits(q, k, mask)
    top = logits.max(-1, keepdims=True)
    weights = jnp.exp(logits - top)
    total = weights.sum(-1, keepdims=True)
    mixed = _dot("bknm,bkmd->bknd", weights.astype(v.dtype), v)
    return mixed / total, top + jnp.log(total)


def _piece_backward(
    q: Array,
    normaliser: Array,
    shared: Array,
    grad: Array,
    *,
    k: Array,
    v: Array,
    mask: Array,
) -> tuple[Array, Array, Array]:
    """Return the gradients of queries, and what they add to those of some keys and values."""
    weights = jnp.exp(_logits(q, k, mask) - normaliser)
    slope = weights * (_dot("bknd,bkmd->bknm", grad, v) - shared)
    slope, weights = slope.astype(q.dtype), weights.astype(q.dtype)
    scale = q.shape[-1] ** -0.5
    return (
        _dot("bknm,bkmd->bknd", slope, k) * scale,
        _dot("bknm,bknd->bkmd", slope, q) * scale,
        _dot("bknm,bknd->bkmd", weights, grad),
    )


def _blocks(piece: Any, queries: tuple[Array, ...]) -> Any:
    """Run a function of queries one block at a time."""
    k = piece.keywords["k"]
    count = queries[0].shape[2]
    found = jax.lax.map(lambda parts: piece(*parts), tuple(_cut(x, k) for x in queries))
    return jax.tree.map(lambda x: _join(x, count), found)


def _cut(x_BKNC: Array, k_BKMD: Array) -> Array:
    """(B, K, N, C) → (blocks, B, K, n, C), padded with zeros; ``LOGITS`` bounds a block's size."""
    batch, heads, queries, channels = x_BKNC.shape
    size = max(1, min(queries, LOGITS // (batch * heads * k_BKMD.shape[2])))
    blocks = -(-queries // size)
    size = -(-queries // blocks)
    padded = jnp.pad(x_BKNC, ((0, 0), (0, 0), (0, blocks * size - queries), (0, 0)))
    return jnp.moveaxis(padded.reshape(batch, heads, blocks, size, channels), 2, 0)


def _join(x_BlocksBKnC: Array, queries: int) -> Array:
    """Invert ``_cut``."""
    blocks, batch, heads, size, channels = x_BlocksBKnC.shape
    whole = jnp.moveaxis(x_BlocksBKnC, 0, 2).reshape(batch, heads, blocks * size, channels)
    return whole[:, :, :queries]
