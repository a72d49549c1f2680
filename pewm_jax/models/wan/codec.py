"""Wan's video autoencoder as a codec: the mean of its latents, each channel normalised."""

from __future__ import annotations

import dataclasses
from typing import Any

from pewm_jax.errors import require
from pewm_jax.models.interface import PublishedVAE
from pewm_jax.models.wan import vae as wan_vae
from pewm_jax.models.wan.config import WanVAEConfig
from pewm_jax.types import Array, Params


@dataclasses.dataclass(frozen=True)
class WanVAECodec(WanVAEConfig, PublishedVAE):
    """Wan's video autoencoder; its weights come from a converted checkpoint."""

    @property
    def framewise(self) -> bool:
        """Whether a latent frame is decoded by itself: no, with those before it."""
        return False

    def check(self, model: Any) -> None:
        """Refuse clips that are not encoded four frames at a time."""
        super().check(model)
        require(
            model.clip.frames % 4 == 1,
            f"clip.frames is {model.clip.frames}: this codec encodes four frames at a time after "
            "the first, so use 4k + 1 frames (5, 9, …).",
        )

    def init(self, key: Array) -> Params:
        """Return random parameters."""
        return wan_vae.init(self, key)

    def encode(self, params: Params, video_BTHWC: Array, *, condition: bool = False) -> Array:
        """Encode a video to the mean of its latents."""
        del condition
        mean, _ = wan_vae.encode(self, params, video_BTHWC)
        return wan_vae.normalise(self, mean)

    def decode(self, params: Params, latents_BthwC: Array) -> Array:
        """Decode normalised latents to q·(t − 1) + 1 frames."""
        return wan_vae.decode(self, params, wan_vae.restore(self, latents_BthwC))
