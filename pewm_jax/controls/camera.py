"""Control by cameras: Plücker rays relative to the first camera, concatenated to the input."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax

from pewm_jax.config.parts import Conditioner
from pewm_jax.geometry.cameras import camera_latents
from pewm_jax.models.interface import Conditioning
from pewm_jax.types import Array, Camera, Control, Frames, Params


@dataclasses.dataclass(frozen=True)
class CameraConfig(Conditioner):
    """Control by cameras (the paper): their Plücker rays are concatenated to the input."""

    def channels(self, model: Any) -> int:
        """Return six Plücker coordinates for each frame of a latent frame."""
        return 6 * model.codec.temporal

    def condition(
        self, model: Any, params: Params, observed: Frames, control: Control
    ) -> Conditioning:
        """Return the cameras' rays as input channels."""
        del params, observed
        return Conditioning(joined_BthwC=rays(model, control.camera))


def rays(model: Any, camera: Camera) -> Array:
    """Return (B, t, h, w, 6·q) Plücker rays of (B, T) cameras at the latent rate."""
    clip, codec = model.clip, model.codec
    return jax.vmap(
        lambda c: camera_latents(c, clip.height, clip.width, codec.spatial, codec.temporal)
    )(camera)
