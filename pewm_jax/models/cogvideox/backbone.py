"""The diffusion transformer as a backbone: its functions and sharding rules."""

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
from pewm_jax.models.interface import NO_READERS, Conditioning, Readers
from pewm_jax.types import Array, Params

REPLICATED = P()


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
    def extra_tokens(self) -> bool:
        """Whether further tokens may follow those of the text: not with a table of positions."""
        return self.positions != "rope_learned" or self.learned == "drop"

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
        readers: Readers = NO_READERS,
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
            memory_block=readers.block,
            memory_params=readers.params,
            modulation_BtE=None if modulation is None else per_token(modulation),
            added_BND=readers.added_BND,
        )
        return out[:, missing:]
