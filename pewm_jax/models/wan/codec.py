"""Wan's video autoencoder as a codec: the mean of its latents, each channel normalised."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar

from jax.sharding import PartitionSpec as P

from pewm_jax.config.parts import Codec, Rules
from pewm_jax.errors import require
from pewm_jax.models.wan import vae as wan_vae
from pewm_jax.models.wan.config import WanVAEConfig
from pewm_jax.nn.costs import Costs, Product, Share
from pewm_jax.types import Array, Params

PASSES = 60
"""How often encoding a frame reads or writes as many values as its widest array has."""
HELD = 6.0
"""Peak memory of encoding four frames, in copies of their widest array."""
CHUNK = 4
"""Frames that are encoded at a time."""


@dataclasses.dataclass(frozen=True)
class WanVAECodec(WanVAEConfig, Codec):
    """Wan's video autoencoder; its weights come from a converted checkpoint."""

    SHARDING: ClassVar[Rules] = (
        (r"codec/.*/kernel", P(None, "fsdp")),
        (r"codec/.*/(scale|bias)", P()),
    )
    """Weights are stored sharded and gathered for use; each device encodes its own clips."""
    DEPTH_AS_GREY: ClassVar[bool] = True
    CONVERTED: ClassVar[bool] = True

    @property
    def framewise(self) -> bool:
        """Whether a latent frame is decoded by itself: no, with those before it."""
        return False

    @property
    def rgb_channels(self) -> int:
        """Latent channels of colour."""
        return self.latent_channels

    @property
    def depth_channels(self) -> int:
        """Latent channels of depth."""
        return self.latent_channels * self.depth

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

    def costs(self, model: Any, share: Share) -> Costs:
        """Return the costs of encoding the clip and its first frame, and depth with ``depth``."""
        clip = model.clip
        kinds = 1 + self.depth
        macs = attention = 0.0
        for frames in (clip.frames, 1):
            macs += encode_macs(self, clip.height, clip.width, frames)
            attention += _attention(self, clip.height, clip.width, frames)
        widest = clip.height * clip.width * self.base_width * share.activation_bytes
        return Costs(
            products=(
                Product("codec", "convolution", kinds * macs),
                Product("codec", "attention", kinds * attention),
            ),
            streamed=PASSES * share.clips * kinds * (clip.frames + 1) * widest,
            held=HELD * kinds * CHUNK * widest,
        )


def encode_macs(config: WanVAEConfig, height: int, width: int, frames: int) -> float:
    """Return the multiply-adds of the encoder's convolutions and linear layers."""
    total, last = 0.0, len(config.halves_time)
    for path, shape in wan_vae.layout(config).items():
        if not (path.startswith("encoder/") and path.endswith("kernel")):
            continue
        name = path.split("/")[1]
        level = int(name.removeprefix("down_")) if name.startswith("down_") else last
        level = 0 if name == "conv_in" else level
        halved = level + ("/resample/" in path)
        done = level + path.endswith("/resample/time/kernel")
        times = _frames(config, frames, done)
        if path.endswith("/resample/time/kernel"):
            times -= 1  # the first frame stays as it is
        total += times * (height >> halved) * (width >> halved) * math.prod(shape)
    return total


def _frames(config: WanVAEConfig, frames: int, level: int) -> int:
    """Return how many frames there are at a level."""
    return (frames - 1) // 2 ** sum(config.halves_time[:level]) + 1


def _attention(config: WanVAEConfig, height: int, width: int, frames: int) -> float:
    """Return the multiply-adds of the attention at the bottom."""
    latents = _frames(config, frames, len(config.halves_time))
    cells = (height // config.spatial) * (width // config.spatial)
    return latents * 2 * cells**2 * config.multiples[-1] * config.base_width
