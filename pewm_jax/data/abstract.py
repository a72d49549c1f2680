"""Abstract frames, controls and batches (shapes and dtypes), for compiling before data is read."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from pewm_jax.config import Config, World
from pewm_jax.config.world import PLANAR
from pewm_jax.types import Array, Camera, Clip, Control, Frames


def camera(*lead: int) -> Camera:
    """Return abstract cameras with the leading shape ``lead``."""
    return Camera(array(*lead, 4), array(*lead, 4, 4))


def frames(*lead: int, height: int, width: int, colours: Any = np.uint8) -> Frames:
    """Return abstract frames with a leading shape (…, T); ``colours`` is the dtype of ``rgb``."""
    return Frames(
        array(*lead, height, width, 3, dtype=colours), array(*lead, height, width), camera(*lead)
    )


def clip(config: Config, batch: int, *, features: bool = False, actions: bool = True) -> Clip:
    """Return an abstract batch like those of the loader.

    ``features`` adds the context's cached features (``data.features``), ``actions`` recorded
    actions.
    """
    size, asked = config.model.clip, config.model.batch_spec
    context = config.data.context if asked.context else 0
    pixels = {"height": size.height, "width": size.width}
    extras = {
        name: array(batch, *one.shape, dtype=np.dtype(one.dtype)) for name, one in asked.extras
    }
    kept = asked.features if features and config.data.features else None
    if kept is not None:
        shape = (batch, context, *kept.shape)
        extras["context_features_ShwF"] = array(*shape, dtype=np.dtype(kept.dtype))
    return Clip(
        frames(batch, size.frames, **pixels),
        frames(batch, context, **pixels),
        array(batch, context, dtype=np.bool_),
        array(batch, size.frames - 1, asked.actions or PLANAR) if actions else None,
        extras,
    )


def control(world: World, *lead: int) -> Array | Control:
    """Return what steers a world through steps of leading shape ``lead``, (…, n).

    It is planar actions, or cameras with recorded actions and the agent's state if the world needs
    them.
    """
    asked = world.batch_spec
    if asked.actions in (0, PLANAR):
        return array(*lead, PLANAR)
    state = dict(asked.extras).get("state_A")
    return Control(
        camera(*lead),
        array(*lead, asked.actions),
        None if state is None else array(*lead[:-1], *state.shape),
    )


def array(*shape: int, dtype: Any = np.float32) -> jax.ShapeDtypeStruct:
    """Return an abstract array."""
    return jax.ShapeDtypeStruct(shape, dtype)
