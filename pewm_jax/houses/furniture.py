"""Furniture of living room, bedroom, study and dining room, built from boxes, prisms and balls."""

from __future__ import annotations

import dataclasses

import numpy as np

from pewm_jax.houses import textures
from pewm_jax.houses.shapes import Palette, Piece, books, bright, legs, small_objects
from pewm_jax.houses.textures import hsv, shade


def bed(rng: np.random.Generator, palette: Palette) -> Piece:
    """A double or single bed: frame, mattress, blanket, pillows, headboard."""
    width, length = rng.choice([1.0, 1.4, 1.6]), 2.05
    piece = Piece("bed", (width + 0.06, length, 1.0))
    half = width / 2
    piece.box((-half - 0.03, half + 0.03), (0, 0.07), (0, rng.uniform(0.85, 1.1)), palette.wood)
    piece.box((-half - 0.03, half + 0.03), (0.07, length), (0.08, 0.32), palette.wood)
    piece.box((-half, half), (0.08, length - 0.03), (0.32, 0.5), palette.white)
    piece.box((-half - 0.02, half + 0.02), (0.72, length - 0.01), (0.26, 0.55), palette.fabric)
    piece.box((-half - 0.025, half + 0.025), (0.62, 0.86), (0.3, 0.57), shade(palette.fabric, 1.35))
    piece.box((-half - 0.025, half + 0.025), (1.45, 1.75), (0.3, 0.565), palette.accent)
    for centre in (0.0,) if width < 1.2 else (-half / 2, half / 2):
        piece.ball((centre, 0.33, 0.54), (min(0.36, half * 0.44), 0.2, 0.1), palette.second)
    return piece


def nightstand(rng: np.random.Generator, palette: Palette) -> Piece:
    """A bedside cabinet with a small lamp."""
    piece = Piece("nightstand", (0.46, 0.42, 0.95))
    piece.box((-0.22, 0.22), (0, 0.4), (0.06, 0.5), palette.wood)
    for z in (0.1, 0.3):
        piece.box((-0.19, 0.19), (0.4, 0.415), (z, z + 0.16), shade(palette.wood, 1.25))
    piece.prism((0, 0.2), (0.5, 0.7), (0.05, 0.025), palette.dark, 8)
    piece.prism((0, 0.2), (0.68, 0.92), (0.16, 0.1), hsv(rng.uniform(0.08, 0.16), 0.3, 1.0), 10)
    return piece


def wardrobe(rng: np.random.Generator, palette: Palette) -> Piece:
    """A tall cupboard with two or three doors."""
    doors = int(rng.integers(2, 4))
    width, depth, high = 0.5 * doors + 0.04, 0.58, rng.uniform(1.95, 2.15)
    colour = palette.wood if rng.uniform() < 0.6 else palette.second
    piece = Piece("wardrobe", (width, depth + 0.03, high))
    piece.box((-width / 2, width / 2), (0, depth), (0, high), colour)
    for k in range(doors):
        x = -width / 2 + 0.03 + 0.5 * k
        piece.box((x, x + 0.47), (depth, depth + 0.02), (0.1, high - 0.05), shade(colour, 1.22))
        piece.box((x + 0.38, x + 0.42), (depth, depth + 0.05), (0.95, 1.2), palette.dark)
    return piece


def dresser(rng: np.random.Generator, palette: Palette) -> Piece:
    """A chest of drawers with things on top."""
    width, depth, high = rng.uniform(0.9, 1.3), 0.45, rng.uniform(0.75, 0.95)
    colour = palette.second if rng.uniform() < 0.5 else palette.wood
    piece = Piece("dresser", (width, depth + 0.03, high + 0.4))
    piece.box((-width / 2, width / 2), (0, depth), (0.05, high), colour)
    rows, front = 3, (depth, depth + 0.02)
    for k in range(rows):
        z = 0.1 + k * (high - 0.12) / rows
        for x in (-width / 2 + 0.03, 0.015):
            drawer = (x, x + width / 2 - 0.045), front, (z, z + (high - 0.12) / rows - 0.04)
            piece.box(*drawer, shade(colour, 1.25))
    inner = (-width / 2 + 0.1, width / 2 - 0.1)
    small_objects(piece, rng, inner, (0.1, depth - 0.08), z=high, count=3)
    return piece


