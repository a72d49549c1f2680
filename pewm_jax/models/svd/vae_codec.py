"""Stable Video Diffusion's autoencoder as a codec: the mean of its latents, scaled, or not.

The latents of what is denoised are scaled to unit variance; those of the image that conditions are
not, as in the reference's pipeline.
"""

from __future__ import annotations

import math

from jax.sharding import PartitionSpec as P

from pewm_jax.config import ModelConfig, SVDVAEConfig
from pewm_jax.models.svd import vae as svd_vae
from pewm_jax.nn.costs import Costs, Product, Share
from pewm_jax.types import Array, Params

SHARDING = (
    (r"codec/.*/kernel", P(None, "fsdp")),
    (r"codec/.*/(scale|bias|mix)", P()),
)
"""Weights are stored sharded and gathered for use; each device encodes its own clips."""

PASSES = 60
"""How often encoding a frame reads or writes as many values as its widest array has."""
HELD = 4
"""Peak memory of encoding a clip, in copies of its widest array."""

init = svd_vae.init


def encode(
    config: SVDVAEConfig, params: Params, video_BTHWC: Array, *, condition: bool = False
) -> Array:
    """Encode a video to the mean of its latents; see ``pewm_jax.codecs.rgbd.encode``."""
    mean = svd_vae.encode(config, params, video_BTHWC)
    return mean if condition else mean * config.scaling_factor


def decode(config: SVDVAEConfig, params: Params, latents_BthwC: Array) -> Array:
    """Decode scaled latents to as many frames, all of a clip together."""
    return svd_vae.decode(config, params, latents_BthwC / config.scaling_factor)


def costs(model: ModelConfig, share: Share) -> Costs:
    """Return the costs of encoding the clip and its first frame, and their depth if it is asked."""
    config, clip = model.codec, model.clip
    assert isinstance(config, SVDVAEConfig)
    kinds = 1 + config.depth
    frames = kinds * (clip.frames + 1)
    widest = clip.height * clip.width * config.widths[0] * share.activation_bytes
    cells = clip.height * clip.width // config.spatial**2
    attention = frames * 2 * cells**2 * config.widths[-1]
    return Costs(
        products=(
            Product("codec", "convolution", frames * _encode_macs(config, clip.height, clip.width)),
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
