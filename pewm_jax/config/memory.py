"""What is remembered, and how the denoiser reads it."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

from pewm_jax.config.dinov2 import DINOv2Config
from pewm_jax.config.errors import require, require_positive


@dataclasses.dataclass(frozen=True)
class MemoryConfig:
    """What is remembered, and how the denoiser reads it."""

    kind: Literal["voxel", "none", "images", "map2d", "points"] = "voxel"
    """What is remembered: `voxel` (the 3D feature map), `none` (nothing), `images` (a few
    snapshots), `map2d` (a feature map seen from above), `points` (coloured points, no features)."""
    depth: bool = True
    """Whether the denoiser sees and makes depth; without it only observed frames are remembered."""
    cell_m: tuple[float, float, float] = (0.25, 0.25, 1.0)
    """Size of a map cell along x, y, z (z is up), metres; the default is the paper's."""
    cells: tuple[int, int, int] = (128, 128, 16)
    """Cells of the grid along x, y, z; the extent in metres is cells × cell size, and costs
    nothing."""
    capacity: int = 4096
    """Occupied cells a map can hold; what does not fit is counted."""
    tokens: int = 512
    """Occupied cells that condition one clip, in view and nearest first."""
    looks: int = 128
    """Of these, how many each frame's camera looks at with projective positions."""
    positions: Literal["projective", "sinusoid"] = "projective"
    """How attention knows where a cell is: `projective` (seen through each frame's camera) or
    `sinusoid` (the paper: 3D sinusoid of the position in the first frame's camera)."""
    frame: Literal["camera", "world"] = "camera"
    """Where a `sinusoid` counts positions from: the clip's first camera, or the world's origin."""
    snapshots: int = 8
    """Frames that the memory `images` keeps; together they have at most `tokens` patches."""
    encoder: Literal["patch_colours", "dinov2"] = "patch_colours"
    """Image features kept in the map: `patch_colours` has no weights, `dinov2` (the paper's) takes
    them from a converted checkpoint."""
    encoder_patch: int = 2
    """Pixels per patch of `patch_colours`, each way."""
    encoder_size: int = 518
    """Side of the square picture that `dinov2` is shown, pixels; a multiple of its patch. 518
    gives 37 × 37 features."""
    dinov2: DINOv2Config = DINOv2Config()
    """The network of `dinov2`."""
    heads: int = 6
    """Heads of the memory attention."""
    head_dim: int = 32
    """Width of a memory head; a multiple of 8."""
    mlp_ratio: int = 4
    """Feed-forward width over model width in the memory blocks."""

    def __post_init__(self):
        """Validate."""
        require(all(size > 0 for size in self.cell_m), "memory.cell_m must be positive.")
        require(all(count > 0 for count in self.cells), "memory.cells must be positive.")
        require(
            math.prod(self.cells) < 2**31,
            f"memory.cells {self.cells} make {math.prod(self.cells)} cells, more than the 2³¹ that "
            "can be numbered; take fewer or larger cells.",
        )
        require_positive(self, "memory", "capacity", "tokens", "looks", "snapshots")
        require_positive(self, "memory", "encoder_patch", "encoder_size")
        require_positive(self, "memory", "heads", "head_dim", "mlp_ratio")
        require(
            self.tokens <= self.capacity,
            f"memory.tokens {self.tokens} exceeds memory.capacity {self.capacity}: a clip cannot "
            "attend to more cells than the map holds; raise capacity or lower tokens.",
        )
        require(
            self.encoder_size % self.dinov2.patch == 0,
            f"memory.encoder_size is {self.encoder_size}: use a multiple of memory.dinov2.patch "
            f"{self.dinov2.patch}, 518 for the paper's 37 × 37 features.",
        )
        require(
            self.kind != "images" or self.snapshots <= self.tokens,
            f"memory.snapshots {self.snapshots} exceeds memory.tokens {self.tokens}: every "
            "snapshot needs at least one token; raise tokens or lower snapshots.",
        )
        require(
            self.head_dim % 8 == 0,
            f"memory.head_dim is {self.head_dim}: use a multiple of 8, the projective rotary "
            "embedding splits a head in two times two halves.",
        )
