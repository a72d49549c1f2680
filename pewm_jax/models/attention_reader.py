"""The paper's reader: an expert block of cross-attention after every block of the backbone.

Parameters: ``camera`` (rays → per token), ``tokens`` (map tokens → width of the attention) and
``blocks``, stacked over the backbone's places. Their gates start at zero: nothing changes at first.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.config import AttentionConfig, CameraConfig, ModelConfig
from pewm_jax.models import layers
from pewm_jax.models.backbones import Readers
from pewm_jax.models.costs import (
    FLOAT,
    SPLIT,
    Costs,
    Product,
    Share,
    text_tokens,
    video_times,
    video_tokens,
)
from pewm_jax.models.dit import patchify
from pewm_jax.models.memory_block import MemoryBlock
from pewm_jax.models.memory_geometry import Sightings, patch_pixels, sightings, sinusoid_3d
from pewm_jax.models.token_layout import TokenLayout
from pewm_jax.types import Array, Camera, MapTokens, Params

WHOLE = P()

SHARDING = (
    (r"memory/blocks/(attention/to_[qkv]|ff/up|linear)/kernel", P("fsdp", "tensor")),
    (r"memory/blocks/(attention/to_[qkv]|ff/up|linear)/bias", P("tensor")),
    (r"memory/blocks/(to_out|ff/down)/kernel", P("tensor", "fsdp")),
    (r"memory/blocks/with_camera/kernel", P(None, "fsdp")),
    (r"memory/(camera|tokens)/kernel", P(None, "fsdp")),
    (r"memory/blocks/attention/([qk]_constant|k_depth)", P("tensor", None)),
    (r"memory/blocks/attention/(nearer|sink)", P("tensor")),
    (r"memory/blocks/(to_out|ff/down|with_camera)/bias", WHOLE),
    (r"memory/(camera|tokens)/bias", WHOLE),
    (r"memory/blocks/(attention/norm_[qk]|norm_video|norm_memory|norm2)/(scale|bias)", WHOLE),
)

STREAMS = (14, 34)
"""Times that a block's tokens are read or written by element-wise work, forward and backward."""
SINUSOID = 60
"""Channels of a position as a sinusoid."""


def token_channels(model: ModelConfig) -> int:
    """Return the channels of a map token: features and, with sinusoid positions, its place."""
    positions = SINUSOID if _settings(model).positions == "sinusoid" else 0
    return model.memory.encoder.channels + positions


def _settings(model: ModelConfig) -> AttentionConfig:
    config = model.memory.reader
    assert isinstance(config, AttentionConfig)
    return config


def _ray_channels(model: ModelConfig) -> int:
    """Return the channels of the rays of one video token."""
    places = model.backbone.places
    return CameraConfig().channels(model) * places.patch**2 * places.patch_t


