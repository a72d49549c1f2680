"""A backbone in one file: residual perceptrons on every latent cell by itself.

A memory is read after every layer, and actions may modulate the time embedding. ::

    pewm-jax train tiny --plugin backbone.py --backbone.kind perceptron --train.run runs/mine
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.config.parts import Backbone, InjectionPoints
from pewm_jax.models.interface import joined
from pewm_jax.nn import layers
from pewm_jax.registry import register


@register("backbone", "perceptron")
@dataclasses.dataclass(frozen=True)
class PerceptronConfig(Backbone):
    SHARDING: ClassVar = (
        (r"backbone/(into|out)", P(None, "fsdp")),
        (r"backbone/blocks/(up|down)", P("fsdp", "tensor")),
    )

    depth: int = 2
    width: int = 32

    places = property(lambda self: InjectionPoints(self.depth, self.width, self.width))

    def init(self, key, in_channels, out_channels):
        d, keys = self.width, jax.random.split(key, 4)
        shapes = (in_channels, d), (d, out_channels), (self.depth, d, d), (self.depth, d, d)
        made = (jax.random.normal(k, s) / d for k, s in zip(keys, shapes, strict=True))
        into, out, up, down = made
        return {"into": into, "out": out, "blocks": {"up": up, "down": down}}

    def apply(self, params, x_BthwC, time_B, conditioning, readers):
        x = joined(x_BthwC, conditioning)
        tokens = x.reshape(len(x), -1, x.shape[-1]) @ params["into"].astype(x.dtype)
        tokens += 0 if readers.added_BND is None else readers.added_BND
        shift = conditioning.modulation_BtE
        shift = jnp.zeros((1, x.shape[1], 1)) if shift is None else shift
        time = layers.sinusoid(time_B, self.width)[:, None] + shift
        per_token = jnp.repeat(time, tokens.shape[1] // time.shape[1], 1)

        def block(tokens, layer):
            weights, reader = layer
            tokens += jax.nn.gelu((tokens + per_token) @ weights["up"]) @ weights["down"]
            return (readers.block(reader, tokens, time) if readers.block else tokens), None

        tokens, _ = jax.lax.scan(block, tokens, (params["blocks"], readers.params))
        return (tokens @ params["out"]).reshape(*x.shape[:-1], -1)
