"""Stable Video Diffusion's U-Net as a backbone: its functions and sharding rules.

The observed image reaches it in three ways, as in the reference's pipeline: its latents are joined
to those of every frame, its embedding (CLIP's) is attended to, and a scalar states the noise that
was added before it was encoded. Two more scalars, frames per second and the amount of motion, are
settings. A control that modulates adds to the time embedding of each frame (arXiv 2601.15284, Eq.
5). It has no place where a memory could be read.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.config.parts import Backbone, Rules
from pewm_jax.errors import UserError, require
from pewm_jax.models import interface as backbones
from pewm_jax.models.clip import model as clip_vision
from pewm_jax.models.interface import NO_READERS, Conditioning, Observed, Readers
from pewm_jax.models.svd import unet as svd_unet
from pewm_jax.models.svd.config import SVDUNetConfig
from pewm_jax.types import Array, Params

REPLICATED = P()


BLOCK = {"resnet": 30, "attention": 160}
"""The same at the peak of its own backward pass."""


@dataclasses.dataclass(frozen=True)
class SVDUNetBackbone(SVDUNetConfig, Backbone):
    """The U-Net of Stable Video Diffusion as the denoiser of a world model.

    It takes any number of channels: those that codec and control have. It has no place where a
    memory could be read.
    """

    SHARDING: ClassVar[Rules] = (
        (r"backbone/conv_out/kernel", P("fsdp", None)),
        (r"(backbone|image)/(.*/)?kernel", P(None, "fsdp")),
        (r"(backbone|image)/(.*/)?(bias|scale|mix)", REPLICATED),
        (r"image/(cls_token|position_embed)", P("fsdp")),
    )
    """Weights are stored split and gathered for use; each device computes its own clips."""

    def check(self, model: Any) -> None:
        """Refuse a model that does not fit the network; any size of frames does."""
        require(
            self.added == 3,
            f"backbone.added is {self.added}: a world model gives three scalars, frames per "
            "second, motion bucket and the noise of the image; use 3.",
        )
        require(
            self.image.projection == self.image_dim,
            f"backbone.image.projection is {self.image.projection} and backbone.image_dim is "
            f"{self.image_dim}: the image's embedding is attended to, so use the same.",
        )
        require(
            not model.noise.per_frame,
            "noise.per_frame is true, and this backbone takes one noise level for a clip: use "
            "false.",
        )

    def init(self, key: Array, in_channels: int, out_channels: int) -> Params:
        """Return random parameters."""
        sized = dataclasses.replace(self, in_channels=in_channels, out_channels=out_channels)
        return svd_unet.init(sized, key)

    def init_image(self, key: Array) -> Params:
        """Return random parameters of the image encoder."""
        return clip_vision.init(self.image, key)

    def observed(self, model: Any, params: Params, seen: Observed) -> Conditioning:
        """Condition on the observed image: its latents in every frame, its embedding, scalars.

        The embedding is that of the colours before noise was added.

        Raises:
            UserError: more than one frame was observed.
        """
        first = seen.latents_BthwC
        if first.shape[1] != 1:
            raise UserError(
                f"{first.shape[1]} frames were observed, and this backbone (svd_unet) takes "
                "one: use history 1."
            )
        batch, frames = len(first), model.latent_shape[0]
        rgb = clip_vision.preprocess(seen.rgb_BTHWC[:, 0], self.image.image_size)
        embedding = clip_vision.apply(self.image, params["image"], rgb.astype(model.dtype))
        scalars = jnp.asarray([self.fps - 1, self.motion_bucket], jnp.float32)
        scalars = jnp.broadcast_to(scalars, (batch, 2))
        return Conditioning(
            joined_BthwC=jnp.repeat(first, frames, 1),
            image_BMD=embedding[:, None],
            scalars_BK=jnp.concatenate([scalars, seen.noise_B[:, None]], 1),
        )

    def apply(
        self,
        params: Params,
        x_BthwC: Array,
        time_B: Array,
        conditioning: Conditioning,
        readers: Readers = NO_READERS,
    ) -> Array:
        """Predict from noisy latents.

        Raises:
            UserError: a memory is to be read, or the image's embedding or the scalars are missing.
        """
        if readers.block is not None or readers.added_BND is not None:
            raise UserError("this backbone (svd_unet) reads no memory: use memory.kind none.")
        if conditioning.image_BMD is None or conditioning.scalars_BK is None:
            raise UserError(
                "this backbone (svd_unet) needs the embedding of an image and three scalars: make "
                "its conditioning by worlds.world_model.condition."
            )
        dtype = x_BthwC.dtype
        latents = backbones.joined(x_BthwC, conditioning).astype(dtype)
        sized = dataclasses.replace(
            self,
            in_channels=params["conv_in"]["kernel"].shape[-2],
            out_channels=params["conv_out"]["kernel"].shape[-1],
        )
        return svd_unet.apply(
            sized,
            params,
            latents,
            time_B,
            conditioning.image_BMD.astype(dtype),
            conditioning.scalars_BK,
            conditioning.modulation_BtE,
        )


def modulated(model: Any) -> bool:
    """Tell whether every frame has a time embedding of its own."""
    return bool(model.control.MODULATES)
