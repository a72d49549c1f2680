"""The paper's memory reader: a cross-attention block after every block of the backbone.

Parameters: ``camera`` embeds the rays of each video token, ``tokens`` embeds the map tokens, and
``blocks`` holds the memory blocks, stacked. Gates start at zero, so a fresh reader changes nothing.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.config import AssembledModel
from pewm_jax.config.parts import Reader, Rules
from pewm_jax.controls.camera import CameraConfig
from pewm_jax.errors import require, require_positive
from pewm_jax.models.interface import Readers
from pewm_jax.nn import modules
from pewm_jax.nn.tokens import (
    TokenLayout,
    patchify,
    text_tokens,
    video_tokens,
)
from pewm_jax.readers.geometry import (
    Sightings,
    init_stacked,
    pad_time,
    patch_pixels,
    sightings,
    sinusoid_3d,
)
from pewm_jax.readers.memory_block import MemoryBlock
from pewm_jax.types import Array, Camera, MemoryReadout, Params

REPLICATED = P()

_RULES = (
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

SINUSOID = 60
"""Channels of a position encoded as a sinusoid."""


def token_channels(model: AssembledModel) -> int:
    """Return the channels of a map token: features and, if sinusoidal, its position."""
    positions = SINUSOID if _settings(model).positions == "sinusoid" else 0
    return model.memory.encoder.channels + positions


def _settings(model: AssembledModel) -> AttentionConfig:
    return model.memory.reader  # type: ignore[return-value]


def _ray_channels(model: AssembledModel) -> int:
    """Return the channels of the rays of one video token."""
    places = model.backbone.places
    return CameraConfig().channels(model) * places.patch**2 * places.patch_t


def _embeddings(model: AssembledModel) -> tuple[modules.Dense, modules.Dense]:
    """Return the linear layers of rays (one vector per video token) and map tokens."""
    dtype = jnp.dtype(model.dtype)
    camera = modules.dense(model.backbone.places.width // 2, dtype, "camera")
    # The layer norm that follows discards the magnitude of the features; a random bias of unit
    # variance preserves it.
    constant = modules.nn.initializers.normal(1.0)
    width = _settings(model).width
    tokens = modules.Dense(width, dtype=dtype, bias_init=constant, name="tokens")
    return camera, tokens


def _block(model: AssembledModel, layout: TokenLayout) -> MemoryBlock:
    grid = max(model.clip.height, model.clip.width) // patch_pixels(model)
    return MemoryBlock(_settings(model), grid, layout, always=not model.memory.REMEMBERS)


@dataclasses.dataclass(frozen=True)
class AttentionConfig(Reader):
    """Cross-attention from video tokens to map tokens, after every block of the backbone."""

    SHARDING: ClassVar[Rules] = _RULES

    positions: Literal["projective", "sinusoid"] = "projective"
    """How cell positions are encoded: `projective` (image coordinates in each frame's camera) or
    `sinusoid` (the paper's 3D sinusoid of the position)."""
    frame: Literal["camera", "world"] = "camera"
    """The frame of `sinusoid` positions: the clip's first camera, or the world."""
    looks: int = 128
    """Map tokens that each camera attends to, with projective positions."""
    heads: int = 6
    """Attention heads."""
    head_dim: int = 32
    """Width of a head; a multiple of 8."""
    mlp_ratio: int = 4
    """Feed-forward width over model width."""

    @property
    def split_heads(self) -> int:
        """The number that ``train.mesh.tensor`` must divide."""
        return self.heads

    @property
    def width(self) -> int:
        """Channels of all heads together."""
        return self.heads * self.head_dim

    def check(self, model: Any) -> None:
        """Refuse fewer heads than there are cameras per token."""
        cameras = model.codec.temporal * model.backbone.places.patch_t
        require(
            self.positions == "sinusoid" or self.heads >= cameras,
            f"memory.reader.heads is {self.heads}: with projective positions head k uses "
            f"camera k mod {cameras} (codec.temporal × backbone.patch_t) of a token's frames; use "
            f"at least {cameras} heads, or memory.reader.positions sinusoid.",
        )

    def init(self, model: AssembledModel, key: Array) -> Params:
        """Return random parameters; the blocks' gates are zero."""
        places = model.backbone.places
        camera, tokens = _embeddings(model)
        camera_key, tokens_key, blocks_key = jax.random.split(key, 3)
        half = self.head_dim // 2
        q = model.codec.temporal * places.patch_t
        seen = None
        if self.positions == "projective":
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
            jnp.zeros((1, 1, self.width)),
            jnp.ones((1, 1), bool),
            seen,
        )
        block = _block(model, TokenLayout(1, 0, 1, 1))
        blocks = init_stacked(block, blocks_key, places.count, example)
        rays, channels = jnp.zeros((1, _ray_channels(model))), jnp.zeros((1, token_channels(model)))
        return {
            "camera": camera.init(camera_key, rays)["params"],
            "tokens": tokens.init(tokens_key, channels)["params"],
            "blocks": blocks,
        }

    def prepare(
        self,
        model: AssembledModel,
        params: Params,
        readout: MemoryReadout,
        camera: Camera,
        rays_BthwC: Array,
    ) -> Readers:
        """Embed rays and map tokens, and select the tokens that each camera attends to."""
        places, dtype = model.backbone.places, jnp.dtype(model.dtype)
        rays = pad_time(rays_BthwC, places.patch_t).astype(dtype)
        layout = TokenLayout.for_mesh(text_tokens(model), *video_tokens(model))
        camera_layer, token_layer = _embeddings(model)
        patches = patchify(rays, places.patch, places.patch_t)
        looks_from = layout.spread(camera_layer.apply({"params": params["camera"]}, patches))

        seen = readout.tokens
        assert seen is not None
        valid, sights = seen.valid_M, None
        points, features = (
            jnp.where(valid[..., None], x, 0) for x in (seen.points_world_M3, seen.features_MF)
        )
        if self.positions == "projective":
            sights = sightings(model, self, camera, points, valid)
        else:
            place = sinusoid_3d(model, self, camera, points)
            features = jnp.concatenate([features, place], -1)
        embedded = token_layer.apply({"params": params["tokens"]}, features.astype(dtype))
        block = _block(model, layout)

        def read(layer: Params, video: Array, time: Array) -> Array:
            return block.apply({"params": layer}, video, time, looks_from, embedded, valid, sights)

        return Readers(read, params["blocks"])

    def __post_init__(self):
        """Validate."""
        require_positive(self, "memory.reader", "looks", "heads", "head_dim", "mlp_ratio")
        require(
            self.head_dim % 8 == 0,
            f"memory.reader.head_dim is {self.head_dim}: use a multiple of 8, the projective "
            "rotary embedding splits a head in two times two halves.",
        )
