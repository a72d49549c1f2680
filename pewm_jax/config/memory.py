"""Memories: what is remembered, as which features, and how it is read."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Literal

from pewm_jax.config.parts import Memory
from pewm_jax.errors import require, require_positive


@dataclasses.dataclass(frozen=True)
class VoxelConfig(Memory):
    """The 3D feature map: the maximum of the features per cell (the paper)."""


@dataclasses.dataclass(frozen=True)
class Map2DConfig(Memory):
    """The feature map seen from above: a cell reaches from the floor to the ceiling."""


@dataclasses.dataclass(frozen=True)
class PointsConfig(Memory):
    """Coloured points, one per cell, without features."""

    KEEPS_FEATURES: ClassVar[bool] = False


@dataclasses.dataclass(frozen=True)
class SurfelConfig(Memory):
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
class ImagesConfig(Memory):
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
class NoMemoryConfig(Memory):
    """No memory; the reader exists with its parameters, but has nothing to read."""

    KEEPS_FEATURES: ClassVar[bool] = False
    REMEMBERS: ClassVar[bool] = False
