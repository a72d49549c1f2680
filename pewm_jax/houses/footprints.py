"""Rectangles and poses in a room: against a wall, in front of a doorway, rotated about z."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pewm_jax.houses.floorplan import Rect, Room


def overlap(a: Rect, b: Rect) -> bool:
    """Return whether two rectangles share area."""
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def against(room: Room, side: int, at: float, depth: float, width: float) -> Rect:
    """Return the rectangle on the floor of a piece that stands against a wall."""
    x0, y0, x1, y1 = room.rect
    low, high = at - width / 2, at + width / 2
    return (
        (low, y0, high, y0 + depth),
        (x1 - depth, low, x1, high),
        (low, y1 - depth, high, y1),
        (x0, low, x0 + depth, high),
    )[side]


def doorway_clearance(room: Room, side: int, low: float, high: float) -> Rect:
    """Return the floor in front of a doorway that must stay free: 0.75 m deep."""
    return against(room, side, (low + high) / 2, 0.75, high - low)


def shift(x: float, y: float) -> np.ndarray:
    """Return the (4, 4) translation by (x, y)."""
    pose = np.eye(4)
    pose[:2, 3] = x, y
    return pose


def turned(quarters: int, at_2: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return the (4, 4) pose at a point, rotated about z by multiples of 90 degrees."""
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters % 4]
    pose = shift(float(at_2[0]), float(at_2[1]))
    pose[:2, :2] = [[c, -s], [s, c]]
    return pose


def wall_frame(room: Room, side: int, at: float) -> np.ndarray:
    """Return the (4, 4) pose of a point on a wall: x along the wall, y into the room."""
    x0, y0, x1, y1 = room.rect
    return turned(side, ((at, y0), (x1, at), (at, y1), (x0, at))[side])
