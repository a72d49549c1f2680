"""The memory expert block, by which the denoiser reads the map (paper, Eq. 2 and Fig. 2).

``concat(H, camera embedding)`` and the map tokens M each get an adaptive layernorm from the time
embedding. H attends to M. α_M gates the attention, α_H the feed-forward network:

    H ← H + α_M · Attn(H_norm, M_norm)
    H ← H + α_H · FF(LN(H))

Both gates start at zero, so a fresh block is the identity and stage 2 begins exactly at the stage-1
model. If a clip's map is empty, the block returns its input unchanged. With the memory ``none``
every map is empty; there the feed-forward network still runs, so that the block can be trained.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.nn import layers, modules, placement
from pewm_jax.nn.tokens import TokenLayout
from pewm_jax.readers.geometry import Sightings, frequencies
from pewm_jax.types import Array

PEAK = 12.0
"""Initial logit advantage of a cell that projects to the centre of the query's patch."""

QUERIES: placement.Names = ("batch", "heads", "tokens")
KEYS: placement.Names = ("batch", "heads")
VIEWS: placement.Names = ("batch", None, "heads")
MIXED: placement.Names = ("batch", "tokens", "heads")
"""How queries, keys, the tokens in view and the results are split over devices."""


def masked_attention(logits: Array, mask: Array, sink_K: Array, values: Array) -> Array:
    """Attend to unmasked tokens, or to none.

    The softmax over the last axis has one extra entry per head, with the logit ``sink_K``, whose
    value is zero. A query may attend to it instead of to tokens; if all tokens are masked the
    result is zero, never NaN. Logits are (..., K, n, M) float32, values (..., K, M, d).
    """
    sink = sink_K[:, None, None].astype(jnp.float32)
    logits = jnp.where(mask, logits, -jnp.inf)
    top = jax.lax.stop_gradient(jnp.maximum(logits.max(-1, keepdims=True), sink))
    weights = jnp.exp(logits - top)
    total = weights.sum(-1, keepdims=True) + jnp.exp(sink - top)
    return (weights / total).astype(values.dtype) @ values


def _project(video_BND: Array, memory_BMD: Array, heads: int, width: int) -> Iterator[Array]:
    """Return queries of video tokens, keys and values of map tokens, split into heads."""
    for name, x in (("to_q", video_BND), ("to_k", memory_BMD), ("to_v", memory_BMD)):
        yield layers.split_heads(modules.dense(width, video_BND.dtype, name)(x), heads)


class SinusoidAttention(nn.Module):
    """Plain cross-attention of all video tokens to all map tokens (the paper)."""

    heads: int
    head_dim: int

    @nn.compact
    def __call__(self, video_BND: Array, memory_BMD: Array, valid_BM: Array) -> Array:
        """Return (B, N, K·d)."""
        width = self.heads * self.head_dim
        q, k, v = _project(video_BND, memory_BMD, self.heads, width)
        q, k = (modules.layer_norm(x, f"norm_{n}", 1e-6) for x, n in ((q, "q"), (k, "k")))
        sink = self.param("sink", modules.zeros, (self.heads,))
        read = placement.local(_read_all, (QUERIES, KEYS, KEYS, ("batch",), ("heads",)), MIXED)
        return read(q, k, v, valid_BM, sink)


def _read_all(q: Array, k: Array, v: Array, valid_BM: Array, sink_K: Array) -> Array:
    """Return the attention over all map tokens, (B, N, K·d), on one device."""
    logits = jnp.einsum("bknd,bkmd->bknm", q, k, preferred_element_type=jnp.float32)
    logits = logits / math.sqrt(q.shape[-1])
    return layers.merge_heads(masked_attention(logits, valid_BM[:, None, None], sink_K, v))


class ProjectiveAttention(nn.Module):
    """Cross-attention by image position: cells are projected into each latent frame's cameras."""

    heads: int
    head_dim: int
    grid: int
    """Patches along the longer side of the image."""

    def _constant(self, key: Array, shape: tuple[int, int]) -> Array:
        """Initialise queries so that each head peaks at its own random point of the patch."""
        heads, head_dim = shape
        offset = jax.random.uniform(key, (heads, 2), minval=-0.5, maxval=0.5)
        angle = offset[..., None] * jnp.asarray(frequencies(head_dim, self.grid))
        size = math.sqrt(PEAK / math.sqrt(head_dim))
        return layers.rotate_halves(jnp.full(shape, size), angle.reshape(heads, -1))

    @nn.compact
    def __call__(self, video_BND: Array, memory_BMD: Array, seen: Sightings) -> Array:
        """Return (B, N, K·(d + 3)): attended features and mean position, per head."""
        dtype, heads, head_dim = video_BND.dtype, self.heads, self.head_dim
        width = heads * head_dim
        camera_of_head = np.arange(heads) % seen.angles_tqJR.shape[2]

        q, k, v = _project(video_BND, memory_BMD, heads, width)
        gain = nn.initializers.constant(0.3)

        def norm(x: Array, name: str) -> Array:
            scaled = nn.LayerNorm(
                epsilon=1e-6, use_bias=False, scale_init=gain, dtype=jnp.float32, name=name
            )
            return scaled(x).astype(dtype)

        size = math.sqrt(PEAK / math.sqrt(head_dim))
        q_constant = self.param("q_constant", self._constant, (heads, head_dim))
        k_constant = self.param("k_constant", nn.initializers.constant(size), (heads, head_dim))
        k_depth = self.param("k_depth", modules.zeros, (heads, head_dim))
        nearer = self.param("nearer", nn.initializers.constant(2.0), (heads,))
        sink = self.param("sink", modules.zeros, (heads,))

        q, k = norm(q, "norm_q"), norm(k, "norm_k")
        views = (seen.index_tqJ, seen.angles_tqJR, seen.place_tqJ3, seen.visible_tqJ)
        views = tuple(x[:, :, camera_of_head] for x in views)
        learned = (q_constant, k_constant, k_depth, nearer, sink)
        read = placement.local(
            _read_seen, (QUERIES, KEYS, KEYS, VIEWS, ("tokens",), ("heads",)), MIXED
        )
        return read(q, k, v, views, pad_angles(seen.query_angles_nR), learned)


