"""CogVideoX's video autoencoder as a codec: the mean of its latents, scaled to unit variance."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar

from jax.sharding import PartitionSpec as P

from pewm_jax.config.parts import Codec, Rules
from pewm_jax.errors import require
from pewm_jax.models.cogvideox import vae
from pewm_jax.models.cogvideox.config import VAEConfig
from pewm_jax.models.cogvideox.vae_layers import layout
from pewm_jax.nn.costs import Costs, Product, Share
from pewm_jax.types import Array, Params

PASSES = 70
"""How often encoding a clip reads or writes as many values as its widest array has."""
HELD = 4.4
"""Peak memory of encoding a chunk, in copies of its widest array."""


@dataclasses.dataclass(frozen=True)
class VAECodec(VAEConfig, Codec):
    """The video autoencoder of CogVideoX; its weights come from a converted checkpoint."""

    SHARDING: ClassVar[Rules] = (
        (r"codec/.*/kernel", P(None, "fsdp")),
        (r"codec/.*/(scale|bias)", P()),
    )
    """Weights are stored sharded and gathered for use; each device encodes its own clips."""
    DEPTH_AS_GREY: ClassVar[bool] = True
    CONVERTED: ClassVar[bool] = True

    @property
    def rgb_channels(self) -> int:
        """Latent channels of colour."""
        return self.latent_channels

    @property
    def depth_channels(self) -> int:
        """Latent channels of depth, which is encoded as a grey image."""
        return self.latent_channels

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
        """Encode a video to the scaled mean of its latents; see ``codecs.interface.encode``."""
        mean, _ = vae.encode(self, params, video_BTHWC)
        return mean * self._scale(condition=condition)

    def decode(self, params: Params, latents_BthwC: Array) -> Array:
        """Decode scaled latents to q·(t − 1) + 1 frames.

        Raises:
            UserError: the VAE decodes this many latents to another number of frames.
        """
        frames = self.temporal * (latents_BthwC.shape[1] - 1) + 1
        return vae.decode(self, params, latents_BthwC / self.scaling_factor, frames=frames)

    def costs(self, model: Any, share: Share) -> Costs:
        """Return the costs of encoding colour and depth, of the clip and of its first frame."""
        clip = model.clip
        macs = sum(_encode_macs(self, model, frames) for frames in (clip.frames, 1))
        pixels = 2 * (clip.frames + 1) * clip.height * clip.width
        at_once = vae.ENCODE_FRAMES + clip.frames % vae.ENCODE_FRAMES  # frames of the first chunk
        chunk = clip.height * clip.width * min(at_once, clip.frames)
        return Costs(
            products=(Product("codec", "convolution", 2 * macs),),
            streamed=PASSES * share.clips * pixels * self.widths[0] * share.activation_bytes,
            held=HELD
            * 2
            * chunk
            * self.widths[0]
            * share.activation_bytes,  # colour and depth, of one clip
        )

    def _scale(self, *, condition: bool) -> float:
        factor = self.scaling_factor
        return 1 / factor if condition and self.invert_scale_latents else factor


def _encode_macs(config: VAEConfig, model: Any, frames: int) -> float:
    """Return the multiply-adds of encoding one video."""
    clip = model.clip
    halvings = config.temporal.bit_length() - 1
    total = 0.0
    for path, shape in layout(config).items():
        if not (path.startswith("encoder/") and path.endswith("kernel")):
            continue
        level = _level(path, len(config.widths))
        spatial, temporal = level, min(level, halvings)
        if "resample" in path:
            spatial, temporal = level + 1, min(level + 1, halvings)
        cells = (clip.height >> spatial) * (clip.width >> spatial)
        total += -(-frames // 2**temporal) * cells * math.prod(shape)
    return total


def _level(path: str, levels: int) -> int:
    """Return how often the frame has been halved before a layer of the encoder."""
    name = path.split("/")[1]
    if name == "conv_in":
        return 0
    return int(name.removeprefix("down_")) if name.startswith("down_") else levels - 1
