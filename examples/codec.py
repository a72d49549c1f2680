"""A codec in one file: it turns every patch of every frame by a fixed orthonormal matrix.

::

    pewm-jax train tiny --plugin codec.py --codec.kind turn --train.run runs/mine
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.codecs.pixel import fold
from pewm_jax.config.parts import Codec
from pewm_jax.registry import register


@register("codec", "turn")
@dataclasses.dataclass(frozen=True)
class TurnConfig(Codec):
    SHARDING: ClassVar = ((r"codec/(colour|depth)", P(None, "fsdp")),)

    spatial: int = 4
    temporal: ClassVar[int] = 1

    @property
    def rgb_channels(self):
        return 3 * self.spatial**2

    @property
    def depth_channels(self):
        return self.spatial**2

    def init(self, key):
        sizes = {"colour": self.rgb_channels, "depth": self.depth_channels}
        drawn = {name: jax.random.normal(key, (n, n)) for name, n in sizes.items()}
        return {name: jnp.linalg.qr(matrix)[0] for name, matrix in drawn.items()}

    def encode(self, params, video_BTHWC, *, condition=False):
        patches = fold(video_BTHWC, self.spatial, 1)
        return patches @ params["depth" if video_BTHWC.shape[-1] == 1 else "colour"]

    def decode(self, params, latents_BthwC):
        s = self.spatial
        grid = latents_BthwC @ params["depth" if latents_BthwC.shape[-1] == s**2 else "colour"].T
        b, t, h, w, _ = grid.shape
        pixels = grid.reshape(b, t, h, w, s, s, -1).transpose(0, 1, 2, 4, 3, 5, 6)
        return pixels.reshape(b, t, h * s, w * s, -1)
