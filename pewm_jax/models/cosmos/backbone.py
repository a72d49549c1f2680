"""Cosmos' transformer as a backbone: its functions and sharding rules.

Observed frames are kept, as in the reference's pipeline: the network gets their clean latents in
the place of noisy ones, a time of almost no noise for them, and a channel that marks them; sampling
returns them unchanged. Frames per second stretch the positions in time. A control that
modulates adds to the time embedding of each latent frame (arXiv 2601.15284, Eq. 5). A memory is
read after every block.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from pewm_jax.config.parts import Backbone, InjectionPoints, Rules
from pewm_jax.errors import UserError, require
from pewm_jax.models import interface as backbones
from pewm_jax.models.cosmos import model as cosmos
from pewm_jax.models.cosmos.config import CosmosConfig
from pewm_jax.models.interface import NO_READERS, Conditioning, Observed, Readers
from pewm_jax.types import Array, Params

KNOWN_SIGMA = 1e-4
"""The noise level σ of observed frames in the network's input, as in the reference's pipeline."""


@dataclasses.dataclass(frozen=True)
class CosmosBackbone(CosmosConfig, Backbone):
    """Cosmos' transformer as the denoiser of a world model; guidance is on its text.

    ``COSMOS_2B`` and ``COSMOS_14B`` are the published video models.
    """

    SHARDING: ClassVar[Rules] = cosmos.SHARDING
    GUIDED_BY_TEXT: ClassVar[bool] = True
    extra_tokens = True  # without an annotation this is no field

    @property
    def places(self) -> InjectionPoints:
        """Where a memory reader runs: after every block."""
        return InjectionPoints(self.layers, self.width, self.width, self.patch, self.patch_t)

    @property
    def text_shape(self) -> tuple[int, int]:
        """(length, channels) of the text tokens."""
        return self.text_length, self.raw_text_dim or self.text_dim

    @property
    def stores_prompt(self) -> bool:
        """Whether embeddings of prompts are stored with the weights."""
        return self.prompt == "stored"

    @property
    def split_heads(self) -> int:
        """The number that ``train.mesh.tensor`` must divide."""
        return self.heads

    def shown_channels(self, model: Any) -> int:
        """Return 1: a mask marks observed frames, whose latents replace noisy ones."""
        del model
        return 1

    def check(self, model: Any) -> None:
        """Refuse noise in other units than the network's, and frames that share a token."""
        super().check(model)
        require(
            model.noise.velocity_in_unit_time,
            "this backbone (cosmos) takes times from 0 to 1 and predicts velocities: use "
            "noise.kind edm with noise.target flow, or noise.kind flow with noise.scale 1.",
        )
        require(
            self.patch_t == 1,
            f"backbone.patch_t is {self.patch_t}: in a world model observed frames have their "
            "own time, so a token covers one latent frame; use 1.",
        )

    def init(self, key: Array, in_channels: int, out_channels: int) -> Params:
        """Return random parameters."""
        sized = dataclasses.replace(self, in_channels=in_channels, out_channels=out_channels)
        return cosmos.init(sized, key)

    def observed(self, model: Any, params: Params, seen: Observed) -> Conditioning:
        """Keep the observed frames at their latents, and mark them."""
        del params
        first = seen.latents_BthwC
        frames, height, width = model.latent_shape
        batch, held = first.shape[:2]
        is_known = np.arange(frames) < held
        rest = ((0, 0), (0, frames - held), (0, 0), (0, 0), (0, 0))
        marks = jnp.asarray(is_known, first.dtype)[:, None, None, None]
        return Conditioning(
            joined_BthwC=jnp.broadcast_to(marks, (batch, frames, height, width, 1)),
            known_BthwC=jnp.pad(first, rest),
            known_Bt=jnp.broadcast_to(is_known, (batch, frames)),
            fps=jnp.float32(self.fps),
        )

    def apply(
        self,
        params: Params,
        x_BthwC: Array,
        time_B: Array,
        conditioning: Conditioning,
        readers: Readers = NO_READERS,
    ) -> Array:
        """Predict from noisy latents. The prediction of known frames has no meaning.

        Raises:
            UserError: ``known_Bt`` is missing.
        """
        if conditioning.known_Bt is None:
            raise UserError(
                "this backbone (cosmos) needs to know which frames are known: make its "
                "conditioning by worlds.world_model.condition."
            )
        dtype = x_BthwC.dtype
        known_Bt = conditioning.known_Bt
        times_Bt = time_B if time_B.ndim == 2 else time_B[:, None]
        latents = backbones.held(conditioning, x_BthwC).astype(dtype)
        cells = self.patch_t * self.patch**2
        sized = dataclasses.replace(
            self,
            in_channels=params["patch_embed"]["kernel"].shape[-2] // cells - self.padding_mask,
            out_channels=params["proj_out"]["kernel"].shape[-1] // cells,
        )
        text = conditioning.tokens_BLC
        if text is None:
            text = jnp.zeros((len(latents), *self.text_shape))
        return cosmos.apply(
            sized,
            params,
            latents,
            jnp.where(known_Bt, KNOWN_SIGMA / (1 + KNOWN_SIGMA), times_Bt),
            text,
            conditioning.joined_BthwC,
            fps=conditioning.fps,
            modulation_BtE=conditioning.modulation_BtE,
            memory_block=readers.block,
            memory_params=readers.params,
            added_BND=readers.added_BND,
        )


COSMOS_2B = CosmosBackbone()
"""Cosmos-Predict2-2B-Video2World."""
COSMOS_14B = CosmosBackbone(layers=36, heads=40, rope_scale=(20 / 24, 2.0, 2.0))
"""Cosmos-Predict2-14B-Video2World."""
