"""The codec as image encoder: the memory keeps the latents in which the denoiser thinks.

Features of a frame are the codec's normalised latents of its colours, at the grid of the latents;
depth says where they are, and is not encoded. There are no parameters beside the codec's.
"""

from __future__ import annotations

import jax.numpy as jnp

from pewm_jax.codecs import interface as codecs
from pewm_jax.config import LatentsConfig, ModelConfig
from pewm_jax.encoders.interface import principal_colours
from pewm_jax.nn.costs import Costs, Share
from pewm_jax.types import Array, Params

SHARDING = ()
"""It has no parameters of its own."""

colours = principal_colours


def init(config: LatentsConfig, key: Array) -> Params:
    """Return the parameters: none."""
    del config, key
    return {}


def features(model: ModelConfig, params: Params, rgb_THWC: Array) -> Array:
    """Return (T, H/s, W/s, C) latents of colours in float32; see ``encoders.features``."""
    video = rgb_THWC[None].astype(jnp.dtype(model.dtype))
    latents = codecs.encode(model.codec, params.get("codec", {}), video)
    return latents[0].astype(jnp.float32)


def costs(model: ModelConfig, share: Share, frames: int) -> Costs:
    """Return the costs of encoding the colours of all context frames."""
    return codecs.costs_of_images(model, share, frames, "encoder")
