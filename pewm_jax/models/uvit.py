"""The U-ViT: a diffusion transformer between convolutions at a higher resolution.

Simple diffusion (Hoogeboom et al. 2023, arXiv 2301.11093, Sec. 3.3) denoises pixels by a U-Net. Its
lowest level is a transformer with most of the parameters. Here that level is the transformer of
CogVideoX over the tokens of all frames. Convolutions at the resolution of the latents, before and
after it, run on single frames: they tell neighbouring cells apart at once, which a transformer over
patches has to learn.

Residual blocks are two 3 × 3 convolutions, each after a SiLU, the first after a norm over channels
that the time embedding modulates. The features before the transformer are added to its output. A
linear map from the embedded input to the prediction, with gains that depend on the time, runs in
parallel: noise and known pixels are copied by it (simple diffusion has none).

Parameters: ``into``, ``time`` (an embedding for the residual blocks), ``down``, ``transformer``,
``up``, ``out``; ``direct`` and ``direct_gain``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.config.parts import InjectionPoints, Rules
from pewm_jax.errors import require, require_positive
from pewm_jax.models import interface as backbones
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.interface import NO_READERS, Conditioning, Readers
from pewm_jax.nn import parameters
from pewm_jax.nn.convolution import convolve_layer
from pewm_jax.nn.layers import linear, mlp, sinusoid, standardise
from pewm_jax.types import Array, Params


@dataclasses.dataclass(frozen=True)
class UViTBackbone(DiTBackbone):
    """A diffusion transformer between convolutions at the resolution of the latents."""

    SHARDING: ClassVar[Rules] = (
        *(
            (pattern.replace("backbone/", "backbone/transformer/"), spec)
            for pattern, spec in DiTBackbone.SHARDING
        ),
        (r"backbone/(into|time|down|up|out|direct|direct_gain)/(.*/)?kernel", P(None, "fsdp")),
        (r"backbone/(into|time|down|up|out|direct|direct_gain)/(.*/)?bias", P()),
    )

    channels: int = 128
    """Channels of the convolutions."""
    blocks: int = 2
    """Residual blocks before the transformer, and as many after it."""

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require_positive(self, "backbone", "channels", "blocks")

    @property
    def places(self) -> InjectionPoints:
        """Where a memory reader runs: at every latent cell of the input, and after every block."""
        return dataclasses.replace(super().places, cell_width=self.channels)

    def check(self, model: Any) -> None:
        """Refuse tokens of several latent frames, or what the transformer refuses."""
        super().check(model)
        require(
            self.patch_t == 1,
            f"backbone.patch_t is {self.patch_t}: the U-ViT takes single latent frames, so use 1.",
        )

    def transformer(self) -> DiTBackbone:
        """Return the settings of the transformer."""
        names = [field.name for field in dataclasses.fields(DiTBackbone)]
        given: dict[str, Any] = {name: getattr(self, name) for name in names}
        given |= {"in_channels": self.channels, "out_channels": self.channels}
        return DiTBackbone(**given)

    def init(self, key: Array, in_channels: int, out_channels: int) -> Params:
        """Return random parameters; the prediction is 0."""
        shapes = dict(_leaves(self, in_channels, out_channels))
        params = parameters.draw(shapes, jax.random.fold_in(key, 1))
        for block in (*params["down"].values(), *params["up"].values()):
            block["two"]["kernel"] *= 0
        for name in ("out", "direct", "direct_gain"):
            params[name]["kernel"] *= 0
        inner = self.transformer()
        return {**params, "transformer": inner.init(key, inner.in_channels, inner.out_channels)}

    def apply(
        self,
        params: Params,
        x_BthwC: Array,
        time_B: Array,
        conditioning: Conditioning,
        readers: Readers = NO_READERS,
    ) -> Array:
        """Predict from noisy latents."""
        dtype = x_BthwC.dtype
        x = backbones.joined(x_BthwC, conditioning).astype(dtype)
        batch, frames = x.shape[:2]
        time = mlp(params["time"], sinusoid(jnp.asarray(time_B), self.width).astype(dtype))
        if time.ndim < 3:
            time = jnp.broadcast_to(time[:, None], (batch, frames, time.shape[-1]))
        if conditioning.modulation_BtE is not None:
            time = time + conditioning.modulation_BtE.astype(dtype)
        time = jax.nn.silu(time.reshape(batch * frames, -1))

        x = linear(params["into"], x)
        if readers.added_BthwC is not None:
            x = x + readers.added_BthwC.astype(dtype)
        before = _blocks(params["down"], x.reshape(-1, *x.shape[2:]), time)
        deep = self.transformer().apply(
            params["transformer"],
            before.reshape(x.shape),
            time_B,
            dataclasses.replace(conditioning, joined_BthwC=None),
            readers,
        )
        after = _blocks(params["up"], before + deep.reshape(before.shape), time)
        out = convolve_layer(params["out"], jax.nn.silu(standardise(after).astype(dtype)))
        gain = 1 + linear(params["direct_gain"], time)[:, None, None]
        out = out + gain * linear(params["direct"], x.reshape(before.shape))
        return out.reshape(batch, frames, *out.shape[1:])


def _blocks(params: Params, x_NHWC: Array, time_NE: Array) -> Array:
    """Apply residual blocks."""
    for name in sorted(params):
        block = params[name]
        scale, shift = jnp.split(linear(block["time"], time_NE)[:, None, None], 2, -1)
        inner = standardise(x_NHWC).astype(x_NHWC.dtype) * (1 + scale) + shift
        inner = convolve_layer(block["one"], jax.nn.silu(inner))
        x_NHWC = x_NHWC + convolve_layer(block["two"], jax.nn.silu(inner))
    return x_NHWC


def _leaves(settings: UViTBackbone, inward: int, outward: int) -> Iterator[parameters.Leaf]:
    """Yield the parameters around the transformer."""
    width, time = settings.channels, settings.time_dim
    yield from parameters.linear("into", inward, width)
    yield from parameters.convolution("out", (3, 3), width, outward)
    yield from parameters.linear("direct", width, outward)
    yield from parameters.linear("direct_gain", time, outward)
    yield from parameters.mlp("time", settings.width, time, time)
    for where in ("down", "up"):
        for k in range(settings.blocks):
            yield from parameters.linear(f"{where}/{k}/time", time, 2 * width)
            for part in ("one", "two"):
                yield from parameters.convolution(f"{where}/{k}/{part}", (3, 3), width, width)
