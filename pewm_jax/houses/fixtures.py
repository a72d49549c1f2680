"""Furniture of kitchen, bathroom, hall and children's room; decoration; the parts that move.

Unlike furniture, the frame of a door's leaf has its origin in the hinge (x along the closed leaf, y
through the wall), and the origin of a robot is on the floor under its middle.
"""

from __future__ import annotations

import numpy as np

from pewm_jax.houses import textures
from pewm_jax.houses.floorplan import DOOR_TOP_M
from pewm_jax.houses.shapes import Palette, Piece, books, bright, small_objects
from pewm_jax.houses.textures import hsv, shade

_STEEL = np.array([0.66, 0.68, 0.71])
_BLACK = np.array([0.09, 0.09, 0.1])
_PORCELAIN = np.array([0.95, 0.95, 0.96])


def kitchen_counter(rng: np.random.Generator, palette: Palette) -> Piece:
    """Base cabinets with a sink, a splashback, wall cabinets and things."""
    units = int(rng.integers(3, 5))
    width = 0.6 * units
    piece = Piece("kitchen_counter", (width, 0.63, 2.1))
    half = width / 2
    piece.box((-half, half), (0, 0.58), (0.08, 0.86), palette.second)
    piece.box((-half, half), (0, 0.62), (0.86, 0.91), shade(palette.wood, 0.85))
    piece.box((-half, half), (0, 0.015), (0.91, 1.45), palette.accent)
    piece.box((-half, half), (0, 0.34), (1.45, 2.08), palette.second)
    for k in range(units):
        x = -half + 0.6 * k
        piece.box((x + 0.02, x + 0.58), (0.58, 0.6), (0.12, 0.83), shade(palette.second, 1.25))
        piece.box((x + 0.02, x + 0.58), (0.34, 0.355), (1.48, 2.05), shade(palette.second, 1.25))
        piece.box((x + 0.48, x + 0.54), (0.6, 0.62), (0.6, 0.76), palette.dark)
    x = -half + 0.35
    piece.box((x, x + 0.5), (0.12, 0.5), (0.905, 0.915), _STEEL * 0.75)
    piece.box((x + 0.23, x + 0.27), (0.06, 0.1), (0.91, 1.18), _STEEL)
    piece.box((x + 0.23, x + 0.27), (0.06, 0.26), (1.15, 1.18), _STEEL)
    small_objects(piece, rng, (x + 0.6, half - 0.1), (0.15, 0.45), z=0.91, count=units - 1)
    return piece


def fridge(rng: np.random.Generator, palette: Palette) -> Piece:
    """A refrigerator in steel, white or the accent colour."""
    colour = (_STEEL, _PORCELAIN, palette.accent)[int(rng.integers(3))]
    high = rng.uniform(1.7, 1.95)
    piece = Piece("fridge", (0.66, 0.68, high))
    piece.box((-0.32, 0.32), (0, 0.62), (0.03, high), shade(colour, 0.85))
    piece.box((-0.31, 0.31), (0.62, 0.66), (0.06, 0.62), colour)
    piece.box((-0.31, 0.31), (0.62, 0.66), (0.66, high - 0.02), colour)
    for z in (0.4, 0.8):
        piece.box((0.22, 0.26), (0.66, 0.69), (z, z + 0.35 * (z > 0.5) + 0.15), _BLACK)
    for _ in range(3):
        x, z = rng.uniform(-0.25, 0.1), rng.uniform(0.8, high - 0.3)
        piece.box((x, x + 0.1), (0.66, 0.665), (z, z + 0.13), bright(rng))
    return piece


def stove(rng: np.random.Generator, palette: Palette) -> Piece:
    """A cooker with a pot and a hood above."""
    del palette
    piece = Piece("stove", (0.62, 0.64, 2.0))
    piece.box((-0.3, 0.3), (0, 0.6), (0, 0.9), _PORCELAIN * 0.92)
    piece.box((-0.25, 0.25), (0.6, 0.62), (0.2, 0.62), _BLACK)
    piece.box((-0.28, 0.28), (0.05, 0.57), (0.9, 0.92), _BLACK)
    for k in range(4):
        piece.box((-0.24 + 0.13 * k, -0.18 + 0.13 * k), (0.6, 0.63), (0.74, 0.8), bright(rng))
    piece.prism((-0.13, 0.22), (0.92, 1.08), (0.12, 0.12), bright(rng), 10)
    piece.prism((0.14, 0.4), (0.92, 1.0), (0.1, 0.11), _STEEL, 10)
    piece.box((-0.3, 0.3), (0, 0.45), (1.55, 1.65), _STEEL)
    piece.box((-0.12, 0.12), (0, 0.25), (1.65, 2.1), _STEEL * 0.9)
    return piece


