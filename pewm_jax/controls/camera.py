"""Control by cameras: Plücker rays relative to the first camera, concatenated to the input."""

from __future__ import annotations

import jax

from pewm_jax.config import ModelConfig
from pewm_jax.geometry.plucker import camera_latents
from pewm_jax.models.interface import Conditioning
from pewm_jax.nn.costs import Costs, Share
from pewm_jax.types import Array, Camera, Control, Frames, Params

SHARDING = ()
"""It has no parameters."""


def init(model: ModelConfig, key: Array) -> Params:
    """Return the parameters: none."""
    del model, key
    return {}


def rays(model: ModelConfig, camera: Camera) -> Array:
    """Return (B, t, h, w, 6·q) Plücker rays of (B, T) cameras at the latent rate."""
    clip, codec = model.clip, model.codec
    return jax.vmap(
        lambda c: camera_latents(c, clip.height, clip.width, codec.spatial, codec.temporal)
    )(camera)


def condition(
    model: ModelConfig, params: Params, observed: Frames, control: Control
) -> Conditioning:
    """Return the cameras' rays as input channels; see ``controls.condition``."""
    del params, observed
    return Conditioning(joined_BthwC=rays(model, control.camera))


def costs(model: ModelConfig, share: Share, *, trained: bool) -> Costs:
    """Return the costs, which are negligible."""
    del model, share, trained
    return Costs()
