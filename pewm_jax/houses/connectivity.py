"""Check that an agent can walk into every room of a furnished house."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from pewm_jax.houses.floorplan import Plan, Rect

CELL_M = 0.05
"""Cell of the raster."""
CLEAR_M = 0.33
"""Distance kept from walls and furniture; an agent of 0.2 m and grid cells of 0.1 m."""


def all_reachable(plan: Plan, footprints: list[Rect]) -> bool:
    """Return whether free floor joins all doorways and covers part of every room.

    Args:
        plan: rooms and doorways.
        footprints: rectangles on the ground that furniture takes.
    """
    rects = np.array([room.rect for room in plan.rooms])
    origin = rects[:, :2].min(0) - 2 * CELL_M
    columns, rows = np.ceil((rects[:, 2:].max(0) + 2 * CELL_M - origin) / CELL_M).astype(int)
    floor = np.zeros((rows, columns), bool)
    for rect in [*rects, *(rect for _, _, rect in plan.doorways)]:
        floor[_cells(rect, origin)] = True
    for rect in footprints:
        floor[_cells(rect, origin)] = False
    distance = np.asarray(ndimage.distance_transform_edt(floor)) * CELL_M
    labels = np.zeros(floor.shape, np.int32)
    ndimage.label(distance >= CLEAR_M, output=labels)
    if not labels.any():
        return False
    largest = 1 + int(np.bincount(labels.ravel())[1:].argmax())
    for _, _, (x0, y0, x1, y1) in plan.doorways:
        column, row = ((np.array([x0 + x1, y0 + y1]) / 2 - origin) / CELL_M).astype(int)
        if labels[row, column] != largest:
            return False
    return all((labels[_cells(rect, origin)] == largest).any() for rect in rects)


def _cells(rect: Rect | np.ndarray, origin_2: np.ndarray) -> tuple[slice, slice]:
    """Return the rows and columns of cells whose centres a rectangle covers."""
    x0, y0, x1, y1 = (np.asarray(rect) - np.tile(origin_2, 2)) / CELL_M
    return slice(round(y0), round(y1)), slice(round(x0), round(x1))
