"""Floor plans: rooms, doorways and windows as rectangles on the ground, and which are reachable."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

WALL_M = 0.12
"""Thickness of walls."""
DOOR_TOP_M = 2.08
"""Height of doorways."""
MIN_ROOM_SIDE_M = 2.7
"""Shortest side of a room between wall centres."""
MIN_SHARED_WALL_M = 1.5
"""Shortest common wall that gets a doorway."""
Rect = tuple[float, float, float, float]
"""x0, y0, x1, y1 in metres."""


@dataclasses.dataclass(frozen=True)
class Opening:
    """A doorway or a window in one wall of a room.

    Attributes:
        side: wall it is in: 0 south (y low), 1 east, 2 north, 3 west.
        low: start along the wall (x for south and north, y otherwise), world metres.
        high: end along the wall.
        bottom: lower edge above the floor, metres; ``top`` is its upper edge.
        kind: ``door`` or ``window``.
    """

    side: int
    low: float
    high: float
    bottom: float
    top: float
    kind: str


@dataclasses.dataclass(frozen=True)
class Room:
    """One room: the rectangle between its walls' surfaces, its use, and its openings."""

    rect: Rect
    use: str
    openings: tuple[Opening, ...]

    def span(self, side: int) -> tuple[float, float]:
        """Return where a wall starts and ends along its axis."""
        x0, y0, x1, y1 = self.rect
        return (x0, x1) if side % 2 == 0 else (y0, y1)


@dataclasses.dataclass(frozen=True)
class FloorPlan:
    """The floor plan of a house: rooms, and doorways as (room, room, rectangle)."""

    rooms: tuple[Room, ...]
    doorways: tuple[tuple[int, int, Rect], ...]
    height: float


def draw_plan(rng: np.random.Generator) -> FloorPlan:
    """Draw a floor plan of 3 to 8 rooms in which every room can be reached."""
    count = int(rng.integers(3, 9))
    cells = _split(rng, count)
    doorways = _doorways(rng, cells, _shared_walls(cells))
    openings: list[list[Opening]] = [[] for _ in cells]
    for a, b, side, low, high in doorways:
        openings[a].append(Opening(side, low, high, 0.0, DOOR_TOP_M, "door"))
        openings[b].append(Opening((side + 2) % 4, low, high, 0.0, DOOR_TOP_M, "door"))
    half = WALL_M / 2
    rects = [(x0 + half, y0 + half, x1 - half, y1 - half) for x0, y0, x1, y1 in cells]
    outer = (0.0, 0.0, max(c[2] for c in cells), max(c[3] for c in cells))
    for index, cell in enumerate(cells):
        openings[index] += _windows(rng, cell, outer)
    uses = _uses(rng, [(r[2] - r[0]) * (r[3] - r[1]) for r in rects])
    rooms = tuple(map(Room, rects, uses, map(tuple, openings)))
    passages = tuple(
        (a, b, _passage(cells[a], side, low, high)) for a, b, side, low, high in doorways
    )
    return FloorPlan(rooms, passages, float(rng.uniform(2.5, 2.8)))


def _split(rng: np.random.Generator, count: int) -> list[Rect]:
    """Split a rectangle into rooms; large ones are split first, across their longer side."""
    while True:
        area = count * rng.uniform(12.5, 17.0)
        aspect = rng.uniform(0.75, 1.35)
        width = round(float(np.sqrt(area * aspect)), 1)
        cells: list[Rect] = [(0.0, 0.0, width, round(area / width, 1))]
        while len(cells) < count:
            sides = np.array([(x1 - x0, y1 - y0) for x0, y0, x1, y1 in cells])
            areas = sides.prod(1)
            pick = int(rng.choice(len(cells), p=areas**2 / (areas**2).sum()))
            if sides[pick].max() < 2 * MIN_ROOM_SIDE_M:
                pick = int(areas.argmax())
            x0, y0, x1, y1 = cells.pop(pick)
            across, fraction = x1 - x0 > y1 - y0, rng.uniform(0.36, 0.64)
            length = x1 - x0 if across else y1 - y0
            if length < 2 * MIN_ROOM_SIDE_M:
                break
            cut = np.clip(fraction * length, MIN_ROOM_SIDE_M, length - MIN_ROOM_SIDE_M)
            cut = round(float(cut), 2)
            if across:
                cells += [(x0, y0, x0 + cut, y1), (x0 + cut, y0, x1, y1)]
            else:
                cells += [(x0, y0, x1, y0 + cut), (x0, y0 + cut, x1, y1)]
        if len(cells) == count and _connected(count, _shared_walls(cells)):
            return cells