def bookshelf(rng: np.random.Generator, palette: Palette) -> Piece:
    """An open shelf full of books and things."""
    width, depth, high = rng.uniform(0.8, 1.3), 0.32, rng.uniform(1.5, 2.1)
    piece = Piece("bookshelf", (width, depth, high))
    half, dark = width / 2, shade(palette.wood, 0.6)
    piece.box((-half, half), (0, 0.02), (0, high), dark)
    for x in (-half, half - 0.03):
        piece.box((x, x + 0.03), (0.02, depth), (0, high), palette.wood)
    count = int(high / 0.38)
    step = (high - 0.1) / count
    inner = (-half + 0.04, half - 0.04)
    for k in range(count + 1):
        z = 0.06 + k * step
        piece.box((-half + 0.03, half - 0.03), (0.02, depth), (z, z + 0.03), palette.wood)
        if k < count:
            books(piece, rng, inner, (0.06, depth - 0.03), z=z + 0.03, tallest=step - 0.05)
    return piece


def sofa(rng: np.random.Generator, palette: Palette) -> Piece:
    """A sofa of two or three seats with cushions."""
    seats = int(rng.integers(2, 4))
    return _seating("sofa", 0.62 * seats, rng, palette, seats)


def armchair(rng: np.random.Generator, palette: Palette) -> Piece:
    """A wide upholstered chair in the room's second colour."""
    swapped = dataclasses.replace(palette, fabric=palette.accent, accent=palette.fabric)
    return _seating("armchair", 0.56, rng, swapped, 1)


def _seating(
    kind: str, inner: float, rng: np.random.Generator, palette: Palette, seats: int
) -> Piece:
    width, depth, back = inner + 0.36, 0.88, rng.uniform(0.75, 0.92)
    piece = Piece(kind, (width, depth, back))
    half, cloth = width / 2, palette.fabric
    piece.box((-half, half), (0, 0.24), (0.06, back), cloth)
    piece.box((-half, -half + 0.18), (0.24, depth), (0.06, 0.6), shade(cloth, 0.9))
    piece.box((half - 0.18, half), (0.24, depth), (0.06, 0.6), shade(cloth, 0.9))
    piece.box((-half + 0.18, half - 0.18), (0.24, depth - 0.02), (0.06, 0.3), shade(cloth, 0.8))
    for k in range(seats):
        x = -inner / 2 + k * inner / seats
        cushion = (x + 0.01, x + inner / seats - 0.01)
        piece.box(cushion, (0.24, depth), (0.3, 0.45), shade(cloth, 1.15))
    for k in range(seats):
        if seats == 1 or rng.uniform() < 0.7:
            x = -inner / 2 + (k + 0.5) * inner / seats
            colour = palette.accent if k % 2 == 0 else palette.second
            piece.ball((x, 0.33, 0.6), (0.2, 0.1, 0.18), colour)
    return piece


def coffee_table(rng: np.random.Generator, palette: Palette) -> Piece:
    """A low table with things on it."""
    if rng.uniform() < 0.35:
        piece = Piece("coffee_table", (0.8, 0.8, 0.42))
        piece.prism((0, 0.4), (0.36, 0.42), (0.4, 0.4), palette.wood, 14)
        piece.prism((0, 0.4), (0, 0.36), (0.18, 0.1), palette.dark, 8)
    else:
        piece = Piece("coffee_table", (1.05, 0.58, 0.42))
        piece.box((-0.52, 0.52), (0, 0.58), (0.36, 0.42), palette.wood)
        legs(piece, 1.0, (0.02, 0.56), 0.36, 0.06, shade(palette.wood, 0.7))
    small_objects(piece, rng, (-0.3, 0.3), (0.2, 0.42), z=0.42, count=2)
    return piece


def tv_stand(rng: np.random.Generator, palette: Palette) -> Piece:
    """A low cabinet with a television."""
    width = rng.uniform(1.3, 1.7)
    piece = Piece("tv_stand", (width, 0.44, 1.25))
    piece.box((-width / 2, width / 2), (0, 0.42), (0.08, 0.48), palette.wood)
    for k in range(3):
        x = -width / 2 + 0.03 + k * (width - 0.03) / 3
        door = (x, x + (width - 0.12) / 3)
        piece.box(door, (0.42, 0.435), (0.14, 0.42), shade(palette.wood, 1.3))
    piece.box((-0.12, 0.12), (0.12, 0.28), (0.48, 0.54), palette.dark)
    half = rng.uniform(0.5, 0.62)
    piece.box((-half, half), (0.16, 0.22), (0.54, 0.54 + 1.16 * half), np.array([0.06, 0.06, 0.07]))
    low, high, x = 0.58, 0.50 + 1.16 * half, half - 0.04
    corners = [[x, 0.225, low], [-x, 0.225, low], [-x, 0.225, high], [x, 0.225, high]]
    piece.sheet(corners, textures.screen(rng), glowing=True)
    return piece


