"""Memories: what is remembered, as which features, and how it is read."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar, Literal

from pewm_jax.config.encoder import EncoderSettings, PatchColoursConfig
from pewm_jax.config.reader import AttentionConfig, ReaderSettings
from pewm_jax.errors import require, require_positive
from pewm_jax.registry import Settings


@dataclasses.dataclass(frozen=True)
class MemorySettings(Settings):
    """Settings that every memory has; see ``pewm_jax.memory.memories`` for its functions.

    Attributes:
        KEEPS_FEATURES: whether it keeps features of the image encoder.
        READ_BY_BLOCKS: whether memory blocks read it, which are trained for that; else it is the
            state of its world.
    """

    SECTION: ClassVar[str] = "memory"
    KEEPS_FEATURES: ClassVar[bool] = True
    """Whether it keeps the encoder's features; else the first three of a point are its colour."""
    REMEMBERS: ClassVar[bool] = True
    """Whether it ever holds anything."""
    READ_BY_BLOCKS: ClassVar[bool] = True
    TELLS_IMAGINED: ClassVar[bool] = False
    """Whether its ``remember`` asks, by ``observed``, if frames were observed or imagined."""

    cell_m: tuple[float, float, float] = (0.25, 0.25, 1.0)
    """Size of a map cell along x, y, z (z is up), metres; the default is the paper's."""
    cells: tuple[int, int, int] = (128, 128, 16)
    """Cells of the grid along x, y, z; the extent in metres is cells × cell size. A larger extent
    needs no more memory."""
    capacity: int = 4096
    """Occupied cells that a map can hold; cells that do not fit are dropped and counted."""
    tokens: int = 512
    """Map tokens that condition one clip."""
    choose: Literal["visible", "nearest"] = "visible"
    """Which tokens come first: those that the clip's cameras can see, each frame and each part of
    its image in turn, hidden ones later; or the nearest in view, hidden or not."""
    imagined_far: float = 0.95
    """Imagined surfaces beyond this share of `clip.far_m` are not remembered."""
    imagined_edge: float = 0.2
    """Imagined pixels whose depth differs by more than this share from that of a pixel beside them
    are not remembered: they lie on the edge of something. 0 remembers them."""
    encoder: EncoderSettings = PatchColoursConfig()
    """The image features that are kept."""
    reader: ReaderSettings = AttentionConfig()
    """How the denoiser reads them."""

    @property
    def extent_m(self) -> float:
        """The longest side of the grid in metres."""
        return max(size * count for size, count in zip(self.cell_m, self.cells, strict=True))

    @property
    def room(self) -> int:
        """How many points it can hold."""
        return self.capacity

    @property
    def rendered_channels(self) -> int:
        """Channels of the memory's pictures: the colour, or the features that are kept."""
        return self.encoder.channels if self.KEEPS_FEATURES else 3

    def check(self, model: Any) -> None:
        """Refuse a model that the encoder or the reader does not fit."""
        if model.backbone.places is None:
            require(
                not self.REMEMBERS,
                "this backbone has no place where a memory could be read: use memory.kind none, or "
                "another backbone.",
            )
            return
        self.encoder.check(model)
        self.reader.check(model)

    def __post_init__(self):
        """Validate."""
        require(all(size > 0 for size in self.cell_m), "memory.cell_m must be positive.")
        require(all(count > 0 for count in self.cells), "memory.cells must be positive.")
        require(
            math.prod(self.cells) < 2**31,
            f"memory.cells {self.cells} make {math.prod(self.cells)} cells, more than the 2³¹ that "
            "can be numbered; take fewer or larger cells.",
        )
        require_positive(self, "memory", "capacity", "tokens")
        require(
            self.choose in ("visible", "nearest"),
            f"memory.choose is {self.choose!r}; choose visible or nearest.",
        )
        require(
            self.imagined_far > 0,
            f"memory.imagined_far is {self.imagined_far}: nothing imagined would be remembered; "
            "use a share of clip.far_m above 0, such as 0.95.",
        )
        require(
            self.imagined_edge >= 0,
            f"memory.imagined_edge is {self.imagined_edge}: use a share such as 0.2, or 0 to "
            "remember edges.",
        )
        require(
            self.tokens <= self.capacity,
            f"memory.tokens {self.tokens} exceeds memory.capacity {self.capacity}: a clip cannot "
            "attend to more cells than the map holds; raise capacity or lower tokens.",
        )