def bathtub(rng: np.random.Generator, palette: Palette) -> Piece:
    """A bathtub with coloured water and a tap."""
    piece = Piece("bathtub", (1.65, 0.78, 0.75))
    for x in ((-0.82, -0.7), (0.7, 0.82)):
        piece.box(x, (0, 0.78), (0, 0.56), _PORCELAIN)
    for y in ((0, 0.1), (0.68, 0.78)):
        piece.box((-0.7, 0.7), y, (0, 0.56), _PORCELAIN)
    piece.box((-0.7, 0.7), (0.1, 0.68), (0, 0.42), hsv(rng.uniform(0.48, 0.56), 0.45, 0.85))
    piece.box((0.74, 0.78), (0.35, 0.43), (0.56, 0.75), _STEEL)
    piece.box((-0.5, -0.1), (0.68, 0.79), (0.3, 0.58), palette.accent)
    return piece


def toilet(rng: np.random.Generator, palette: Palette) -> Piece:
    """A toilet with a cistern."""
    del rng
    piece = Piece("toilet", (0.42, 0.7, 0.85))
    piece.box((-0.2, 0.2), (0, 0.18), (0.38, 0.82), _PORCELAIN)
    piece.prism((0, 0.42), (0, 0.38), (0.14, 0.21), _PORCELAIN * 0.95, 10)
    piece.prism((0, 0.42), (0.38, 0.43), (0.23, 0.22), palette.accent, 10)
    return piece


def washbasin(rng: np.random.Generator, palette: Palette) -> Piece:
    """A vanity with a basin and a mirror-like panel above."""
    width = rng.uniform(0.7, 1.0)
    piece = Piece("washbasin", (width, 0.5, 1.85))
    half = width / 2
    piece.box((-half, half), (0, 0.46), (0.1, 0.8), palette.second)
    piece.box((-half, half), (0, 0.5), (0.8, 0.86), _PORCELAIN)
    piece.prism((0, 0.27), (0.86, 0.92), (0.16, 0.19), _PORCELAIN, 12)
    piece.box((-0.02, 0.02), (0.04, 0.14), (0.86, 1.05), _STEEL)
    piece.box((-half * 0.85, half * 0.85), (0, 0.03), (1.15, 1.85), palette.wood)
    piece.box((-half * 0.75, half * 0.75), (0.03, 0.035), (1.2, 1.8), np.array([0.72, 0.82, 0.86]))
    return piece


def washing_machine(rng: np.random.Generator, palette: Palette) -> Piece:
    """A washing machine with a round door and a laundry basket on top."""
    piece = Piece("washing_machine", (0.62, 0.64, 1.15))
    piece.box((-0.3, 0.3), (0, 0.6), (0, 0.86), _PORCELAIN)
    piece.box((-0.28, 0.28), (0.6, 0.61), (0.72, 0.83), _STEEL)
    piece.box((-0.19, 0.19), (0.6, 0.63), (0.2, 0.58), _STEEL * 0.7)
    piece.box((-0.14, 0.14), (0.63, 0.64), (0.25, 0.53), _BLACK)
    piece.prism((0, 0.3), (0.86, 1.12), (0.18, 0.24), palette.accent, 8)
    piece.ball((0, 0.3, 1.12), (0.2, 0.2, 0.08), bright(rng))
    return piece


def plant(rng: np.random.Generator, palette: Palette) -> Piece:
    """A pot with a bush or a small tree."""
    piece = Piece("plant", (0.55, 0.55, 1.4))
    pot = palette.accent if rng.uniform() < 0.5 else hsv(0.05, 0.6, 0.65)
    piece.prism((0, 0.28), (0, 0.34), (0.13, 0.19), pot, 10)
    green = hsv(rng.uniform(0.25, 0.38), rng.uniform(0.55, 0.8), rng.uniform(0.4, 0.6))
    if rng.uniform() < 0.5:
        piece.prism((0, 0.28), (0.3, 0.95), (0.03, 0.025), hsv(0.07, 0.6, 0.35), 6)
        leaves, low, spread = 5, 1.0, 0.16
    else:
        leaves, low, spread = 6, 0.5, 0.13
    for k in range(leaves):
        angle = 2.4 * k + rng.uniform(0, 0.8)
        x, y = spread * np.cos(angle), 0.28 + spread * np.sin(angle)
        radius = rng.uniform(0.12, 0.17)
        radii = (radius, radius, radius * 1.2)
        piece.ball((x, y, low + 0.09 * k), radii, shade(green, 0.8 + 0.1 * k))
    return piece


