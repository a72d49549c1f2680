"""Which furniture belongs in which room."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pewm_jax.houses import fixtures, furniture
from pewm_jax.houses.furniture_parts import Palette
from pewm_jax.houses.shapes import Piece

Maker = Callable[[np.random.Generator, Palette], Piece]
"""Builds one piece of furniture from random numbers and a room's palette."""

FURNITURE: dict[str, tuple[tuple[Maker, ...], tuple[Maker, ...]]] = {
    "living": (
        (furniture.sofa, furniture.tv_stand, furniture.bookshelf),
        (
            furniture.armchair,
            fixtures.plant,
            fixtures.floor_lamp,
            fixtures.fireplace,
            fixtures.piano,
            furniture.dresser,
            furniture.armchair,
            fixtures.plant,
        ),
    ),
    "bedroom": (
        (furniture.bed, furniture.wardrobe, furniture.nightstand),
        (
            furniture.dresser,
            fixtures.plant,
            fixtures.floor_lamp,
            furniture.armchair,
            furniture.bookshelf,
            furniture.desk,
        ),
    ),
    "kitchen": (
        (fixtures.kitchen_counter, fixtures.fridge, fixtures.stove),
        (fixtures.plant, furniture.dresser, fixtures.kitchen_counter),
    ),
    "bathroom": (
        (fixtures.bathtub, fixtures.toilet, fixtures.washbasin),
        (fixtures.washing_machine, fixtures.plant, furniture.dresser),
    ),
    "study": (
        (furniture.desk, furniture.bookshelf, furniture.bookshelf),
        (furniture.armchair, fixtures.floor_lamp, fixtures.plant, furniture.sofa, fixtures.piano),
    ),
    "dining": (
        (furniture.dresser, fixtures.plant),
        (
            fixtures.fireplace,
            fixtures.floor_lamp,
            furniture.bookshelf,
            fixtures.piano,
            fixtures.plant,
        ),
    ),
    "kids": (
        (furniture.bed, fixtures.toy_chest, furniture.wardrobe),
        (
            furniture.desk,
            furniture.bookshelf,
            fixtures.toy_chest,
            fixtures.plant,
            fixtures.floor_lamp,
        ),
    ),
    "hall": (
        (fixtures.coat_rack, furniture.dresser),
        (
            fixtures.plant,
            furniture.wardrobe,
            fixtures.floor_lamp,
            furniture.armchair,
            furniture.bookshelf,
        ),
    ),
}
"""For each use of a room: the furniture placed first, and the furniture placed as space allows."""
DINING_TABLE_PROBABILITY = {"kitchen": 0.7, "dining": 1.0, "living": 0.25}
"""Probability of a dining table in the middle of the room, 0 for the other uses."""
RUG_PROBABILITY = {
    "living": 0.9,
    "bedroom": 0.7,
    "kids": 0.9,
    "study": 0.5,
    "hall": 0.6,
    "dining": 0.4,
}
"""Probability of a rug."""