def pad_angles(angles_nR: Array) -> Array:
    """Pad the angles of a frame's patches to a multiple of the devices that share tokens."""
    more = -len(angles_nR) % placement.parts("tokens")
    return jnp.pad(angles_nR, ((0, more), (0, 0))) if more else angles_nR


def _look(x_BKMD: Array, index_BtKJ: Array) -> Array:
    """Return (B, t, K, J, d): the tokens in view of each head's camera."""
    rows = jax.vmap(jax.vmap(lambda x, i: x[i]))(x_BKMD, index_BtKJ.swapaxes(1, 2))
    return rows.swapaxes(1, 2)


def _read_seen(
    q: Array,
    k: Array,
    v: Array,
    views: tuple[Array, ...],
    turns_nR: Array,
    learned: tuple[Array, ...],
) -> Array:
    """Return the attention over the tokens in view of each frame's cameras, on one device.

    q is (B, K, t·n, d), k and v are (B, K, M, d), normalised and without position; views are (B, t,
    K, J, …) index, angles, position and visibility; ``turns_nR`` are the angles of a frame's n
    patches.
    """
    index, angles, place, visible = views
    q_constant, k_constant, k_depth, nearer, sink = learned
    dtype, (batch, heads, _, head_dim) = q.dtype, q.shape
    log_z = place[..., 2]
    q = q + q_constant[:, None].astype(dtype)
    q = q.reshape(batch, heads, index.shape[1], -1, head_dim).transpose(0, 2, 1, 3, 4)
    q = layers.rotate_halves(q, turns_nR)
    k, v = (_look(x, index) for x in (k, v))
    k = k + k_constant[:, None].astype(dtype)
    k = k + (log_z[..., None] * k_depth[:, None]).astype(dtype)
    k = layers.rotate_halves(k, angles)

    logits = jnp.einsum("btknd,btkmd->btknm", q, k, preferred_element_type=jnp.float32)
    logits = logits / math.sqrt(head_dim) - (nearer[:, None] * log_z)[..., None, :]
    values = jnp.concatenate([v, place.astype(dtype)], -1)
    mixed = masked_attention(logits, visible[..., None, :], sink, values)
    return mixed.transpose(0, 1, 3, 2, 4).reshape(batch, -1, heads * (head_dim + 3))


class MemoryBlock(nn.Module):
    """One memory expert block."""

    config: Any
    grid: int
    """Patches along the longer side of the image."""
    layout: TokenLayout
    """The order of the video tokens."""
    always: bool = False
    """Whether the feed-forward network also runs for clips whose memory is empty."""

    @nn.compact
    def __call__(
        self,
        video_BND: Array,
        time_BE: Array,
        camera_BNC: Array,
        memory_BMD: Array,
        valid_BM: Array,
        seen: Sightings | None,
    ) -> Array:
        """Update the video tokens with the content of the map.

        Args:
            video_BND: (B, N, D) hidden states H.
            time_BE: (B, E) time embedding, or (B, t, E), one for each token in time (map tokens get
                their mean).
            camera_BNC: (B, N, C) camera embedding of each video token.
            memory_BMD: (B, M, Dm) embedded map tokens.
            valid_BM: (B, M) bool, False tokens contribute nothing.
            seen: the tokens in view of the clip's cameras, for projective positions.
        """
        config, dtype = self.config, video_BND.dtype
        width, memory_width = video_BND.shape[-1], memory_BMD.shape[-1]
        sizes = [width, width, memory_width, memory_width, width]
        modulation = modules.dense(sum(sizes) + width, dtype, "linear", zero=True)(nn.silu(time_BE))
        modulation = placement.constrain(modulation, "batch")
        parts = jnp.split(modulation, np.cumsum(sizes).tolist(), -1)
        if time_BE.ndim == 3:
            spread, mean = self.layout.per_token, functools.partial(jnp.mean, axis=1)
            apart = (spread, spread, mean, mean, spread, spread)
            parts = [turn(part) for turn, part in zip(apart, parts, strict=True)]
        shift, scale, m_shift, m_scale, m_gate, gate = parts
        query = modules.dense(width, dtype, "with_camera")(
            jnp.concatenate([video_BND, camera_BNC], -1)
        )
        query = placement.constrain(query, "batch", "tokens")
        query = layers.modulate(modules.layer_norm(query, "norm_video"), shift, scale)
        query = placement.constrain(query, "batch", "tokens")
        keys = layers.modulate(modules.layer_norm(memory_BMD, "norm_memory"), m_shift, m_scale)

        if seen is None:
            attend = SinusoidAttention(config.heads, config.head_dim, name="attention")
            mixed = attend(query, keys, valid_BM)
        else:
            attend = ProjectiveAttention(config.heads, config.head_dim, self.grid, name="attention")
            mixed = attend(query, keys, seen)
        mixed = modules.dense(width, dtype, "to_out")(mixed)

        out = placement.constrain(video_BND + layers.to_tokens(m_gate) * mixed, "batch", "tokens")
        forward = modules.FeedForward(config.mlp_ratio, name="ff")(modules.layer_norm(out, "norm2"))
        out = out + layers.to_tokens(gate) * forward
        if self.always:
            return out
        remembers = valid_BM.any(-1)[:, None, None]
        return jnp.where(remembers, out, video_BND)
