"""Settings that every backbone has."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

from pewm_jax.errors import require
from pewm_jax.registry import Settings


@dataclasses.dataclass(frozen=True)
class Places:
    """Where a memory reader runs in a backbone, and the sizes it needs to know.

    Attributes:
        count: how often it runs; its parameters are stacked along this axis.
        width: D, channels of the hidden video tokens (B, N, D).
        time: E, channels of the time embedding (B, E).
        patch: latent cells per token, along height and along width.
        patch_t: latent frames per token.
    """

    count: int
    width: int
    time: int
    patch: int = 1
    patch_t: int = 1


class BackboneSettings(Settings):
    """Settings that every backbone has; see ``pewm_jax.models.interface`` for its functions.

    Attributes:
        places: where a memory reader runs; None where none can.
        time_dim: E, channels of the time embedding, to which a control may add.
        text_shape: (length, channels) of its text tokens; None if it takes none.
        stores_prompt: whether a prompt's embedding is stored with the weights.
        split_heads: a number that ``train.mesh.tensor`` must divide.
        remat: whether the backward pass recomputes activations.
        GUIDED_BY_TEXT: whether guidance of a world without a memory is on the text, against
            another prompt, and not on the observed image.
    """

    SECTION: ClassVar[str] = "backbone"
    GUIDED_BY_TEXT: ClassVar[bool] = False
    places: Any = None
    text_shape: Any = None
    stores_prompt: Any = False
    split_heads: Any = 1
    remat: Any = False

    @property
    def time_dim(self) -> int:
        """Channels of the time embedding: those that a reader's places are told."""
        return self.places.time

    def shown_channels(self, model: Any) -> int:
        """Return the number of input channels that show the observed frames: their latents'."""
        return model.codec.channels

    def check(self, model: Any) -> None:
        """Refuse latents that do not split into the backbone's patches.

        A backbone that takes other sizes has a check of its own.
        """
        if self.places is None:
            return
        step = model.codec.spatial * self.places.patch
        clip = model.clip
        require(
            clip.height % step == 0 and clip.width % step == 0,
            f"clip {clip.height}×{clip.width}: height and width must be multiples of "
            f"codec.spatial × backbone.patch = {step}; change the clip's size or the patch.",
        )
