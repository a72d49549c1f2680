"""A stranger's denoiser: residual perceptrons on every latent cell by itself."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.config import Backbone, InjectionPoints, register
from pewm_jax.models import interface as backbones
from pewm_jax.nn import layers
from pewm_jax.nn.costs import Costs, Product, video_tokens

SHARDING = (
    (r"backbone/(into|out)", P(None, "fsdp")),
    (r"backbone/blocks/(up|down)", P("fsdp", "tensor")),
)


@dataclasses.dataclass(frozen=True)
class PerceptronConfig(Backbone):
    depth: int = 2
    width: int = 32

    places = property(lambda self: InjectionPoints(self.depth, self.width, self.width))


def init(config, key, in_channels, out_channels):
    d, keys = config.width, jax.random.split(key, 4)
    shapes = (in_channels, d), (d, out_channels), (config.depth, d, d), (config.depth, d, d)
    into, out, up, down = (jax.random.normal(k, s) / d for k, s in zip(keys, shapes, strict=True))
    return {"into": into, "out": out, "blocks": {"up": up, "down": down}}


def apply(config, params, x_BthwC, time_B, conditioning, readers):
    x = backbones.joined(x_BthwC, conditioning)
    tokens = x.reshape(len(x), -1, x.shape[-1]) @ params["into"].astype(x.dtype)
    tokens += 0 if readers.added_BND is None else readers.added_BND
    time = layers.sinusoid(time_B, config.width)[:, None] + conditioning.modulation_BtE
    per_token = jnp.repeat(time, tokens.shape[1] // time.shape[1], 1)

    def block(tokens, layer):
        weights, reader = layer
        tokens += jax.nn.gelu((tokens + per_token) @ weights["up"]) @ weights["down"]
        return (readers.block(reader, tokens, time) if readers.block else tokens), None

    tokens, _ = jax.lax.scan(block, tokens, (params["blocks"], readers.params))
    return (tokens @ params["out"]).reshape(*x.shape[:-1], -1)


def costs(model, share, *, trained):
    (t, n), d, once = video_tokens(model), model.backbone.width, float(trained)
    into = Product("backbone", "linear", t * n * d * model.in_channels, once)
    macs = model.backbone.depth * 2 * t * n * d * d
    blocks = Product("backbone", "linear", macs, 1 + once, 0, ("tensor",))
    out = Product("backbone", "linear", t * n * d * model.codec.channels, 1 + once)
    return Costs(products=(into, blocks, out))


register("backbone", "perceptron", PerceptronConfig, sys.modules[__name__])
