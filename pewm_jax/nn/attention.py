"""Attention that never stores all logits: in blocks on a CPU, by kernels on GPUs and TPUs.

With a thousand tokens or more, the logits of all heads take hundreds of megabytes, and a CPU spends
its time moving them. Computing one head and one block of queries at a time is the same arithmetic
and three times as fast there (1,370 tokens, 6 heads of 64). The backward pass keeps only the
logarithm of each query's normaliser and recomputes the attention weights from it (FlashAttention,
Dao et al. 2022). This saves memory and is faster than reading the weights back. Other platforms use
the same formula without the loops.

The target of the trace (``nn.target``) chooses the kernel: cuDNN's flash attention for NVIDIA GPUs
in 16 bits, JAX's Pallas kernel "splash attention" for many tokens on TPUs. Both store no logits.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.nn import placement, ring_attention
from pewm_jax.nn import target as targets
from pewm_jax.nn.layers import linear, merge_heads, split_heads
from pewm_jax.nn.target import Target
from pewm_jax.types import Array, Params

LOGITS = 2**20
"""Logits held at once on a CPU: 4 MB in float32."""

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

Implementation = Literal["auto", "xla", "cudnn", "splash", "ring"]
Kernel = Literal["formula", "cudnn", "splash"]
"""What computes attention; the formula runs in blocks on a CPU."""


def attention(
    q_BKND: Array,
    k_BKMD: Array,
    v_BKMD: Array,
    implementation: Implementation = "auto",
    real_M: np.ndarray | None = None,
) -> Array:
    """Scaled dot-product attention (B, K, N, d), in blocks on a CPU.

    Over several devices (``placement``) batch, heads and queries are split; each device has all
    keys and values of its clips and heads, and computes alone.

    Args:
        implementation: `cudnn` is flash attention on NVIDIA GPUs in 16 bits, `splash` is flash
            attention on TPUs, `xla` runs anywhere, `auto` takes the best that works. `ring` splits
            keys and values over the devices along `context`, too; on one device it is `auto`.
        real_M: indices of the keys that are not padding; None if all are real.

    Raises:
        UserError: a kernel is asked for that the target or these arrays do not allow.
    """

    def alone(q: Array, k: Array, v: Array) -> Array:
        if real_M is not None:
            k, v = k[:, :, real_M], v[:, :, real_M]
        return _alone(q, k, v, implementation)

    split: placement.Names = ("batch", "heads")
    queries: placement.Names = (*split, "tokens")
    if implementation == "ring" and _goes_around(q_BKND, k_BKMD):

        def around(q: Array, k: Array, v: Array) -> Array:
            return ring_attention.ring(q, k, v, "context", real_M)

        return placement.local(around, (queries,) * 3, queries)(q_BKND, k_BKMD, v_BKMD)
    return placement.local(alone, (queries, split, split), queries)(q_BKND, k_BKMD, v_BKMD)


def _goes_around(q_BKND: Array, k_BKMD: Array) -> bool:
    """Tell whether queries and keys can be split over several devices along ``context``."""
    parts = placement.parts("tokens")
    return parts > 1 and not q_BKND.shape[2] % parts and not k_BKMD.shape[2] % parts


def _alone(q_BKND: Array, k_BKMD: Array, v_BKMD: Array, implementation: Implementation) -> Array:
    """Compute ``attention`` on one device."""
    batch, heads, queries, _ = q_BKND.shape
    kernel = choose_kernel(targets.current(), q_BKND, k_BKMD, implementation)
    if kernel == "splash":
        return splash(q_BKND, k_BKMD, v_BKMD)
    if kernel == "cudnn":
        q, k, v = (x.swapaxes(1, 2) for x in (q_BKND, k_BKMD, v_BKMD))
        return flash(q, k, v, "cudnn").swapaxes(1, 2)
    logits = batch * queries * k_BKMD.shape[2]
    if heads * logits <= LOGITS:
        return plain_attention(q_BKND, k_BKMD, v_BKMD)
    return _attention(q_BKND, k_BKMD, v_BKMD, min(math.ceil(logits / LOGITS), queries))


def choose_kernel(
    target: Target, q_BKND: Any, k_BKMD: Any, implementation: Implementation = "auto"
) -> Kernel:
    """Return what computes attention on a target.

    Raises:
        UserError: a kernel is asked for that the target or these arrays do not allow.
    """
    *_, queries, channels = q_BKND.shape
    if implementation == "xla":
        return "formula"
    if implementation == "splash":
        if target.platform != "tpu":
            raise UserError(
                f"attention splash needs a TPU; this is {target.platform}: choose auto or xla."
            )
        return "splash"
    if target.has_cudnn_attention and fits_flash(q_BKND):
        return "cudnn"
    if implementation == "cudnn":
        raise UserError(
            f"attention cudnn needs an NVIDIA GPU (Ampere or newer), 16 bits and heads of at most "
            f"128 channels, a multiple of 8; here are {target.platform}, {q_BKND.dtype} and "
            f"{channels}: choose auto or xla."
        )
    pays = target.platform == "tpu" and splash_pays(queries, k_BKMD.shape[2], channels)
    return "splash" if pays else "formula"


def multi_head_attention(params: Params, x_BND: Array, context_BME: Array, heads: int) -> Array:
    """Multi-head attention with its linear layers: ``to_q``, ``to_k``, ``to_v``, ``to_out``."""
    q = split_heads(linear(params["to_q"], x_BND), heads)
    k, v = (split_heads(linear(params[n], context_BME), heads) for n in ("to_k", "to_v"))
    return linear(params["to_out"], merge_heads(attention(q, k, v)))


def plain_attention(q_BKND: Array, k_BKMD: Array, v_BKMD: Array) -> Array:
    """Compute attention (B, K, N, d) with all logits at once and the softmax in float32."""
    logits = jnp.einsum("bknd,bkmd->bknm", q_BKND, k_BKMD, preferred_element_type=jnp.float32)
    weights = jax.nn.softmax(logits / math.sqrt(q_BKND.shape[-1]), -1)
    return jnp.einsum("bknm,bkmd->bknd", weights.astype(v_BKMD.dtype), v_BKMD)


def flash(q_BNKD: Array, k_BMKD: Array, v_BMKD: Array, implementation: Any) -> Array:
    """Compute attention (B, N, K, d) by a kernel of ``jax.nn.dot_product_attention``.

    The gradient of cuDNN's kernel refuses odd numbers of queries or keys (jax 0.10), so these get
    one token of padding, which is masked and dropped. Under ``vmap`` the kernel wants either all
    arrays to be mapped or none, the lengths included.
    """
    batch, queries, keys = *q_BNKD.shape[:2], k_BMKD.shape[1]
    total = jnp.stack([x.ravel()[0] for x in (q_BNKD, k_BMKD, v_BMKD)]).sum()
    q_BNKD, k_BMKD, v_BMKD = (_mapped_like(total, x) for x in (q_BNKD, k_BMKD, v_BMKD))
    if queries % 2 == 0 and keys % 2 == 0:
        out = jax.nn.dot_product_attention(q_BNKD, k_BMKD, v_BMKD, implementation=implementation)
        return _mapped_like(total, out)

    def even(x: Array) -> Array:
        return jnp.pad(x, ((0, 0), (0, x.shape[1] % 2), (0, 0), (0, 0)))

    of_queries, of_keys = (
        jnp.where(total > 0, count, jnp.full((batch,), count, jnp.int32))
        for count in (queries, keys)
    )
    out = jax.nn.dot_product_attention(
        even(q_BNKD),
        even(k_BMKD),
        even(v_BMKD),
        query_seq_lengths=of_queries,
        key_value_seq_lengths=of_keys,
        implementation=implementation,
    )
    return _mapped_like(total, out)[:, :queries]


@jax.custom_vjp
def _mapped_like(number: Array, x: Array) -> Array:
    """Return x, and its gradient, mapped by ``vmap`` as a number is; XLA removes the choice."""
    return jnp.where(number > 0, x, x)


def _mapped_like_forward(number: Array, x: Array) -> tuple[Array, Array]:
    return _mapped_like(number, x), number


def _mapped_like_backward(number: Array, grad: Array) -> tuple[Array, Array]:
    return jnp.zeros_like(number), _mapped_like(number, grad)


_mapped_like.defvjp(_mapped_like_forward, _mapped_like_backward)


def fits_flash(q_BKND: Any) -> bool:
    """Tell whether cuDNN's flash attention supports this dtype and head size."""
    channels = q_BKND.shape[-1]
    sixteen = q_BKND.dtype in (jnp.bfloat16, jnp.float16)
    return sixteen and channels <= 128 and channels % 8 == 0