def _embeddings(model: ModelConfig) -> tuple[layers.nn.Dense, layers.nn.Dense]:
    """Return the embeddings of rays (per video token) and of map tokens."""
    dtype = jnp.dtype(model.dtype)
    camera = layers.dense(model.backbone.places.width // 2, dtype, "camera")
    # The layer norm that follows would forget how large a feature is; next to a constant of
    # size 1 in random directions it keeps it.
    constant = layers.nn.initializers.normal(1.0)
    width = _settings(model).width
    tokens = layers.nn.Dense(width, dtype=dtype, bias_init=constant, name="tokens")
    return camera, tokens


def _block(model: ModelConfig, layout: TokenLayout) -> MemoryBlock:
    grid = max(model.clip.height, model.clip.width) // patch_pixels(model)
    return MemoryBlock(_settings(model), grid, layout, always=not model.memory.REMEMBERS)


def init(model: ModelConfig, key: Array) -> Params:
    """Return random parameters; the blocks' gates are zero."""
    config, places = _settings(model), model.backbone.places
    camera, tokens = _embeddings(model)
    camera_key, tokens_key, blocks_key = jax.random.split(key, 3)
    half = config.head_dim // 2
    q = model.codec.temporal * places.patch_t
    seen = None
    if config.positions == "projective":
        seen = Sightings(
            jnp.zeros((1, 1, q, 1), jnp.int32),
            jnp.zeros((1, 1, q, 1, half)),
            jnp.zeros((1, 1, q, 1, 3)),
            jnp.ones((1, 1, q, 1), bool),
            jnp.zeros((1, half)),
        )
    example = (
        jnp.zeros((1, 1, places.width)),
        jnp.zeros((1, places.time)),
        jnp.zeros((1, 1, places.width // 2)),
        jnp.zeros((1, 1, config.width)),
        jnp.ones((1, 1), bool),
        seen,
    )
    block = _block(model, TokenLayout(1, 0, 1, 1))
    blocks = jax.vmap(lambda k: block.init(k, *example)["params"])(
        jax.random.split(blocks_key, places.count)
    )
    rays, channels = jnp.zeros((1, _ray_channels(model))), jnp.zeros((1, token_channels(model)))
    return {
        "camera": camera.init(camera_key, rays)["params"],
        "tokens": tokens.init(tokens_key, channels)["params"],
        "blocks": blocks,
    }


def prepare(
    model: ModelConfig, params: Params, seen: MapTokens, camera: Camera, rays_BthwC: Array
) -> Readers:
    """Embed rays and map tokens, and say which tokens each camera looks at; see ``readers``."""
    config, places, dtype = _settings(model), model.backbone.places, jnp.dtype(model.dtype)
    missing = -rays_BthwC.shape[1] % places.patch_t
    rays = jnp.concatenate([rays_BthwC[:, :1]] * missing + [rays_BthwC], 1).astype(dtype)
    layout = TokenLayout.here(text_tokens(model), *video_tokens(model))
    camera_layer, token_layer = _embeddings(model)
    patches = patchify(rays, places.patch, places.patch_t)
    looks_from = layout.spread(camera_layer.apply({"params": params["camera"]}, patches))

    valid, sights = seen.valid_M, None
    points, features = (
        jnp.where(valid[..., None], x, 0) for x in (seen.points_world_M3, seen.features_MF)
    )
    if config.positions == "projective":
        sights = sightings(model, config, camera, points, valid)
    else:
        place = sinusoid_3d(model, config, camera, points)
        features = jnp.concatenate([features, place], -1)
    embedded = token_layer.apply({"params": params["tokens"]}, features.astype(dtype))
    block = _block(model, layout)

    def read(layer: Params, video: Array, time: Array) -> Array:
        return block.apply({"params": layer}, video, time, looks_from, embedded, valid, sights)

    return Readers(read, params["blocks"])


def costs(model: ModelConfig, share: Share) -> Costs:
    """Return the memory blocks' costs; all are trained."""
    config, places = _settings(model), model.backbone.places
    frames, patches = video_tokens(model)
    video, joint = frames * patches, frames * patches + text_tokens(model)
    remat = bool(model.backbone.remat)
    whole = share.clips * joint * places.width * share.wide / share.context
    each = share.clips * video / share.context / share.tensor
    wide, inner = each * places.width * share.wide, each * config.width * share.wide
    wider, table = wide * config.mlp_ratio, each * _seen(model) * config.heads * FLOAT
    if remat:
        kept, block = 0.0, 5 * wider + 4 * inner + 3.3 * table
    else:
        kept, block = places.count * (10 * wide + 6 * wider + 4.5 * inner + 3.3 * table), 0.0
    forward, backward = STREAMS
    return Costs(
        products=_products(model, video, again=float(remat)),
        kept=kept,
        block=block,
        streamed=places.count * whole * (forward * (1 + remat) + backward),
        summed=2 * places.count * (2 + remat) * whole,
    )


def _seen(model: ModelConfig) -> int:
    """Return how many map tokens a query looks at."""
    config, tokens = _settings(model), model.memory.tokens
    return min(config.looks, tokens) if config.positions == "projective" else tokens


def _products(model: ModelConfig, video: int, again: float) -> tuple[Product, ...]:
    config, places, tokens = _settings(model), model.backbone.places, model.memory.tokens
    depth, width, inner = places.count, places.width, config.width
    place = 3 * config.heads if config.positions == "projective" else 0
    camera = depth * video * width * (width + width // 2)
    mixed = depth * video * width * (2 * inner + place + 2 * config.mlp_ratio * width)
    keys = depth * 2 * tokens * inner * inner
    modulation = video_times(model) * depth * places.time * (4 * width + 2 * inner)
    attention = depth * video * _seen(model) * (2 * inner + place)
    ends = video * _ray_channels(model) * (width // 2) + tokens * token_channels(model) * inner
    return (
        Product("memory", "linear", camera, 2.0, again, ("context",)),
        Product("memory", "linear", mixed, 2.0, again, SPLIT),
        Product("memory", "linear", keys, 2.0, again, ("tensor",)),
        Product("memory", "linear", modulation, 1.0, again, ("tensor",)),
        Product("memory", "attention", attention, 2.0, again, SPLIT),
        Product("memory", "linear", ends, 1.0),
    )
