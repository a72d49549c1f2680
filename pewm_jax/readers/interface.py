"""Memory readers: one interface, chosen by the type of the settings.

A reader is a ``Reader`` and a module (or object) with

    init(model, key) -> params                          under ``memory/``; has no effect at first
    prepare(model, params, sight, camera, rays_BthwC) -> Readers
    SHARDING                                            rules over ``memory/…`` paths

``models.attention_reader`` is an example.
"""

from __future__ import annotations

from pewm_jax.config import ModelConfig, functions
from pewm_jax.models.interface import Readers
from pewm_jax.types import Array, Camera, MemoryReadout, Params


def init(model: ModelConfig, key: Array) -> Params:
    """Return random parameters, initialised so that the reader has no effect yet."""
    return functions(model.memory.reader).init(model, key)


def prepare(
    model: ModelConfig, params: Params, sight: MemoryReadout, camera: Camera, rays_BthwC: Array
) -> Readers:
    """Prepare to read the memories of a batch of clips.

    Args:
        model: the model.
        params: the reader's parameters.
        sight: what the memory shows each clip, leading axis B; it has what the reader's settings
            ask for (``READS_TOKENS``, ``READS_VIEW``, ``READS_LATENTS``).
        camera: (B, T) cameras of the clips.
        rays_BthwC: their Plücker rays at the latent rate (``camera_control.rays``).

    Returns:
        The functions that the backbone calls.
    """
    return functions(model.memory.reader).prepare(model, params, sight, camera, rays_BthwC)