def _shared_walls(cells: list[Rect]) -> list[tuple[int, int, int, float, float]]:
    """Return (a, b, side of a, low, high) of all shared walls long enough for a doorway."""
    found = []
    for a, ra in enumerate(cells):
        for b, rb in enumerate(cells):
            for side, axis in ((1, 0), (2, 1)):
                if abs(ra[axis + 2] - rb[axis]) > 1e-6:
                    continue
                along = 1 - axis
                low, high = max(ra[along], rb[along]), min(ra[along + 2], rb[along + 2])
                if high - low >= MIN_SHARED_WALL_M:
                    found.append((a, b, side, low, high))
    return found


def _connected(count: int, walls: list[tuple[int, int, int, float, float]]) -> bool:
    a, b = [w[0] for w in walls], [w[1] for w in walls]
    graph = coo_matrix((np.ones(len(walls)), (a, b)), shape=(count, count))
    return connected_components(graph, directed=False)[0] == 1


def _doorways(
    rng: np.random.Generator, cells: list[Rect], walls: list[tuple[int, int, int, float, float]]
) -> list[tuple[int, int, int, float, float]]:
    """Choose a random spanning tree of the shared walls plus a few more, and cut doorways."""
    group = list(range(len(cells)))
    chosen = []
    for index in rng.permutation(len(walls)):
        a, b, side, low, high = walls[index]
        new = group[a] != group[b]
        if not new and rng.uniform() > 0.3:
            continue
        group = [group[a] if g == group[b] else g for g in group]
        wide = high - low > 3.0 and rng.uniform() < 0.3
        width = rng.uniform(1.5, 2.0) if wide else rng.uniform(0.95, 1.1)
        start = rng.uniform(low + 0.2, high - 0.2 - width)
        chosen.append((a, b, side, round(start, 2), round(start + width, 2)))
    return chosen


def _passage(cell: Rect, side: int, low: float, high: float) -> Rect:
    """Return the rectangle through the wall on the east (1) or north (2) side of a cell."""
    half = WALL_M / 2
    if side == 1:
        return cell[2] - half, low, cell[2] + half, high
    return low, cell[3] - half, high, cell[3] + half


def _windows(rng: np.random.Generator, cell: Rect, outer: Rect) -> list[Opening]:
    """Put windows into outer walls."""
    found = []
    for side, index in ((0, 1), (1, 2), (2, 3), (3, 0)):
        if abs(cell[index] - outer[index]) > 1e-6 or rng.uniform() < 0.3:
            continue
        low, high = (cell[0], cell[2]) if side % 2 == 0 else (cell[1], cell[3])
        width = min(rng.uniform(1.0, 1.9), high - low - 1.0)
        start = rng.uniform(low + 0.5, high - 0.5 - width)
        bottom = rng.uniform(0.85, 1.05)
        found.append(Opening(side, start, start + width, bottom, bottom + 1.1, "window"))
    return found


def _uses(rng: np.random.Generator, areas: list[float]) -> list[str]:
    """Make the largest room the living room, the smallest the bathroom, and draw the rest."""
    order = np.argsort(areas)[::-1]
    middle = ["bedroom", "kitchen", "study", "dining", "kids", "bedroom"]
    rest = [*middle[:2], *rng.permutation(middle[2:])][: len(areas) - 2]
    if len(areas) > 6:
        rest[-1] = "hall"
    names = ["living", *rest, "bathroom"]
    uses = [""] * len(areas)
    for room, name in zip(order, names, strict=True):
        uses[room] = str(name)
    return uses


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


CELL_M = 0.05
"""Side of a raster cell, metres."""
CLEAR_M = 0.33
"""Distance kept from walls and furniture: an agent's radius of 0.2 m and grid cells of 0.1 m."""


def all_reachable(plan: FloorPlan, footprints: list[Rect]) -> bool:
    """Return whether free floor joins all doorways and covers part of every room.

    ``footprints`` are the rectangles on the ground occupied by furniture.
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
    region = largest_region(distance >= CLEAR_M)
    for _, _, (x0, y0, x1, y1) in plan.doorways:
        column, row = ((np.array([x0 + x1, y0 + y1]) / 2 - origin) / CELL_M).astype(int)
        if not region[row, column]:
            return False
    return all(region[_cells(rect, origin)].any() for rect in rects)


def largest_region(free_YX: np.ndarray) -> np.ndarray:
    """Return the largest region of free cells, joined by sides; empty if no cell is free."""
    labels = np.zeros(free_YX.shape, np.int32)
    ndimage.label(free_YX, output=labels)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return (labels == sizes.argmax()) & free_YX


def _cells(rect: Rect | np.ndarray, origin_2: np.ndarray) -> tuple[slice, slice]:
    """Return the rows and columns of cells whose centres a rectangle covers."""
    x0, y0, x1, y1 = (np.asarray(rect) - np.tile(origin_2, 2)) / CELL_M
    return slice(round(y0), round(y1)), slice(round(x0), round(x1))
