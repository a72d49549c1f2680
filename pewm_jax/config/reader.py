"""Memory readers: how the denoiser reads the memory."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Literal

from pewm_jax.config.errors import require, require_positive
from pewm_jax.config.kinds import Settings


class ReaderSettings(Settings):
    """Settings that every reader has; see ``pewm_jax.models.readers`` for its functions.

    Attributes:
        READS_TOKENS: whether it takes the points that a clip's cameras see (``Sight.tokens``).
        READS_VIEW: whether it takes what the memory looks like from them (``Sight.view``).
        split_heads: a number that ``train.mesh.tensor`` must divide.
    """

    SECTION: ClassVar[str] = "reader"
    READS_TOKENS: ClassVar[bool] = True
    READS_VIEW: ClassVar[bool] = False
    split_heads: Any = 1


@dataclasses.dataclass(frozen=True)
class AttentionConfig(ReaderSettings):
    """Cross-attention from video tokens to map tokens, after every block of the backbone."""

    positions: Literal["projective", "sinusoid"] = "projective"
    """How cell positions are encoded: `projective` (image coordinates in each frame's camera) or
    `sinusoid` (the paper's 3D sinusoid of the position)."""
    frame: Literal["camera", "world"] = "camera"
    """The frame of `sinusoid` positions: the clip's first camera, or the world."""
    looks: int = 128
    """Map tokens that each camera attends to, with projective positions."""
    heads: int = 6
    """Attention heads."""
    head_dim: int = 32
    """Width of a head; a multiple of 8."""
    mlp_ratio: int = 4
    """Feed-forward width over model width."""

    @property
    def split_heads(self) -> int:
        """The number that ``train.mesh.tensor`` must divide."""
        return self.heads

    @property
    def width(self) -> int:
        """Channels of all heads together."""
        return self.heads * self.head_dim

    def check(self, model: Any) -> None:
        """Refuse fewer heads than there are cameras per token."""
        cameras = model.codec.temporal * model.backbone.places.patch_t
        require(
            self.positions == "sinusoid" or self.heads >= cameras,
            f"memory.reader.heads is {self.heads}: with projective positions head k looks through "
            f"camera k mod {cameras} (codec.temporal × backbone.patch_t) of a token's frames; use "
            f"at least {cameras} heads, or memory.reader.positions sinusoid.",
        )

    def __post_init__(self):
        """Validate."""
        require_positive(self, "memory.reader", "looks", "heads", "head_dim", "mlp_ratio")
        require(
            self.head_dim % 8 == 0,
            f"memory.reader.head_dim is {self.head_dim}: use a multiple of 8, the projective "
            "rotary embedding splits a head in two times two halves.",
        )
