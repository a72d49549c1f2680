"""Attention in pieces whose logits stay in a processor's cache.

With a thousand tokens and more the logits of all heads are hundreds of megabytes, and a CPU spends
its time moving them. One head and a block of queries at a time is the same arithmetic, three times
as fast there (1,370 tokens, 6 heads of 64). Accelerators have kernels of their own, for which the
pieces would only be a loop: they get the whole.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from pewm_jax.models import layers
from pewm_jax.types import Array

LOGITS = 2**20
"""Logits held at once on a CPU: 4 MB in float32."""


def attention(q_BKND: Array, k_BKMD: Array, v_BKMD: Array) -> Array:
    """Scaled dot-product attention (B, K, N, d), in pieces where the platform is a CPU.

    The batch is never cut, so that it can be spread over devices.
    """
    batch, heads, queries, _ = q_BKND.shape
    if batch * heads * queries * k_BKMD.shape[2] <= LOGITS:
        return layers.attention(q_BKND, k_BKMD, v_BKMD)
    blocks = math.ceil(batch * queries * k_BKMD.shape[2] / LOGITS)
    return jax.lax.platform_dependent(
        q_BKND,
        k_BKMD,
        v_BKMD,
        cpu=lambda q, k, v: in_pieces(q, k, v, min(blocks, queries)),
        default=layers.attention,
    )


def in_pieces(q_BKND: Array, k_BKMD: Array, v_BKMD: Array, blocks: int) -> Array:
    """Attention one head and one of ``blocks`` blocks of queries at a time, softmax in float32."""
    batch, heads, queries, channels = q_BKND.shape
    size = -(-queries // blocks)
    q_BKND = q_BKND * channels**-0.5
    padded = jnp.pad(q_BKND, ((0, 0), (0, 0), (0, blocks * size - queries), (0, 0)))
    q_KnBsD = padded.reshape(batch, heads, blocks, size, channels).transpose(1, 2, 0, 3, 4)

    def block(q_BsD: Array, k_BMD: Array, v_BMD: Array) -> Array:
        logits = jnp.einsum("bnd,bmd->bnm", q_BsD, k_BMD, preferred_element_type=jnp.float32)
        weights = jnp.exp(logits - logits.max(-1, keepdims=True))
        mixed = jnp.einsum(
            "bnm,bmd->bnd",
            weights.astype(v_BMD.dtype),
            v_BMD,
            preferred_element_type=jnp.float32,
        )
        return (mixed / weights.sum(-1, keepdims=True)).astype(v_BMD.dtype)

    def head(inputs: tuple[Array, Array, Array]) -> Array:
        q_nBsD, k_BMD, v_BMD = inputs
        return jax.lax.map(lambda q_BsD: block(q_BsD, k_BMD, v_BMD), q_nBsD)

    mixed = jax.lax.map(head, (q_KnBsD, *(x.transpose(1, 0, 2, 3) for x in (k_BKMD, v_BKMD))))
    mixed = mixed.transpose(2, 0, 1, 3, 4).reshape(batch, heads, blocks * size, channels)
    return mixed[:, :, :queries]
