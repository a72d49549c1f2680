"""Attention and rendering together: at every injection point first attention, then rendering.

Parameters are those of the two: ``camera``, ``tokens`` and ``blocks`` of the attention, and
``render``.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax

from pewm_jax.config import AssembledModel
from pewm_jax.config.parts import Rules
from pewm_jax.models.interface import Readers
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.readers.render import RenderConfig
from pewm_jax.types import Array, Camera, MemoryReadout, Params


@dataclasses.dataclass(frozen=True)
class BothConfig(AttentionConfig, RenderConfig):
    """Cross-attention and rendering, one after the other at every place."""

    SHARDING: ClassVar[Rules] = (*AttentionConfig.SHARDING, *RenderConfig.SHARDING)

    READS_TOKENS: ClassVar[bool] = True
    READS_VIEW: ClassVar[bool] = True

    def init(self, model: AssembledModel, key: Array) -> Params:
        """Return random parameters of both; the attention's are those that it has alone."""
        rendering = RenderConfig.init(self, model, jax.random.fold_in(key, 1))
        return {**AttentionConfig.init(self, model, key), **rendering}

    def prepare(
        self,
        model: AssembledModel,
        params: Params,
        readout: MemoryReadout,
        camera: Camera,
        rays_BthwC: Array,
    ) -> Readers:
        """Prepare both; see ``Reader.prepare``."""
        attend = AttentionConfig.prepare(self, model, params, readout, camera, rays_BthwC)
        render = RenderConfig.prepare(self, model, params, readout, camera, rays_BthwC)
        if render.block is None:
            return dataclasses.replace(attend, added_BND=render.added_BND)

        def read(layer: Params, video: Array, time: Array) -> Array:
            assert attend.block is not None
            assert render.block is not None
            video = attend.block(layer["attend"], video, time)
            return render.block(layer["render"], video, time)

        stacked = {"attend": attend.params, "render": render.params}
        return Readers(read, stacked, render.added_BND)

    def check(self, model: Any) -> None:
        """Refuse what either of the two refuses."""
        AttentionConfig.check(self, model)
        RenderConfig.check(self, model)

    def __post_init__(self):
        """Validate."""
        AttentionConfig.__post_init__(self)
        RenderConfig.__post_init__(self)
