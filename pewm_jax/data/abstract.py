"""Shapes and types of frames and batches, for compiling before anything is read."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from pewm_jax.config import Config
from pewm_jax.types import Camera, Clip, Frames

ACTION = 3
"""Numbers of a recorded action: metres forward, metres left, radians to the left."""


def camera(*lead: int) -> Camera:
    """Return cameras of a leading shape."""
    return Camera(array(*lead, 4), array(*lead, 4, 4))


def frames(*lead: int, height: int, width: int, colours: Any = np.uint8) -> Frames:
    """Return frames of a leading shape (…, T); ``colours`` is the dtype of the colours."""
    return Frames(
        array(*lead, height, width, 3, dtype=colours), array(*lead, height, width), camera(*lead)
    )


def clip(config: Config, batch: int, *, features: bool = False, actions: bool = True) -> Clip:
    """Return a batch as the loader makes it.

    Args:
        config: the experiment.
        batch: clips.
        features: whether the context's features are in it, where ``data.features`` keeps them.
        actions: whether actions were recorded.
    """
    size, context, kept = config.model.clip, config.data.context, None
    if features and config.data.features:
        encoder = config.model.memory.encoder
        shape = (batch, context, *encoder.grid(size), encoder.channels)
        kept = array(*shape, dtype=np.float16)
    control = getattr(config.model, "control", None)  # a world that is not steered has none
    width = getattr(control, "actions", 0) or ACTION
    pixels = {"height": size.height, "width": size.width}
    side = getattr(getattr(config.model, "memory", None), "recorded", 0)  # cells of grids, if any
    cells = (batch, size.frames, side, side, side)
    return Clip(
        frames(batch, size.frames, **pixels),
        frames(batch, context, **pixels),
        array(batch, context, dtype=np.bool_),
        kept,
        array(batch, size.frames - 1, width) if actions else None,
        array(*cells, dtype=np.uint16) if side else None,
        array(batch, size.frames, 3) if side else None,
    )


def array(*shape: int, dtype: Any = np.float32) -> jax.ShapeDtypeStruct:
    """Return one array of a shape."""
    return jax.ShapeDtypeStruct(shape, dtype)
