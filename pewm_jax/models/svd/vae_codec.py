"""Stable Video Diffusion's autoencoder as a codec: the mean of its latents, scaled, or not.

The latents of what is denoised are scaled to unit variance; those of the image that conditions are
not, as in the reference's pipeline.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar

from jax.sharding import PartitionSpec as P

from pewm_jax.config.parts import Codec, Rules
from pewm_jax.models.svd import vae as svd_vae
from pewm_jax.models.svd.config import SVDVAEConfig
from pewm_jax.nn.costs import Costs, Product, Share
from pewm_jax.types import Array, Params

PASSES = 60
"""How often encoding a frame reads or writes as many values as its widest array has."""
HELD = 4
"""Peak memory of encoding a clip, in copies of its widest array."""


@dataclasses.dataclass(frozen=True)
class SVDVAECodec(SVDVAEConfig, Codec):
    """The autoencoder of Stable Video Diffusion; its weights come from a converted checkpoint."""

    SHARDING: ClassVar[Rules] = (
        (r"codec/.*/kernel", P(None, "fsdp")),
        (r"codec/.*/(scale|bias|mix)", P()),
    )
    """Weights are stored sharded and gathered for use; each device encodes its own clips."""
    DEPTH_AS_GREY: ClassVar[bool] = True
    CONVERTED: ClassVar[bool] = True

    @property
    def framewise(self) -> bool:
        """Whether a latent frame is decoded by itself: no, with its neighbours."""
        return False

    @property
    def rgb_channels(self) -> int:
        """Latent channels of colour."""
        return self.latent_channels

    @property
    def depth_channels(self) -> int:
        """Latent channels of depth."""
        return self.latent_channels * self.depth

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

    def costs(self, model: Any, share: Share) -> Costs:
        """Return the costs of encoding the clip and its first frame, and depth with ``depth``."""
        clip = model.clip
        kinds = 1 + self.depth
        frames = kinds * (clip.frames + 1)
        widest = clip.height * clip.width * self.widths[0] * share.activation_bytes
        cells = clip.height * clip.width // self.spatial**2
        attention = frames * 2 * cells**2 * self.widths[-1]
        return Costs(
            products=(
                Product(
                    "codec", "convolution", frames * _encode_macs(self, clip.height, clip.width)
                ),
                Product("codec", "attention", attention),
            ),
            streamed=PASSES * share.clips * frames * widest,
            held=HELD * kinds * clip.frames * widest,
        )


def _encode_macs(config: SVDVAEConfig, height: int, width: int) -> float:
    """Return the multiply-adds of the encoder's convolutions and linear layers, of one frame."""
    total = 0.0
    last = len(config.widths) - 1
    for path, shape in svd_vae.layout(config).items():
        if not (path.startswith("encoder/") and path.endswith("kernel")):
            continue
        name = path.split("/")[1]
        level = int(name.removeprefix("down_")) if name.startswith("down_") else last
        if name == "conv_in":
            level = 0
        halved = level + ("resample" in path)
        total += (height >> halved) * (width >> halved) * math.prod(shape)
    return total
