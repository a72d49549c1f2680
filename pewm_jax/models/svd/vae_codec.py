"""Stable Video Diffusion's autoencoder as a codec: the mean of its latents, scaled, or not.

The latents of what is denoised are scaled to unit variance; those of the image that conditions are
not, as in the reference's pipeline.
"""

from __future__ import annotations

import dataclasses

from pewm_jax.models.interface import PublishedVAE
from pewm_jax.models.svd import vae as svd_vae
from pewm_jax.models.svd.config import SVDVAEConfig
from pewm_jax.types import Array, Params


@dataclasses.dataclass(frozen=True)
class SVDVAECodec(SVDVAEConfig, PublishedVAE):
    """The autoencoder of Stable Video Diffusion; its weights come from a converted checkpoint."""

    @property
    def framewise(self) -> bool:
        """Whether a latent frame is decoded by itself: no, with its neighbours."""
        return False

    def init(self, key: Array) -> Params:
        """Return random parameters."""
        return svd_vae.init(self, key)

    def encode(self, params: Params, video_BTHWC: Array, *, condition: bool = False) -> Array:
        """Encode a video to the mean of its latents."""
        mean = svd_vae.encode(self, params, video_BTHWC)
        return mean if condition else mean * self.scaling_factor

    def decode(self, params: Params, latents_BthwC: Array) -> Array:
        """Decode scaled latents to as many frames, all of a clip together."""
        return svd_vae.decode(self, params, latents_BthwC / self.scaling_factor)
