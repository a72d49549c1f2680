"""What moves in a house: the leaf of a door and a robot that cleans, as pieces of their own.

Unlike furniture, a leaf's frame has its origin in the hinge (x along the closed leaf, y through the
wall), and a robot's origin is on the floor under its middle.
"""

from __future__ import annotations

import numpy as np

from pewm_jax.houses.floorplan import DOOR_TOP_M
from pewm_jax.houses.furniture_parts import bright
from pewm_jax.houses.shapes import Piece
from pewm_jax.houses.textures import hsv, shade

LEAF_M = 0.05
"""Thickness of a leaf."""
ROBOT_RADIUS_M, ROBOT_HEIGHT_M = 0.2, 0.6


def door_leaf(rng: np.random.Generator, width: float) -> Piece:
    """A door's leaf with two panels and a handle on either side."""
    piece = Piece("door", (width, LEAF_M, DOOR_TOP_M))
    colour = hsv(rng.uniform(), rng.uniform(0.3, 0.75), rng.uniform(0.45, 0.9))
    half, top = LEAF_M / 2, DOOR_TOP_M - 0.02
    piece.box((0.01, width - 0.01), (-half, half), (0.01, top), colour)
    for side in (-1, 1):
        y = sorted((side * half, side * (half + 0.008)))
        for low, high in ((0.2, 0.95), (1.15, top - 0.2)):
            piece.box((0.15, width - 0.15), (y[0], y[1]), (low, high), shade(colour, 0.8))
        knob = sorted((side * half, side * (half + 0.05)))
        piece.box((width - 0.12, width - 0.06), (knob[0], knob[1]), (1.0, 1.08), hsv(0, 0, 0.25))
    return piece


def robot(rng: np.random.Generator) -> Piece:
    """A robot: a drum with a dark belt and a lamp on its head."""
    piece = Piece("robot", (2 * ROBOT_RADIUS_M, 2 * ROBOT_RADIUS_M, ROBOT_HEIGHT_M))
    colour = bright(rng)
    piece.prism((0, 0), (0.02, 0.2), (ROBOT_RADIUS_M, ROBOT_RADIUS_M), hsv(0, 0, 0.2), 12)
    piece.prism((0, 0), (0.2, 0.5), (ROBOT_RADIUS_M, 0.8 * ROBOT_RADIUS_M), colour, 12)
    piece.ball((0, 0, 0.52), (0.1, 0.1, 0.08), shade(colour, 1.2))
    return piece
