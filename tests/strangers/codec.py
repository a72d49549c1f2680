"""A stranger's codec: every patch of every frame turned by a fixed orthonormal matrix."""

import dataclasses
import sys
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.codecs.pixel import fold
from pewm_jax.config import Codec, register
from pewm_jax.nn.costs import Costs, Product

SHARDING = ((r"codec/(colour|depth)", P(None, "fsdp")),)


@dataclasses.dataclass(frozen=True)
class TurnConfig(Codec):
    spatial: int = 4
    temporal: ClassVar[int] = 1

    @property
    def rgb_channels(self):
        return 3 * self.spatial**2

    @property
    def depth_channels(self):
        return self.spatial**2


def init(config, key):
    sizes = {"colour": config.rgb_channels, "depth": config.depth_channels}
    drawn = {name: jax.random.normal(key, (n, n)) for name, n in sizes.items()}
    return {name: jnp.linalg.qr(matrix)[0] for name, matrix in drawn.items()}


def encode(config, params, video_BTHWC, *, condition=False):
    patches = fold(video_BTHWC, config.spatial, 1)
    return patches @ params["depth" if video_BTHWC.shape[-1] == 1 else "colour"]


def decode(config, params, latents_BthwC):
    s = config.spatial
    matrix = params["depth" if latents_BthwC.shape[-1] == s**2 else "colour"]
    grid = latents_BthwC @ matrix.T
    b, t, h, w, _ = grid.shape
    pixels = grid.reshape(b, t, h, w, s, s, -1).transpose(0, 1, 2, 4, 3, 5, 6)
    return pixels.reshape(b, t, h * s, w * s, -1)


def costs(model, share):
    config, (t, h, w) = model.codec, model.latent_shape
    macs = (t + 1) * h * w * (config.rgb_channels**2 + config.depth_channels**2)
    return Costs(products=(Product("codec", "linear", macs),))


register("codec", "turn", TurnConfig, sys.modules[__name__])
