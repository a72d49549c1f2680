"""CogVideoX's video autoencoder as a codec: the mean of its latents, scaled to unit variance."""

from __future__ import annotations

import dataclasses
from typing import Any

from pewm_jax.errors import require
from pewm_jax.models.cogvideox import vae
from pewm_jax.models.cogvideox.config import VAEConfig
from pewm_jax.models.interface import PublishedVAE
from pewm_jax.types import Array, Params


@dataclasses.dataclass(frozen=True)
class VAECodec(VAEConfig, PublishedVAE):
    """The video autoencoder of CogVideoX; its weights come from a converted checkpoint."""

    def check(self, model: Any) -> None:
        """Refuse clips that cannot be encoded, or decode to another number of frames."""
        super().check(model)
        require(
            self.frames(model.clip.frames) % 2 == 1,
            f"clip.frames {model.clip.frames}: the VAE decodes an even number of latent frames "
            "without its first-frame rule (2 latent frames become 8 frames, not 5); use 8k + 1 "
            "frames (9, 17, 25, …).",
        )

    def init(self, key: Array) -> Params:
        """Return random parameters."""
        return vae.init(self, key)

    def encode(self, params: Params, video_BTHWC: Array, *, condition: bool = False) -> Array:
        """Encode a video to the scaled mean of its latents; see ``Codec.encode``."""
        mean, _ = vae.encode(self, params, video_BTHWC)
        return mean * self._scale(condition=condition)

    def decode(self, params: Params, latents_BthwC: Array) -> Array:
        """Decode scaled latents to q·(t − 1) + 1 frames.

        Raises:
            UserError: the VAE decodes this many latents to another number of frames.
        """
        frames = self.temporal * (latents_BthwC.shape[1] - 1) + 1
        return vae.decode(self, params, latents_BthwC / self.scaling_factor, frames=frames)

    def _scale(self, *, condition: bool) -> float:
        factor = self.scaling_factor
        return 1 / factor if condition and self.invert_scale_latents else factor