def floor_lamp(rng: np.random.Generator, palette: Palette) -> Piece:
    """A standing lamp with a shade."""
    piece = Piece("floor_lamp", (0.42, 0.42, 1.65))
    piece.prism((0, 0.21), (0, 0.04), (0.16, 0.16), palette.dark, 10)
    piece.prism((0, 0.21), (0.04, 1.35), (0.02, 0.02), palette.dark, 6)
    lamp = hsv(rng.uniform(0.07, 0.17), rng.uniform(0.2, 0.6), 1.0)
    piece.prism((0, 0.21), (1.28, 1.62), (0.21, 0.13), lamp, 12)
    return piece


def piano(rng: np.random.Generator, palette: Palette) -> Piece:
    """An upright piano with its stool."""
    del palette
    piece = Piece("piano", (1.45, 1.0, 1.2))
    body = _BLACK if rng.uniform() < 0.5 else hsv(0.04, 0.7, 0.32)
    piece.box((-0.72, 0.72), (0, 0.32), (0, 1.2), body)
    piece.box((-0.72, 0.72), (0.32, 0.58), (0.58, 0.68), body)
    piece.box((-0.66, 0.66), (0.38, 0.57), (0.68, 0.7), _PORCELAIN)
    for k in range(12):
        piece.box((-0.6 + 0.105 * k, -0.56 + 0.105 * k), (0.38, 0.48), (0.7, 0.715), _BLACK)
    for x in (-0.7, 0.62):
        piece.box((x, x + 0.08), (0.32, 0.56), (0, 0.58), body)
    piece.box((-0.25, 0.25), (0.7, 1.0), (0.4, 0.48), hsv(rng.uniform(), 0.6, 0.5))
    for x in (-0.22, 0.17):
        piece.box((x, x + 0.05), (0.75, 0.95), (0, 0.4), body)
    return piece


def coat_rack(rng: np.random.Generator, palette: Palette) -> Piece:
    """A panel with hooks, coats and shoes below."""
    width = rng.uniform(0.9, 1.2)
    piece = Piece("coat_rack", (width, 0.4, 1.8))
    half = width / 2
    piece.box((-half, half), (0, 0.04), (1.5, 1.75), palette.wood)
    piece.box((-half, half), (0, 0.36), (0.38, 0.44), palette.wood)
    for x in (-half, half - 0.05):
        piece.box((x, x + 0.05), (0, 0.36), (0, 0.38), shade(palette.wood, 0.75))
    for k in range(3):
        x = -half + (k + 0.5) * width / 3
        piece.box((x - 0.12, x + 0.12), (0.04, 0.18), (rng.uniform(0.7, 0.95), 1.6), bright(rng))
        piece.box((x - 0.1, x + 0.1), (0.06, 0.32), (0.44, 0.52), bright(rng))
    return piece


def toy_chest(rng: np.random.Generator, palette: Palette) -> Piece:
    """An open chest with balls and blocks."""
    piece = Piece("toy_chest", (0.85, 0.5, 0.6))
    piece.box((-0.42, 0.42), (0, 0.5), (0, 0.36), palette.accent)
    piece.box((-0.36, 0.36), (0.06, 0.44), (0.36, 0.37), shade(palette.accent, 0.4))
    for k in range(4):
        x = -0.28 + 0.19 * k
        if rng.uniform() < 0.5:
            piece.ball((x, 0.25, 0.42), (0.11, 0.11, 0.11), bright(rng))
        else:
            piece.box((x - 0.08, x + 0.08), (0.17, 0.33), (0.37, 0.5), bright(rng))
    return piece


