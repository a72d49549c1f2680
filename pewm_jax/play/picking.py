"""Selection of a box in the map, by a rectangle on the screen or by a click."""

from __future__ import annotations

import dataclasses

import numpy as np

FLOOR_M, PAD_M = 0.08, 0.05
"""Height above the floor below which points count as floor; and the margin of a box, metres."""
CLICK_M = (0.9, 0.9, 1.1)
"""Size of the box around a click, metres."""
NEAR_RAY_M = 0.12
"""Largest distance of a clicked point from the ray of the click, metres."""
FIELDS, BEHIND_M = 12, 0.3
"""Number of cells along each side of a rectangle; points farther behind the nearest point of their
cell are hidden, metres."""
EDGE = 2.0
"""Percentage of the points of a rectangle that may lie outside its box, at each end."""


@dataclasses.dataclass(frozen=True)
class Eye:
    """The camera of a browser that shows the map.

    Attributes:
        position_3: position in metres.
        rotation_33: world from camera, OpenCV axes.
        fov: vertical, radians.
        aspect: width over height.
    """

    position_3: np.ndarray
    rotation_33: np.ndarray
    fov: float
    aspect: float


def floor_of(points_N3: np.ndarray) -> float:
    """Return the height of the floor: a low percentile of the points' heights."""
    return float(np.percentile(points_N3[:, 2], 2)) if len(points_N3) else 0.0


def in_rectangle(
    points_N3: np.ndarray, eye: Eye, low_2: tuple[float, float], high_2: tuple[float, float]
) -> np.ndarray | None:
    """Return the (2, 3) box of the points seen in a rectangle of the screen, or None.

    Floor points are ignored unless there are no others, and hidden points always. The rectangle's
    upper left and lower right corner are from 0 to 1 across and down.
    """
    local = (points_N3 - eye.position_3) @ eye.rotation_33
    depth = np.where(local[:, 2] > 1e-3, local[:, 2], np.inf)
    half = np.tan(eye.fov / 2)
    across = 0.5 + local[:, 0] / depth / (2 * half * eye.aspect)
    down = 0.5 + local[:, 1] / depth / (2 * half)
    inside = (across >= low_2[0]) & (across <= high_2[0]) & np.isfinite(depth)
    inside &= (down >= low_2[1]) & (down <= high_2[1])
    standing = inside & (points_N3[:, 2] > floor_of(points_N3) + FLOOR_M)
    taken = standing if standing.any() else inside
    if not taken.any():
        return None
    front = _in_front(across[taken], down[taken], depth[taken], low_2, high_2)
    chosen = points_N3[taken][front]
    low, high = np.percentile(chosen.astype(np.float64), [EDGE, 100 - EDGE], axis=0)
    return np.stack([low - PAD_M, high + PAD_M])


def _in_front(
    across_P: np.ndarray,
    down_P: np.ndarray,
    depth_P: np.ndarray,
    low_2: tuple[float, float],
    high_2: tuple[float, float],
) -> np.ndarray:
    """Return (P,) bool: which points of a rectangle are visible, per cell."""
    fields = np.zeros(len(depth_P), int)
    for place, low, high in zip((across_P, down_P), low_2, high_2, strict=True):
        share = (place - low) / max(high - low, 1e-9)
        fields = fields * FIELDS + np.clip(share * FIELDS, 0, FIELDS - 1).astype(int)
    nearest = np.full(FIELDS**2, np.inf)
    np.minimum.at(nearest, fields, depth_P)
    return depth_P <= nearest[fields] + BEHIND_M


def at_click(
    points_N3: np.ndarray, origin_3: np.ndarray, direction_3: np.ndarray
) -> np.ndarray | None:
    """Return the (2, 3) box around the first point that a screen ray hits; None if it hits nothing.

    The box stands just above the floor.
    """
    if not len(points_N3):
        return None
    direction = np.asarray(direction_3) / np.linalg.norm(direction_3)
    away = points_N3 - np.asarray(origin_3)
    along = away @ direction
    beside = np.linalg.norm(away - along[:, None] * direction, axis=-1)
    near = (along > 0) & (beside < NEAR_RAY_M)
    if not near.any():
        return None
    met = points_N3[near][along[near].argmin()]
    size, low = np.array(CLICK_M), floor_of(points_N3) + FLOOR_M
    lower = np.array([met[0] - size[0] / 2, met[1] - size[1] / 2, low])
    return np.stack([lower, lower + size])
