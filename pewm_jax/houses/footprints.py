"""Footprints and poses of things in a room: at a wall, in front of a doorway, turned about z."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pewm_jax.houses.floorplan import Rect, Room


def overlap(a: Rect, b: Rect) -> bool:
    """Return whether two rectangles share area."""
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def against(room: Room, side: int, at: float, depth: float, width: float) -> Rect:
    """Return the footprint of a piece at a wall."""
    x0, y0, x1, y1 = room.rect
    low, high = at - width / 2, at + width / 2
    return (
        (low, y0, high, y0 + depth),
        (x1 - depth, low, x1, high),
        (low, y1 - depth, high, y1),
        (x0, low, x0 + depth, high),
    )[side]


def apron(room: Room, side: int, low: float, high: float) -> Rect:
    """Return the floor inside a room that its doorway needs."""
    return against(room, side, (low + high) / 2, 0.75, high - low)


def shift(x: float, y: float) -> np.ndarray:
    """Return a pose moved along the ground."""
    pose = np.eye(4)
    pose[:2, 3] = x, y
    return pose


def turned(quarters: int, at_2: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return a pose turned by quarter circles about z."""
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters % 4]
    pose = shift(float(at_2[0]), float(at_2[1]))
    pose[:2, :2] = [[c, -s], [s, c]]
    return pose


def wall_frame(room: Room, side: int, at: float) -> np.ndarray:
    """Return the frame of a wall at a place along it: y points into the room."""
    x0, y0, x1, y1 = room.rect
    return turned(side, ((at, y0), (x1, at), (at, y1), (x0, at))[side])