def fireplace(rng: np.random.Generator, palette: Palette) -> Piece:
    """A chimney breast with a fire and things on the mantel."""
    piece = Piece("fireplace", (1.4, 0.45, 2.4))
    stone = hsv(rng.uniform(0.02, 0.1), rng.uniform(0.15, 0.5), rng.uniform(0.55, 0.75))
    for x in ((-0.7, -0.38), (0.38, 0.7)):
        piece.box(x, (0, 0.4), (0, 0.8), stone)
    piece.box((-0.7, 0.7), (0, 0.4), (0.8, 1.1), stone)
    piece.box((-0.38, 0.38), (0, 0.06), (0, 0.8), _BLACK)
    piece.box((-0.38, 0.38), (0.06, 0.4), (0, 0.06), shade(stone, 0.5))
    for k in range(3):
        flame = hsv(0.03 + 0.045 * k, 0.95, 1.0)
        piece.prism((-0.12 + 0.12 * k, 0.2), (0.06, 0.3 + 0.1 * (k == 1)), (0.11, 0.0), flame, 6)
    piece.box((-0.76, 0.76), (0, 0.45), (1.1, 1.17), palette.wood)
    small_objects(piece, rng, (-0.6, 0.6), (0.12, 0.35), z=1.17, count=4)
    piece.box((-0.5, 0.5), (0, 0.3), (1.17, 2.4), shade(stone, 1.1))
    return piece


def wall_shelf(rng: np.random.Generator, palette: Palette) -> Piece:
    """Boards on the wall with books and things."""
    width = rng.uniform(0.7, 1.1)
    piece = Piece("wall_shelf", (width, 0.26, 0.85))
    inner = (-width / 2 + 0.04, width / 2 - 0.04)
    for z in (0.0, 0.42):
        piece.box((-width / 2, width / 2), (0, 0.25), (z, z + 0.04), palette.wood)
        if rng.uniform() < 0.5:
            books(piece, rng, inner, (0.03, 0.22), z=z + 0.04, tallest=0.3)
        else:
            small_objects(piece, rng, inner, (0.06, 0.2), z=z + 0.04, count=4)
    return piece


def picture(rng: np.random.Generator, palette: Palette) -> Piece:
    """A framed painting; z = 0 is its lower edge."""
    del palette
    width, high = rng.uniform(0.5, 1.1), rng.uniform(0.5, 0.85)
    piece = Piece("picture", (width, 0.04, high))
    half = width / 2
    piece.box((-half, half), (0, 0.03), (0, high), hsv(0.08, 0.5, rng.uniform(0.15, 0.5)))
    corners = [[half, 0.035, 0], [-half, 0.035, 0], [-half, 0.035, high], [half, 0.035, high]]
    piece.sheet(corners, textures.picture(rng))
    return piece


def clock(rng: np.random.Generator, palette: Palette) -> Piece:
    """A square wall clock; z = 0 is its lower edge."""
    piece = Piece("clock", (0.4, 0.05, 0.4))
    piece.box((-0.2, 0.2), (0, 0.03), (0, 0.4), bright(rng))
    piece.box((-0.16, 0.16), (0.03, 0.035), (0.04, 0.36), palette.white)
    piece.box((-0.015, 0.015), (0.035, 0.04), (0.2, 0.33), _BLACK)
    piece.box((-0.1, 0.0), (0.035, 0.04), (0.185, 0.215), _BLACK)
    return piece


def rug(rng: np.random.Generator, palette: Palette) -> Piece:
    """A rug: flat on the floor, walked over."""
    del palette
    width, depth = rng.uniform(1.3, 2.2), rng.uniform(0.9, 1.5)
    piece = Piece("rug", (width, depth, 0.01))
    half = width / 2
    corners = [[-half, 0, 0.012], [half, 0, 0.012], [half, depth, 0.012], [-half, depth, 0.012]]
    piece.sheet(corners, textures.rug(rng, rng.uniform()))
    return piece


def ceiling_lamp(rng: np.random.Generator, palette: Palette) -> Piece:
    """A hanging lamp; z = 0 is the ceiling, everything is below."""
    piece = Piece("ceiling_lamp", (0.5, 0.5, 0.4))
    colour = hsv(rng.uniform(0.07, 0.18), rng.uniform(0.15, 0.55), 1.0)
    piece.prism((0, 0), (-0.18, 0), (0.015, 0.015), palette.dark, 6)
    if rng.uniform() < 0.5:
        piece.prism((0, 0), (-0.36, -0.16), (0.24, 0.1), colour, 12)
    else:
        piece.ball((0, 0, -0.28), (0.16, 0.16, 0.14), colour)
    return piece


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
