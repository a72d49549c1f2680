"""Attention and rendering side by side: at every place first the one, then the other.

Parameters are those of the two: ``camera``, ``tokens`` and ``blocks`` of the attention, and
``render``.
"""

from __future__ import annotations

import dataclasses

import jax

from pewm_jax.config import ModelConfig
from pewm_jax.models.interface import Readers
from pewm_jax.readers import attention as attention_reader
from pewm_jax.readers import render as render_reader
from pewm_jax.types import Array, Camera, MemoryReadout, Params

SHARDING = (*attention_reader.SHARDING, *render_reader.SHARDING)


def init(model: ModelConfig, key: Array) -> Params:
    """Return random parameters of both; the attention's are those that it has alone."""
    rendering = render_reader.init(model, jax.random.fold_in(key, 1))
    return {**attention_reader.init(model, key), **rendering}


def prepare(
    model: ModelConfig, params: Params, sight: MemoryReadout, camera: Camera, rays_BthwC: Array
) -> Readers:
    """Prepare both; see ``readers``."""
    attend = attention_reader.prepare(model, params, sight, camera, rays_BthwC)
    render = render_reader.prepare(model, params, sight, camera, rays_BthwC)
    if render.block is None:
        return dataclasses.replace(attend, added_BND=render.added_BND)

    def read(layer: Params, video: Array, time: Array) -> Array:
        assert attend.block is not None
        assert render.block is not None
        video = attend.block(layer["attend"], video, time)
        return render.block(layer["render"], video, time)

    stacked = {"attend": attend.params, "render": render.params}
    return Readers(read, stacked, render.added_BND)
