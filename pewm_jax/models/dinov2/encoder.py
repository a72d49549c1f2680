"""The paper's image encoder: patch tokens of a frozen DINOv2."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

from jax.sharding import PartitionSpec as P

from pewm_jax.config import serialize
from pewm_jax.config.parts import Encoder, Rules
from pewm_jax.errors import require, require_positive
from pewm_jax.models.dinov2 import model as dinov2
from pewm_jax.models.dinov2.config import DINOv2Config
from pewm_jax.types import Array, Params


@dataclasses.dataclass(frozen=True)
class DINOv2EncoderConfig(Encoder):
    """Patch tokens of a frozen DINOv2 (the paper); the weights come from a converted checkpoint."""

    SHARDING: ClassVar[Rules] = (
        (r"encoder/.*/kernel", P(None, "fsdp")),
        (r"encoder/position_embed", P(None, "fsdp")),
        (r"encoder/register_tokens", P(None, "fsdp")),
        (r"encoder/blocks/scale[12]", P()),
        (r"encoder/cls_token", P()),
        (r"encoder/.*/(scale|bias)", P()),
    )
    """Weights are stored sharded and gathered for use; each device encodes its own frames."""
    CONVERTED: ClassVar[bool] = True

    size: int = 518
    """Side in pixels of the square that images are resized to; a multiple of the patch. 518 gives
    37 × 37 patches."""
    network: DINOv2Config = DINOv2Config()
    """The network."""

    @property
    def channels(self) -> int:
        """Number of features of a patch: the network's width."""
        return self.network.width

    def grid(self, clip: Any) -> tuple[int, int]:
        """Return the rows and columns of patches, equal for all frames, which are resized."""
        del clip
        return self.size // self.network.patch, self.size // self.network.patch

    def __post_init__(self):
        """Validate."""
        require_positive(self, "memory.encoder", "size")
        require(
            self.size % self.network.patch == 0,
            f"memory.encoder.size is {self.size}: use a multiple of memory.encoder.network.patch "
            f"{self.network.patch}, 518 for the paper's 37 × 37 features.",
        )

    def init(self, key: Array) -> Params:
        """Return random parameters."""
        return dinov2.init(self.network, key)

    def encode(self, params: Params, rgb_THWC: Array) -> Array:
        """Return (T, size/p, size/p, D) patch tokens."""
        images = dinov2.preprocess(rgb_THWC, self.size, self.network.patch)
        return dinov2.apply(self.network, params, images)

    def preprocessing(self) -> dict[str, Any]:
        """Return what the features depend on besides the weights."""
        return {
            "network": serialize.to_dict(self.network),
            "preprocessing": {
                "size": self.size,
                "resize": "bicubic, antialiased",
                "mean": list(dinov2.MEAN_3),
                "std": list(dinov2.STD_3),
            },
        }
