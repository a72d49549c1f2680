"""Memory readers: how the denoiser reads the memory: `attend` to points, `render`, or `both`."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Literal

from pewm_jax.config.parts import Reader
from pewm_jax.errors import require, require_positive


@dataclasses.dataclass(frozen=True)
class AttentionConfig(Reader):
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


@dataclasses.dataclass(frozen=True)
class RenderConfig(Reader):
    """What the memory looks like from each frame's camera, given to the video tokens there."""

    READS_TOKENS: ClassVar[bool] = False
    READS_VIEW: ClassVar[bool] = True

    picture: Literal["pixels", "latents"] = "pixels"
    """What a token gets of the picture: the `pixels` that it stands for, or the `latents` that the
    codec makes of them, holes filled; these only of memories that show colours."""
    picture_width: int = 128
    """Channels of a token's part of the picture, embedded."""
    reduced: int = 8
    """Pictures of more channels are first reduced to this many, at every pixel."""
    blocks: bool = True
    """Also give the picture to a memory block after every block of the backbone; else only to its
    input."""
    mlp_ratio: int = 2
    """Hidden channels of such a block over model width."""

    @property
    def READS_LATENTS(self) -> bool:  # noqa: N802  # type: ignore[override]
        """Whether it takes the picture as the codec encodes it."""
        return self.picture == "latents"

    def check(self, model: Any) -> None:
        """Refuse clips that cannot be folded as the pictures are, and latents of features."""
        clip, q = model.clip, model.codec.temporal
        require(
            (clip.frames - 1) % q == 0,
            f"clip.frames is {clip.frames}: the memory's pictures are folded by codec.temporal = "
            f"{q}, so use {q}k + 1 frames, or memory.reader.kind attend.",
        )
        require(
            self.picture == "pixels" or not model.memory.KEEPS_FEATURES,
            "memory.reader.picture is latents, which the codec makes of colours, and this memory "
            "shows features: use memory.kind surfels or points, or memory.reader.picture pixels.",
        )

    def __post_init__(self):
        """Validate."""
        require_positive(self, "memory.reader", "picture_width", "reduced", "mlp_ratio")
        require(
            self.picture in ("pixels", "latents"),
            f"memory.reader.picture is {self.picture!r}; choose pixels or latents.",
        )


@dataclasses.dataclass(frozen=True)
class BothConfig(AttentionConfig, RenderConfig):
    """Cross-attention and rendering, one after the other at every place."""

    READS_TOKENS: ClassVar[bool] = True
    READS_VIEW: ClassVar[bool] = True

    def check(self, model: Any) -> None:
        """Refuse what either of the two refuses."""
        AttentionConfig.check(self, model)
        RenderConfig.check(self, model)

    def __post_init__(self):
        """Validate."""
        AttentionConfig.__post_init__(self)
        RenderConfig.__post_init__(self)