@dataclasses.dataclass(frozen=True)
class VoxelConfig(MemorySettings):
    """The 3D feature map: the maximum of the features per cell (the paper)."""


@dataclasses.dataclass(frozen=True)
class Map2DConfig(MemorySettings):
    """The feature map seen from above: a cell reaches from the floor to the ceiling."""


@dataclasses.dataclass(frozen=True)
class PointsConfig(MemorySettings):
    """Coloured points, one per cell, without features."""

    KEEPS_FEATURES: ClassVar[bool] = False


@dataclasses.dataclass(frozen=True)
class SurfelConfig(MemorySettings):
    """Small coloured surfaces at the sensor's resolution; cells, tokens and capacity as elsewhere.

    They alone know what was observed and what was imagined: see ``protect``.
    """

    TELLS_IMAGINED: ClassVar[bool] = True

    cell_m: tuple[float, float, float] = (0.04, 0.04, 0.04)
    """Size of a cell along x, y, z, metres: of all that was seen in one, one surfel is kept."""
    cells: tuple[int, int, int] = (1024, 1024, 128)
    """Cells of the grid along x, y, z; the extent costs nothing."""
    capacity: int = 65536
    """Surfels that can be kept; what does not fit is counted."""
    keep: Literal["mean", "newest"] = "mean"
    """Of what was seen in one cell: the mean of all, or what the newest frame showed."""
    protect: bool = True
    """What was imagined never changes what was observed."""
    features: bool = False
    """Keep the encoder's features beside the colour, and give them to the reader."""
    footprint: int = 3
    """Pixels that a surfel covers at most, across and down, when the memory is rendered."""
    sides: bool = True
    """Show a surfel only from the side it was seen from; from behind it hides what it hides, and
    nobody knows what it looks like: a wall of the room next door."""
    imagined_again: bool = False
    """Also remember imagined pixels at which the memory showed something when they were imagined;
    else only what is new, so that a surface does not grow with every look at it. Needs a reader or
    a gate for which the memory is rendered."""
    observed_first: bool = True
    """Show what was imagined only where nothing that was observed is shown."""

    @property
    def KEEPS_FEATURES(self) -> bool:  # noqa: N802  # type: ignore[override]
        """Whether points carry the encoder's features; else the first three are their colour."""
        return self.features

    def check(self, model: Any) -> None:
        """Refuse an encoder without room for a colour."""
        super().check(model)
        require(
            self.features or self.encoder.channels >= 4,
            f"memory.encoder has {self.encoder.channels} channels: a coloured surfel needs 4; take "
            "an encoder with more, or set memory.features.",
        )

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require_positive(self, "memory", "footprint")
        require(
            self.keep in ("mean", "newest"),
            f"memory.keep is {self.keep!r}; choose mean or newest.",
        )


@dataclasses.dataclass(frozen=True)
class ImagesConfig(MemorySettings):
    """A few snapshots that together cover what was seen."""

    snapshots: int = 8
    """Frames that are kept; together they have at most `tokens` patches."""

    def __post_init__(self):
        """Validate."""
        super().__post_init__()
        require_positive(self, "memory", "snapshots")
        require(
            self.snapshots <= self.tokens,
            f"memory.snapshots {self.snapshots} exceeds memory.tokens {self.tokens}: every "
            "snapshot needs at least one token; raise tokens or lower snapshots.",
        )


@dataclasses.dataclass(frozen=True)
class NoMemoryConfig(MemorySettings):
    """No memory; the reader exists with its parameters, but has nothing to read."""

    KEEPS_FEATURES: ClassVar[bool] = False
    REMEMBERS: ClassVar[bool] = False
