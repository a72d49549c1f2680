"""Parts shared by many pieces of furniture: a room's palette, legs, books, small objects."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from pewm_jax.houses.shapes import Piece
from pewm_jax.houses.textures import Rgb, hsv


@dataclasses.dataclass(frozen=True)
class Palette:
    """The palette of one room."""

    wall: Rgb
    wood: Rgb
    fabric: Rgb
    accent: Rgb
    second: Rgb
    white: Rgb
    dark: Rgb


def bright(rng: np.random.Generator) -> Rgb:
    """Return a saturated colour for small things."""
    return hsv(rng.uniform(), rng.uniform(0.55, 0.9), rng.uniform(0.5, 0.95))


def legs(
    piece: Piece,
    width: float,
    y: tuple[float, float],
    *,
    top: float,
    thick: float,
    colour: Rgb,
) -> None:
    """Add four legs under a top of that width between two depths."""
    for x0 in (-width / 2, width / 2 - thick):
        for y0 in (y[0], y[1] - thick):
            piece.box((x0, x0 + thick), (y0, y0 + thick), (0, top), colour)


def books(
    piece: Piece,
    rng: np.random.Generator,
    x: tuple[float, float],
    y: tuple[float, float],
    *,
    z: float,
    tallest: float,
) -> None:
    """Fill a shelf with books of many colours, here and there a vase or a box."""
    at = x[0]
    while at < x[1] - 0.07:
        what = rng.uniform()
        if what < 0.72:
            width = min(rng.uniform(0.06, 0.13), x[1] - at)
            high = z + tallest * rng.uniform(0.6, 0.95)
            piece.box(
                (at, at + width * 0.94), (y[0], y[1] - rng.uniform(0, 0.05)), (z, high), bright(rng)
            )
            at += width
        elif what < 0.86 and x[1] - at > 0.2:
            centre = (at + 0.1, (y[0] + y[1]) / 2)
            piece.prism(centre, (z, z + tallest * 0.7), (0.05, 0.09), bright(rng), 8)
            at += 0.22
        else:
            at += rng.uniform(0.08, 0.2)


def small_objects(
    piece: Piece,
    rng: np.random.Generator,
    x: tuple[float, float],
    y: tuple[float, float],
    *,
    z: float,
    count: int,
) -> None:
    """Put vases, boxes, bowls, small plants and balls next to each other on a top."""
    edges = np.linspace(x[0], x[1], count + 1)
    for low, high in itertools.pairwise(edges):
        cx, cy = (low + high) / 2, rng.uniform(y[0] + 0.05, max(y[0] + 0.06, y[1] - 0.05))
        room = min((high - low) / 2 * 0.85, 0.14)
        kind = rng.integers(5)
        if kind == 0:
            piece.prism((cx, cy), (z, z + 0.25), (room * 0.7, room * 0.4), bright(rng), 8)
        elif kind == 1:
            piece.box((cx - room, cx + room), (cy - 0.08, cy + 0.08), (z, z + 0.14), bright(rng))
        elif kind == 2:
            piece.prism((cx, cy), (z, z + 0.1), (room * 0.5, room), bright(rng), 8)
        elif kind == 3:
            piece.prism((cx, cy), (z, z + 0.1), (0.06, 0.08), bright(rng), 8)
            piece.ball((cx, cy, z + 0.2), (0.11, 0.11, 0.13), hsv(0.3, 0.7, 0.5))
        else:
            piece.ball((cx, cy, z + room * 0.8), (room * 0.8,) * 3, bright(rng))
