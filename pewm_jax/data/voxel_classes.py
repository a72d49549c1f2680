"""What a cell of a voxel grid may be: a kind of thing in one of a few named colours.

The renderer of a voxel world knows of a cell only its class, so a class holds what appearance
needs: a wall of another colour is another class. Class 0 is empty.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np

from pewm_jax.config import ConfigError
from pewm_jax.houses.kinds import GROUPS, KINDS

EMPTY = "empty"
PALETTE = {
    "white": (235, 233, 228),
    "brown": (140, 95, 60),
    "red": (200, 75, 75),
    "green": (95, 165, 95),
    "blue": (75, 110, 190),
    "black": (45, 45, 48),
    "beige": (225, 200, 165),
    "grey": (150, 150, 150),
    "yellow": (225, 195, 90),
    "pink": (225, 165, 190),
    "mint": (165, 215, 180),
    "sky": (165, 195, 230),
    "purple": (130, 85, 165),
    "orange": (225, 140, 70),
    "teal": (70, 150, 155),
    "lilac": (195, 175, 225),
    "lime": (190, 210, 120),
    "wine": (115, 45, 65),
    "navy": (45, 60, 115),
    "olive": (110, 110, 55),
    "pine": (45, 95, 70),
    "tan": (185, 150, 115),
    "magenta": (195, 80, 165),
    "aqua": (120, 205, 210),
}
"""Names of colours and what they look like; the first ones are those that tell most apart."""
SIDE_LIMIT = 256


@dataclasses.dataclass(frozen=True)
class VoxelsConfig:
    """Grids of class ids around the agent."""

    record: bool = False
    """Record a grid with every frame; `--voxels` alone is short for it."""
    cell: float = 0.2
    """Side of a cell, metres. Up to 0.16 the two sides of a wall are never in one cell, which can
    have the colour of one of them only."""
    side: int = 48
    """Cells of the grid along each axis; the agent's camera is in the middle."""
    kinds: Literal["all", "groups"] = "all"
    """Kinds of things: `all` (every kind of furniture its own), or `groups` (all furniture one)."""
    colours: int = 16
    """Colours of each kind, 1 (colours make no difference) to 24."""
    pictures: Literal["surfaces", "cells"] = "surfaces"
    """What the images show: the house's own surfaces, or the recorded `cells` as blocks in the
    colours of their classes, as in a game of blocks."""

    def __post_init__(self):
        """Validate."""
        if not 0.01 <= self.cell <= 10:
            raise ConfigError(f"--voxels.cell is {self.cell}: use 0.01 to 10 metres.")
        if not 2 <= self.side <= SIDE_LIMIT:
            raise ConfigError(f"--voxels.side is {self.side}: use 2 to {SIDE_LIMIT} cells.")
        if not 1 <= self.colours <= len(PALETTE):
            raise ConfigError(f"--voxels.colours is {self.colours}: use 1 to {len(PALETTE)}.")

    @property
    def names(self) -> tuple[str, ...]:
        """The table of classes: name of each id, ``sofa/red``, or ``sofa`` with one colour."""
        if self.colours == 1:
            return (EMPTY, *self.kind_names)
        colours = list(PALETTE)[: self.colours]
        return (EMPTY, *(f"{kind}/{colour}" for kind in self.kind_names for colour in colours))

    @property
    def kind_names(self) -> tuple[str, ...]:
        """The kinds, or their groups, in the order of the table."""
        if self.kinds == "all":
            return KINDS
        return tuple(dict.fromkeys(GROUPS[kind] for kind in KINDS))

    @property
    def dtype(self) -> np.dtype:
        """The smallest of uint8 and uint16 that holds all ids."""
        return np.dtype("<u1" if len(self.names) <= 256 else "<u2")


def class_ids(config: VoxelsConfig, kind_N: np.ndarray, rgb_N3: np.ndarray) -> np.ndarray:
    """Return (N,) class ids of surfaces.

    Args:
        config: which classes there are.
        kind_N: (N,) indices into ``KINDS``.
        rgb_N3: (N, 3) their colours without light, in [0, 1].
    """
    row = config.kind_names.index
    of_kind = [row(kind if config.kinds == "all" else GROUPS[kind]) for kind in KINDS]
    palette = _opponent(np.array(list(PALETTE.values())[: config.colours]) / 255)
    apart = np.linalg.norm(_opponent(np.asarray(rgb_N3))[:, None] - palette, axis=-1)
    return 1 + np.array(of_kind)[kind_N] * config.colours + apart.argmin(-1)


def table_colours(names: tuple[str, ...]) -> np.ndarray:
    """Return (classes, 3) uint8 colours to draw classes with.

    A name that ends in a colour of the palette has that; others have one that follows from their
    place in the table.
    """
    found = np.zeros((len(names), 3), np.uint8)
    for k, name in enumerate(names[1:], 1):
        named = PALETTE.get(name.rpartition("/")[2])
        spread = 0.5 + 0.45 * np.cos(2 * np.pi * (k * 0.618034 + np.array([0, 1 / 3, 2 / 3])))
        found[k] = np.round(255 * spread) if named is None else named
    return found


def _opponent(rgb_N3: np.ndarray) -> np.ndarray:
    """Return colours as lightness, red − green and blue − yellow, in which hue weighs more."""
    red, green, blue = np.moveaxis(rgb_N3, -1, 0)
    light = (red + green + blue) / 3
    return np.stack([0.6 * light, red - green, (red + green) / 2 - blue], -1)
