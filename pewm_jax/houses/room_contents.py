"""Which furniture belongs in which room."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pewm_jax.houses import fixtures as m
from pewm_jax.houses import furniture as f
from pewm_jax.houses.furniture_parts import Tones
from pewm_jax.houses.shapes import Piece

Maker = Callable[[np.random.Generator, Tones], Piece]
"""Builds one piece from chance and a room's palette."""

PROGRAMMES: dict[str, tuple[tuple[Maker, ...], tuple[Maker, ...]]] = {
    "living": (
        (f.sofa, f.tv_stand, f.bookshelf),
        (f.armchair, m.plant, m.floor_lamp, m.fireplace, m.piano, f.dresser, f.armchair, m.plant),
    ),
    "bedroom": (
        (f.bed, f.wardrobe, f.nightstand),
        (f.dresser, m.plant, m.floor_lamp, f.armchair, f.bookshelf, f.desk),
    ),
    "kitchen": (
        (m.kitchen_counter, m.fridge, m.stove),
        (m.plant, f.dresser, m.kitchen_counter),
    ),
    "bathroom": (
        (m.bathtub, m.toilet, m.washbasin),
        (m.washing_machine, m.plant, f.dresser),
    ),
    "study": (
        (f.desk, f.bookshelf, f.bookshelf),
        (f.armchair, m.floor_lamp, m.plant, f.sofa, m.piano),
    ),
    "dining": (
        (f.dresser, m.plant),
        (m.fireplace, m.floor_lamp, f.bookshelf, m.piano, m.plant),
    ),
    "kids": (
        (f.bed, m.toy_chest, f.wardrobe),
        (f.desk, f.bookshelf, m.toy_chest, m.plant, m.floor_lamp),
    ),
    "hall": (
        (m.coat_rack, f.dresser),
        (m.plant, f.wardrobe, m.floor_lamp, f.armchair, f.bookshelf),
    ),
}
"""For each use of a room: what it must have, and what it may have."""
TABLES = {"kitchen": 0.7, "dining": 1.0, "living": 0.25}
"""Chance of a dining table in the middle."""
RUGS = {"living": 0.9, "bedroom": 0.7, "kids": 0.9, "study": 0.5, "hall": 0.6, "dining": 0.4}
"""Chance of a rug."""
