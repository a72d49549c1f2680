"""The diffusion transformer as a backbone: its functions, sharding rules and costs."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.config.parts import Backbone, InjectionPoints, Rules
from pewm_jax.errors import require
from pewm_jax.models import interface as backbones
from pewm_jax.models.cogvideox import model as dit
from pewm_jax.models.cogvideox.config import DiTConfig
from pewm_jax.models.interface import Conditioning, Readers
from pewm_jax.nn import attention as blocked_attention
from pewm_jax.nn.costs import (
    FLOAT,
    SPLIT,
    Costs,
    Product,
    Share,
    text_tokens,
    video_times,
    video_tokens,
)
from pewm_jax.types import Array, Params

REPLICATED = P()


STREAMS = (16, 40)
"""How often element-wise work reads or writes a block's tokens: forward, backward."""


@dataclasses.dataclass(frozen=True)
class DiTBackbone(DiTConfig, Backbone):
    """The diffusion transformer of CogVideoX as the denoiser of a world model."""

    SHARDING: ClassVar[Rules] = (
        # Matrices to and from heads and hidden channels.
        (r"backbone/blocks/(to_[qkv]|ff/up|norm[12]/linear)/kernel", P("fsdp", "tensor")),
        (r"backbone/blocks/(to_[qkv]|ff/up|norm[12]/linear)/bias", P("tensor")),
        (r"backbone/blocks/(to_out|ff/down)/kernel", P("tensor", "fsdp")),
        (r"backbone/blocks/(to_out|ff/down)/bias", REPLICATED),
        (r"backbone/blocks/(norm_[qk]|norm[12]/norm)/(scale|bias)", REPLICATED),
        (r"backbone/(patch_embed|text_embed)/kernel", P(None, "fsdp")),
        (r"backbone/(time_embed|ofs_embed)/linear_[12]/kernel", P(None, "fsdp")),
        (r"backbone/modulate_out/kernel", P("fsdp", "tensor")),
        (r"backbone/modulate_out/bias", P("tensor")),
        (r"backbone/proj_out/kernel", P("fsdp", None)),
        (r"backbone/positions", P(None, "fsdp")),
        (
            r"backbone/(patch_embed|text_embed|proj_out|(time|ofs)_embed/linear_[12])/bias",
            REPLICATED,
        ),
        (r"backbone/norm_(final|out)/(scale|bias)", REPLICATED),
    )

    @property
    def places(self) -> InjectionPoints:
        """Where a memory reader runs: after every block."""
        return InjectionPoints(self.layers, self.width, self.time_dim, self.patch, self.patch_t)

    @property
    def text_shape(self) -> tuple[int, int]:
        """(length, channels) of the text tokens."""
        return self.text_length, self.text_dim

    @property
    def stores_prompt(self) -> bool:
        """Whether a prompt's embedding is stored with the weights."""
        return self.prompt == "stored"

    @property
    def split_heads(self) -> int:
        """The number that ``train.mesh.tensor`` must divide."""
        return self.heads

    def check(self, model: Any) -> None:
        """Refuse latents that do not split into patches, and channels that do not fit."""
        super().check(model)
        wanted = {"in_channels": model.in_channels, "out_channels": model.codec.channels}
        for name, value in wanted.items():
            require(
                getattr(self, name) in (0, value),
                f"backbone.{name} is {getattr(self, name)}: codec and control need {value}; leave "
                "it at 0 to have it follow them.",
            )

    def init(self, key: Array, in_channels: int, out_channels: int) -> Params:
        """Return random parameters."""
        sized = dataclasses.replace(self, in_channels=in_channels, out_channels=out_channels)
        return dit.init(sized, key)

    def apply(
        self,
        params: Params,
        x_BthwC: Array,
        time_B: Array,
        conditioning: Conditioning,
        readers: Readers,
    ) -> Array:
        """Predict from noisy latents.

        If ``patch_t`` does not divide the number of latent frames, the first one is repeated in
        front, as in CogVideoX 1.5, and dropped from the result. Times and modulation per latent
        frame are averaged over the frames of a token.
        """
        dtype = x_BthwC.dtype
        latents = backbones.joined(x_BthwC, conditioning).astype(dtype)
        missing = -latents.shape[1] % self.patch_t

        def padded(x_Bt: Array) -> Array:
            return jnp.concatenate([x_Bt[:, :1]] * missing + [x_Bt], 1)

        def per_token(x_Bt: Array) -> Array:
            grid = padded(x_Bt)
            return grid.reshape(len(grid), -1, self.patch_t, *grid.shape[2:]).mean(2)

        modulation = conditioning.modulation_BtE
        text = conditioning.tokens_BLC
        if text is None:
            text = jnp.zeros((len(latents), *self.text_shape))
        out = dit.apply(
            self,
            params,
            padded(latents),
            text,
            time_B if time_B.ndim < 2 else per_token(time_B),
            expert=readers.block,
            expert_params=readers.params,
            modulation_BtE=None if modulation is None else per_token(modulation),
            added_BND=readers.added_BND,
        )
        return out[:, missing:]

    def costs(self, model: Any, share: Share, *, trained: bool) -> Costs:
        """Return the transformer's costs.

        It is either trained (stage 1) or frozen (stage 2). If frozen, gradients still pass through
        all blocks to the memory blocks, but not into weights or the time embedding.

        Bytes are counted in four units: a block's tokens (``whole``: B·S·D values, split by
        ``context``), the same split by ``tensor`` too (``part``), hidden channels, and logits.
        """
        depth, width, joint = self.layers, self.width, _joint(model)
        whole = share.clips * joint * width * share.activation_bytes / share.context
        part, hidden = whole / share.tensor, whole / share.tensor * self.mlp_ratio
        cells = self.patch**2 * self.patch_t
        video = joint - text_tokens(model)
        patches = share.clips * video * cells * model.in_channels * share.activation_bytes
        common = 4 * FLOAT * _logits(self, joint, share) + 2 * part * (share.context - 1)
        kept = depth * whole if self.remat else depth * (3 * whole + 7 * part + hidden)
        if trained:
            block = (12 if self.remat else 11) * whole + 13 * part
            block += (5 if self.remat else 1) * hidden + 0.8 * patches
        else:
            block = (18 if self.remat else 17) * whole + 13 * part
            block += 2 * hidden * self.remat
        forward, backward = STREAMS
        passes = 2 + self.remat  # forward, backward, forward again
        return Costs(
            products=_products(self, model, trained=trained),
            kept=kept,
            block=block + common,
            streamed=depth * whole * (forward * (1 + self.remat) + backward),
            summed=2 * depth * passes * whole,
            gathered=(1 + self.remat) * depth * 2 * whole / share.tensor,
            scattered=depth * 2 * whole / share.tensor,
        )