def dining_table(rng: np.random.Generator, palette: Palette) -> Piece:
    """A table, round or long, with a bowl, plates or flowers."""
    if rng.uniform() < 0.4:
        piece = Piece("dining_table", (1.1, 1.1, 0.76))
        piece.prism((0, 0.55), (0.71, 0.76), (0.55, 0.55), palette.wood, 16)
        piece.prism((0, 0.55), (0, 0.71), (0.28, 0.07), shade(palette.wood, 0.7), 8)
    else:
        piece = Piece("dining_table", (rng.uniform(1.2, 1.6), 0.85, 0.76))
        width = piece.size[0]
        piece.box((-width / 2, width / 2), (0, 0.85), (0.71, 0.76), palette.wood)
        legs(piece, width - 0.06, (0.03, 0.82), 0.71, 0.07, shade(palette.wood, 0.75))
    middle = piece.size[1] / 2
    piece.prism((0, middle), (0.76, 0.9), (0.08, 0.15), palette.accent, 10)
    for k in range(3):
        piece.ball((0.06 * (k - 1), middle + 0.02 * k, 0.91), (0.06, 0.06, 0.06), bright(rng))
    for x in (-0.4, 0.4):
        piece.prism((x, middle), (0.76, 0.78), (0.11, 0.12), palette.white, 10)
    return piece


def chair(rng: np.random.Generator, palette: Palette) -> Piece:
    """A wooden chair; its back is at y = 0."""
    colour = palette.wood if rng.uniform() < 0.5 else palette.accent
    piece = Piece("chair", (0.44, 0.46, 0.9))
    legs(piece, 0.42, (0, 0.44), 0.43, 0.045, shade(colour, 0.75))
    piece.box((-0.22, 0.22), (0, 0.46), (0.43, 0.48), shade(colour, 1.1))
    for x in (-0.21, 0.165):
        piece.box((x, x + 0.045), (0, 0.045), (0.48, 0.9), shade(colour, 0.75))
    piece.box((-0.2, 0.2), (0.005, 0.04), (0.62, 0.88), colour)
    return piece


def desk(rng: np.random.Generator, palette: Palette) -> Piece:
    """A desk with a screen, a keyboard, a lamp and papers."""
    width = rng.uniform(1.15, 1.5)
    piece = Piece("desk", (width, 0.66, 1.25))
    half = width / 2
    piece.box((-half, half), (0, 0.66), (0.7, 0.75), palette.wood)
    piece.box((half - 0.42, half - 0.02), (0.04, 0.62), (0.05, 0.7), palette.second)
    drawer = (half - 0.4, half - 0.04), (0.62, 0.635)
    for z in (0.1, 0.3, 0.5):
        piece.box(*drawer, (z, z + 0.17), shade(palette.second, 1.25))
    piece.box((-half, -half + 0.06), (0.02, 0.64), (0, 0.7), shade(palette.wood, 0.8))
    dark = np.array([0.08, 0.08, 0.1])
    piece.box((-0.06, 0.06), (0.14, 0.22), (0.75, 0.85), dark)
    piece.box((-0.32, 0.32), (0.14, 0.18), (0.84, 1.22), dark)
    corners = [[0.3, 0.185, 0.86], [-0.3, 0.185, 0.86], [-0.3, 0.185, 1.2], [0.3, 0.185, 1.2]]
    piece.sheet(corners, textures.screen(rng), glowing=True)
    piece.box((-0.22, 0.22), (0.36, 0.5), (0.75, 0.77), palette.dark)
    books(piece, rng, (-half + 0.05, -half + 0.32), (0.05, 0.25), z=0.75, tallest=0.3)
    return piece


def office_chair(rng: np.random.Generator, palette: Palette) -> Piece:
    """A swivel chair."""
    piece = Piece("office_chair", (0.56, 0.56, 1.0))
    dark = np.array([0.15, 0.15, 0.17])
    piece.prism((0, 0.28), (0.02, 0.08), (0.28, 0.24), dark, 5)
    piece.prism((0, 0.28), (0.08, 0.42), (0.04, 0.04), dark, 6)
    piece.box((-0.25, 0.25), (0.05, 0.53), (0.42, 0.52), palette.accent)
    piece.box((-0.22, 0.22), (0, 0.08), (0.56, rng.uniform(0.95, 1.1)), palette.accent)
    return piece
