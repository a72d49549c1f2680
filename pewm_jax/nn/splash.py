"""Attention on TPUs by JAX's Pallas kernel "splash attention", which stores no logits.

The kernel wants heads of a multiple of 128 channels and numbers of tokens that are multiples of its
tiles, so both are padded with zeros. Padded keys are excluded by segment numbers. Padded queries
are computed and dropped. The forward pass keeps the logarithm of each query's normaliser, and the
backward pass recomputes the attention weights from it.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from pewm_jax.types import Array

LANES = 128
"""Channels and tokens that a TPU's vector registers hold side by side."""
TILES = (512, 384, 256, 128)
"""Numbers of tokens in a tile, preferred first."""
TILE_COST = 64
"""Assumed cost of a tile beside its work, in tokens."""
CHANNELS = 256
"""Largest number of channels of a head: tiles of larger heads do not fit the vector memory."""
TOKENS = 256
"""Fewest queries and keys for which the kernel saves memory: with fewer, the logits are about as
large as queries and keys."""


def pays(queries: int, keys: int, channels: int) -> bool:
    """Tell whether the kernel is better than the formula for these sizes."""
    return min(queries, keys) >= TOKENS and channels <= CHANNELS


def tile(tokens: int) -> int:
    """Return the number of tokens in a tile: few tiles and little padding."""

    def cost(size: int) -> float:
        return -(-tokens // size) * (size + TILE_COST)

    return min(TILES, key=cost)


def splash(q_BKND: Array, k_BKMD: Array, v_BKMD: Array, *, interpret: bool = False) -> Array:
    """Compute attention (B, K, N, d) on one TPU.

    Args:
        q_BKND: queries.
        k_BKMD: keys.
        v_BKMD: values.
        interpret: run the kernel's program on any platform, slowly.
    """
    from jax.experimental.pallas.ops.tpu import splash_attention as pallas  # noqa: PLC0415 - slow

    shape: tuple[int, ...] = q_BKND.shape
    _, heads, queries, channels = shape
    keys: int = k_BKMD.shape[2]
    rows, columns = tile(queries), tile(keys)
    q = _padded(q_BKND * channels**-0.5, rows)
    k, v = _padded(k_BKMD, columns), _padded(v_BKMD, columns)
    everything = pallas.FullMask((q.shape[2], k.shape[2]))
    kernel = pallas.make_splash_mha(
        pallas.MultiHeadMask([everything] * heads),
        head_shards=1,
        q_seq_shards=1,
        interpret=interpret,
        block_sizes=pallas.BlockSizes(
            block_q=rows,
            block_kv=columns,
            block_q_dkv=rows,
            block_kv_dkv=columns,
            block_q_dq=rows,
            block_kv_dq=columns,
        ),
    )
    segments = None
    if k.shape[2] > keys:
        padding = jnp.arange(k.shape[2]) >= keys
        segments = pallas.SegmentIds(
            q=jnp.zeros(q.shape[2], jnp.int32), kv=padding.astype(jnp.int32)
        )
    out: Any = jax.vmap(kernel, in_axes=(0, 0, 0, None))(q, k, v, segments)
    return out[:, :, :queries, :channels]


def _padded(x_BKNC: Array, size: int) -> Array:
    """Pad tokens to a multiple of ``size`` and channels to a multiple of ``LANES``."""
    *_, tokens, channels = x_BKNC.shape
    return jnp.pad(x_BKNC, ((0, 0), (0, 0), (0, -tokens % size), (0, -channels % LANES)))