def _joint(model: Any) -> int:
    """Return the number of text and video tokens of a clip."""
    frames, patches = video_tokens(model)
    return text_tokens(model) + frames * patches


def _logits(config: DiTConfig, joint: int, share: Share) -> float:
    """Return the number of logits that exist at once."""
    logits = share.clips * config.heads / share.tensor * joint**2 / share.context
    if share.flash:
        return 0.0
    on_cpu = share.activation_bytes == FLOAT
    if on_cpu and logits > blocked_attention.LOGITS:  # blocks of one head
        return min(share.clips * joint**2 / share.context, blocked_attention.LOGITS)
    return logits


def _products(config: DiTConfig, model: Any, *, trained: bool) -> tuple[Product, ...]:
    depth, width, time = config.layers, config.width, config.time_dim
    cell = config.patch**2 * config.patch_t
    joint, text = _joint(model), text_tokens(model)
    again = float(config.remat)
    backward, weights_only = 1.0 + trained, float(trained)

    per_token = (4 + 2 * config.mlp_ratio) * width * width
    embeddings = 2 if config.ofs_dim else 1
    frames = video_times(model)
    times = frames + (frames > 1)  # the text has its own
    modulation = times * depth * 12 * width * time
    recomputed = again + 0.5  # the attention weights, from their normaliser
    attention = depth * 2 * joint**2 * width
    ends_in = (joint - text) * cell * model.in_channels * width
    ends_in += text * config.text_dim * width + (width + config.ofs_dim) * time
    out = (joint - text) * cell * model.codec.channels * width
    return (
        Product("backbone", "linear", depth * joint * per_token, backward, again, SPLIT),
        Product("backbone", "linear", modulation, 2 * weights_only, again, ("tensor",)),
        Product("backbone", "attention", attention, 2.0, recomputed, SPLIT),
        Product("backbone", "linear", ends_in, weights_only),
        Product("backbone", "linear", embeddings * time * time, 2 * weights_only),
        Product("backbone", "linear", times * 2 * width * time, 2 * weights_only, 0.0, ("tensor",)),
        Product("backbone", "linear", out, backward, 0.0, ("context",)),
    )
