"""The paper's memory reader: a cross-attention block after every block of the backbone.

Parameters: ``camera`` embeds the rays of each video token, ``tokens`` embeds the map tokens, and
``blocks`` holds the memory blocks, stacked. Gates start at zero, so a fresh reader changes nothing.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.config import AttentionConfig, ModelConfig
from pewm_jax.controls.camera import CameraConfig
from pewm_jax.models.interface import Readers
from pewm_jax.nn import modules
from pewm_jax.nn.costs import (
    FLOAT,
    SPLIT,
    Costs,
    Product,
    Share,
    text_tokens,
    video_times,
    video_tokens,
)
from pewm_jax.nn.tokens import TokenLayout, patchify
from pewm_jax.readers.geometry import Sightings, patch_pixels, sightings, sinusoid_3d
from pewm_jax.readers.memory_block import MemoryBlock
from pewm_jax.types import Array, Camera, MemoryReadout, Params

REPLICATED = P()

SHARDING = (
    (r"memory/blocks/(attention/to_[qkv]|ff/up|linear)/kernel", P("fsdp", "tensor")),
    (r"memory/blocks/(attention/to_[qkv]|ff/up|linear)/bias", P("tensor")),
    (r"memory/blocks/(to_out|ff/down)/kernel", P("tensor", "fsdp")),
    (r"memory/blocks/with_camera/kernel", P(None, "fsdp")),
    (r"memory/(camera|tokens)/kernel", P(None, "fsdp")),
    (r"memory/blocks/attention/([qk]_constant|k_depth)", P("tensor", None)),
    (r"memory/blocks/attention/(nearer|sink)", P("tensor")),
    (r"memory/blocks/(to_out|ff/down|with_camera)/bias", REPLICATED),
    (r"memory/(camera|tokens)/bias", REPLICATED),
    (r"memory/blocks/(attention/norm_[qk]|norm_video|norm_memory|norm2)/(scale|bias)", REPLICATED),
)

STREAMS = (14, 34)
"""How often element-wise work reads or writes a block's tokens: forward, backward."""
SINUSOID = 60
"""Channels of a position encoded as a sinusoid."""


def token_channels(model: ModelConfig) -> int:
    """Return the channels of a map token: its features and, if sinusoidal, its position."""
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


def _embeddings(model: ModelConfig) -> tuple[modules.nn.Dense, modules.nn.Dense]:
    """Return the linear layers that embed rays (one vector per video token) and map tokens."""
    dtype = jnp.dtype(model.dtype)
    camera = modules.dense(model.backbone.places.width // 2, dtype, "camera")
    # A layer norm follows, which would discard the magnitude of the features. A random bias of
    # unit variance keeps it visible.
    constant = modules.nn.initializers.normal(1.0)
    width = _settings(model).width
    tokens = modules.nn.Dense(width, dtype=dtype, bias_init=constant, name="tokens")
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
    model: ModelConfig, params: Params, sight: MemoryReadout, camera: Camera, rays_BthwC: Array
) -> Readers:
    """Embed rays and map tokens, and choose the tokens each camera attends to; see ``readers``."""
    config, places, dtype = _settings(model), model.backbone.places, jnp.dtype(model.dtype)
    missing = -rays_BthwC.shape[1] % places.patch_t
    rays = jnp.concatenate([rays_BthwC[:, :1]] * missing + [rays_BthwC], 1).astype(dtype)
    layout = TokenLayout.for_mesh(text_tokens(model), *video_tokens(model))
    camera_layer, token_layer = _embeddings(model)
    patches = patchify(rays, places.patch, places.patch_t)
    looks_from = layout.spread(camera_layer.apply({"params": params["camera"]}, patches))

    seen = sight.tokens
    assert seen is not None
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
    """Return the costs of the memory blocks, all of which are trained."""
    config, places = _settings(model), model.backbone.places
    frames, patches = video_tokens(model)
    video, joint = frames * patches, frames * patches + text_tokens(model)
    remat = bool(model.backbone.remat)
    whole = share.clips * joint * places.width * share.activation_bytes / share.context
    each = share.clips * video / share.context / share.tensor
    per_channel = each * share.activation_bytes
    tokens, inner = per_channel * places.width, per_channel * config.width
    hidden, logits = tokens * config.mlp_ratio, each * _attended(model) * config.heads * FLOAT
    if remat:
        kept, block = 0.0, 5 * hidden + 4 * inner + 3.3 * logits
    else:
        kept = places.count * (10 * tokens + 6 * hidden + 4.5 * inner + 3.3 * logits)
        block = 0.0
    forward, backward = STREAMS
    return Costs(
        products=_products(model, video, again=float(remat)),
        kept=kept,
        block=block,
        streamed=places.count * whole * (forward * (1 + remat) + backward),
        summed=2 * places.count * (2 + remat) * whole,
    )


def _attended(model: ModelConfig) -> int:
    """Return the number of map tokens that one query attends to."""
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
    attention = depth * video * _attended(model) * (2 * inner + place)
    ends = video * _ray_channels(model) * (width // 2) + tokens * token_channels(model) * inner
    return (
        Product("memory", "linear", camera, 2.0, again, ("context",)),
        Product("memory", "linear", mixed, 2.0, again, SPLIT),
        Product("memory", "linear", keys, 2.0, again, ("tensor",)),
        Product("memory", "linear", modulation, 1.0, again, ("tensor",)),
        Product("memory", "attention", attention, 2.0, again, SPLIT),
        Product("memory", "linear", ends, 1.0),
    )
