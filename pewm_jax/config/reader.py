"""How the denoiser reads the memory."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Literal

from pewm_jax.config.errors import require, require_positive
from pewm_jax.config.kinds import Settings


class ReaderSettings(Settings):
    """What the settings of every reader say; ``pewm_jax.models.readers`` says what it does.

    Attributes:
        split_heads: what ``train.mesh.tensor`` must divide.
    """

    SECTION: ClassVar[str] = "reader"
    split_heads: Any = 1


@dataclasses.dataclass(frozen=True)
class AttentionConfig(ReaderSettings):
    """Cross-attention from video tokens to map tokens, after every block of the backbone."""

    positions: Literal["projective", "sinusoid"] = "projective"
    """How attention knows where a cell is: `projective` (seen through each frame's camera) or
    `sinusoid` (the paper: 3D sinusoid of the position)."""
    frame: Literal["camera", "world"] = "camera"
    """Where a `sinusoid` counts positions from: the clip's first camera, or the world's origin."""
    looks: int = 128
    """Map tokens that each frame's camera looks at, with projective positions."""
    heads: int = 6
    """Attention heads."""
    head_dim: int = 32
    """Width of a head; a multiple of 8."""
    mlp_ratio: int = 4
    """Feed-forward width over model width."""

    @property
    def split_heads(self) -> int:
        """What ``train.mesh.tensor`` must divide."""
        return self.heads

    @property
    def width(self) -> int:
        """Channels of all heads together."""
        return self.heads * self.head_dim

    def check(self, model: Any) -> None:
        """Refuse fewer heads than a token has cameras."""
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