def splash_pays(queries: int, keys: int, channels: int) -> bool:
    """Tell whether the kernel is better than the formula for these sizes."""
    return min(queries, keys) >= TOKENS and channels <= CHANNELS


def tile(tokens: int) -> int:
    """Return the number of tokens in a tile: few tiles and little padding."""

    def cost(size: int) -> float:
        return -(-tokens // size) * (size + TILE_COST)

    return min(TILES, key=cost)


def splash(q_BKND: Array, k_BKMD: Array, v_BKMD: Array, *, interpret: bool = False) -> Array:
    """Compute attention (B, K, N, d) on one TPU; ``interpret`` runs the kernel anywhere, slowly.

    The kernel wants heads of a multiple of 128 channels and numbers of tokens that are multiples of
    its tiles, so both are padded with zeros. Padded keys are excluded by segment numbers. Padded
    queries are computed and dropped.
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


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def _attention(q: Array, k: Array, v: Array, blocks: int) -> Array:
    return _forward(q, k, v, blocks)[0]


def _forward(q: Array, k: Array, v: Array, blocks: int) -> tuple[Array, tuple[Array, ...]]:
    out, normaliser = jax.lax.platform_dependent(
        q, k, v, cpu=partial(_pieces_forward, blocks=blocks), default=_piece_forward
    )
    return out, (q, k, v, out, normaliser)


def _backward(blocks: int, saved: tuple[Array, ...], grad: Array) -> Any:
    q, k, v, out, normaliser = saved
    shared = (grad.astype(jnp.float32) * out.astype(jnp.float32)).sum(-1, keepdims=True)
    arrays = q, k, v, normaliser, shared, grad
    by_blocks = partial(_pieces_backward, blocks=blocks)
    return jax.lax.platform_dependent(*arrays, cpu=by_blocks, default=_piece_backward)


_attention.defvjp(_forward, _backward)


def _logits(q: Array, k: Array) -> Array:
    return _dot("...nd,...md->...nm", q * q.shape[-1] ** -0.5, k)


def _dot(equation: str, *operands: Array) -> Array:
    return jnp.einsum(equation, *operands, preferred_element_type=jnp.float32)


def _piece_forward(q: Array, k: Array, v: Array) -> tuple[Array, Array]:
    """Return attention (..., n, d) and each query's log normaliser (..., n, 1), float32."""
    logits = _logits(q, k)
    top = logits.max(-1, keepdims=True)
    weights = jnp.exp(logits - top)
    total = weights.sum(-1, keepdims=True)
    mixed = _dot("...nm,...md->...nd", weights.astype(v.dtype), v)
    return (mixed / total).astype(v.dtype), top + jnp.log(total)


def _piece_backward(
    q: Array, k: Array, v: Array, normaliser: Array, shared: Array, grad: Array
) -> tuple[Array, Array, Array]:
    """Return the gradients of q, k and v; ``shared`` is (grad · output) of each query.

    The gradients of k and v are computed transposed: transposing the few channels of q is much
    faster on a CPU than transposing the many weights.
    """
    weights = jnp.exp(_logits(q, k) - normaliser)
    slope = weights * (_dot("...nd,...md->...nm", grad, v) - shared)
    slope, weights = slope.astype(q.dtype), weights.astype(q.dtype)
    scale = q.shape[-1] ** -0.5
    return (
        (_dot("...nm,...md->...nd", slope, k) * scale).astype(q.dtype),
        (_dot("...nd,...nm->...dm", q, slope).swapaxes(-1, -2) * scale).astype(k.dtype),
        _dot("...nd,...nm->...dm", grad, weights).swapaxes(-1, -2).astype(v.dtype),
    )


def _cut(x_BKNC: Array, blocks: int) -> Array:
    """(B, K, N, C) → (K, blocks, B, n, C); the zero padding has zero gradients."""
    batch, heads, queries, channels = x_BKNC.shape
    size = -(-queries // blocks)
    padded = jnp.pad(x_BKNC, ((0, 0), (0, 0), (0, blocks * size - queries), (0, 0)))
    return padded.reshape(batch, heads, blocks, size, channels).transpose(1, 2, 0, 3, 4)


def _join(x_KnBsC: Array, queries: int) -> Array:
    """Invert ``_cut``."""
    heads, blocks, batch, size, channels = x_KnBsC.shape
    whole = x_KnBsC.transpose(2, 0, 1, 3, 4).reshape(batch, heads, blocks * size, channels)
    return whole[:, :, :queries]


def _pieces_forward(q: Array, k: Array, v: Array, *, blocks: int) -> tuple[Array, Array]:
    """Run ``_piece_forward`` one head and one block of queries at a time, in ``blocks`` blocks."""

    def head(inputs: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        q_nBsD, k_BMD, v_BMD = inputs
        return jax.lax.map(lambda q_BsD: _piece_forward(q_BsD, k_BMD, v_BMD), q_nBsD)

    out, normaliser = jax.lax.map(head, (_cut(q, blocks), k.swapaxes(0, 1), v.swapaxes(0, 1)))
    return _join(out, q.shape[2]), _join(normaliser, q.shape[2])


def _pieces_backward(
    q: Array,
    k: Array,
    v: Array,
    normaliser: Array,
    shared: Array,
    grad: Array,
    *,
    blocks: int,
) -> tuple[Array, Array, Array]:
    """Run ``_piece_backward`` one head and one block of queries at a time."""

    def head(inputs: tuple[tuple[Array, ...], Array, Array]) -> tuple[Array, Array, Array]:
        (q_nBsD, *rest), k_BMD, v_BMD = inputs

        def block(sums: tuple[Array, Array], parts: tuple[Array, ...]) -> Any:
            dq, dk, dv = _piece_backward(parts[0], k_BMD, v_BMD, *parts[1:])
            return (sums[0] + dk, sums[1] + dv), dq

        if blocks == 1:
            dq, dk, dv = _piece_backward(q_nBsD[0], k_BMD, v_BMD, *(x[0] for x in rest))
            return dq[None], dk, dv
        zeros = jnp.zeros(k_BMD.shape, jnp.float32), jnp.zeros(v_BMD.shape, jnp.float32)
        (dk, dv), dq = jax.lax.scan(block, zeros, (q_nBsD, *rest))
        return dq, dk.astype(k.dtype), dv.astype(v.dtype)

    cut = tuple(_cut(x, blocks) for x in (q, normaliser, shared, grad))
    dq, dk, dv = jax.lax.map(head, (cut, k.swapaxes(0, 1), v.swapaxes(0, 1)))
    return _join(dq, q.shape[2]), dk.swapaxes(0, 1), dv.swapaxes(0, 1)
