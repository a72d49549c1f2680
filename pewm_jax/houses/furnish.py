"""Place furniture in rooms so that every doorway stays reachable.

``FURNITURE`` lists which furniture belongs in which room. A piece is accepted only if it keeps
clear of other pieces, of doorways and of windows, and if the free floor still connects all doorways
of the room.
"""

from __future__ import annotations

import numpy as np

from pewm_jax.houses import fixtures, furniture
from pewm_jax.houses.floorplan import (
    Rect,
    Room,
    against,
    largest_region,
    overlap,
    shift,
    turned,
    wall_frame,
)
from pewm_jax.houses.shapes import Palette, Piece

FURNITURE: dict[str, tuple[list[str], list[str]]] = {
    use: (first.split(), then.split())
    for use, first, then in (
        (
            "living",
            "sofa tv_stand bookshelf",
            "armchair plant floor_lamp fireplace piano dresser armchair plant",
        ),
        (
            "bedroom",
            "bed wardrobe nightstand",
            "dresser plant floor_lamp armchair bookshelf desk",
        ),
        ("kitchen", "kitchen_counter fridge stove", "plant dresser kitchen_counter"),
        ("bathroom", "bathtub toilet washbasin", "washing_machine plant dresser"),
        ("study", "desk bookshelf bookshelf", "armchair floor_lamp plant sofa piano"),
        ("dining", "dresser plant", "fireplace floor_lamp bookshelf piano plant"),
        ("kids", "bed toy_chest wardrobe", "desk bookshelf toy_chest plant floor_lamp"),
        ("hall", "coat_rack dresser", "plant wardrobe floor_lamp armchair bookshelf"),
    )
}
"""For each use of a room: the furniture placed first, and the furniture placed as space allows."""
DINING_TABLE_PROBABILITY = {"kitchen": 0.7, "dining": 1.0, "living": 0.25}
"""Probability of a dining table in the middle of the room, 0 for the other uses."""
RUG_PROBABILITY = {
    "living": 0.9,
    "bedroom": 0.7,
    "kids": 0.9,
    "study": 0.5,
    "hall": 0.6,
    "dining": 0.4,
}
"""Probability of a rug, 0.3 for the other uses."""


CLEAR_M = 0.32
"""Free space that an agent needs around its centre: its radius of 0.2 m and a grid margin."""
CELL_M = 0.1
"""Side of a cell of the floor grid on which reachability is checked, metres."""
TRIES = 12
"""Random positions tried for a piece before it is skipped."""


class Furnisher:
    """Places furniture in one room and tracks which walls and floor cells are occupied."""

    def __init__(self, room: Room, rng: np.random.Generator, palette: Palette, height: float):
        """Start with the bare room."""
        self.room, self.rng, self.palette, self.height = room, rng, palette, height
        self.placed: list[tuple[Piece, np.ndarray]] = []
        self.footprints: list[Rect] = []
        self._last = (0, 0.0, 0.0)  # side, place along it and width of the last piece at a wall
        self.used: list[list[Rect]] = [[] for _ in range(4)]
        self.doors: list[Rect] = []  # the floor in front of doorways that must stay free
        for hole in room.openings:
            gap, width = 0.12, hole.high - hole.low
            self.used[hole.side].append((hole.low - gap, hole.bottom, hole.high + gap, hole.top))
            if hole.kind == "door":
                middle = (hole.low + hole.high) / 2
                self.doors.append(against(room, hole.side, middle, 0.75, width))
        x0, y0, x1, y1 = room.rect
        self.shape = (int((y1 - y0) / CELL_M) + 1, int((x1 - x0) / CELL_M) + 1)
        self.blocked = np.ones(self.shape, bool)
        self.blocked[self._cells(room.rect, -CLEAR_M)] = False
        self.open_cells = int((~self.blocked).sum())

    def make(self, kind: str) -> Piece:
        """Build a piece of furniture in the room's colours."""
        maker = getattr(furniture, kind, None) or getattr(fixtures, kind)
        return maker(self.rng, self.palette)

    def furnish(self) -> list[tuple[Piece, np.ndarray]]:
        """Place the furniture that belongs to the room's use, then decorate.

        Return pieces and poses.
        """
        rng, use = self.rng, self.room.use
        required, optional = FURNITURE[use]
        for kind in required:
            if not self.at_wall(self.make(kind)):
                continue
            if kind == "bed":
                self.beside_last(self.make("nightstand"))
            elif kind == "desk":
                self.before_last(self.make("office_chair"), 0.72, turned=True)
            elif kind == "sofa" and rng.uniform() < 0.8:
                self.before_last(self.make("coffee_table"), 1.25, turned=False)
        if rng.uniform() < DINING_TABLE_PROBABILITY.get(use, 0.0):
            self.table_with_chairs()
        for index in rng.permutation(len(optional)):
            if rng.uniform() < 0.85:
                self.at_wall(self.make(optional[index]))
        self.decorate()
        return self.placed

    def decorate(self) -> None:
        """Add pieces that block no floor: a rug, objects on the walls, a ceiling lamp."""
        rng = self.rng
        if rng.uniform() < RUG_PROBABILITY.get(self.room.use, 0.3):
            self.rug()
        if rng.uniform() < 0.3:
            self.hang(self.make("clock"), 1.6)
        if rng.uniform() < 0.7:
            self.hang(self.make("wall_shelf"), 1.1)
        for _ in range(int(rng.integers(3, 6))):
            self.hang(self.make("picture"), rng.uniform(1.25, 1.45))
        x0, y0, x1, y1 = self.room.rect
        pose = shift((x0 + x1) / 2, (y0 + y1) / 2)
        pose[2, 3] = self.height
        self.placed.append((self.make("ceiling_lamp"), pose))

    def at_wall(self, piece: Piece) -> bool:
        """Put a piece with its back to a random wall; return whether a position was found."""
        width = piece.size[0]
        for _ in range(TRIES):
            side = int(self.rng.integers(4))
            low, high = self.room.span(side)
            if high - low < width + 0.1:
                continue
            if self.rng.uniform() < 0.35:
                at = low + width / 2 + 0.03
            elif self.rng.uniform() < 0.5:
                at = high - width / 2 - 0.03
            else:
                at = self.rng.uniform(low + width / 2 + 0.03, high - width / 2 - 0.03)
            if self._stand(piece, side, at):
                return True
        return False

    def beside_last(self, piece: Piece) -> None:
        """Put a piece at the wall next to the last one."""
        side, at, width = self._last
        half = piece.size[0] / 2
        for sign in self.rng.permutation([-1, 1]):
            centre = at + sign * (width / 2 + half + 0.04)
            low, high = self.room.span(side)
            if low + half <= centre <= high - half and self._stand(piece, side, centre):
                return

    def before_last(self, piece: Piece, distance: float, *, turned: bool) -> None:
        """Put a piece in front of the last one at a wall, facing it (``turned``) or facing away."""
        side, at, _ = self._last
        local = shift(0, distance + piece.size[1] * turned)
        local[:2, :2] *= -1 if turned else 1
        self._free_standing(piece, wall_frame(self.room, side, at) @ local)

    def table_with_chairs(self) -> None:
        """Put a dining table somewhere in the room with chairs around it."""
        rng, rect = self.rng, self.room.rect
        table = self.make("dining_table")
        for _ in range(2 * TRIES):
            turn = int(rng.integers(2))
            sides = table.size[:2] if turn == 0 else table.size[1::-1]
            low = [rect[i] + 0.8 + s / 2 for i, s in enumerate(sides)]
            high = [rect[i + 2] - 0.8 - s / 2 for i, s in enumerate(sides)]
            if low[0] > high[0] or low[1] > high[1]:
                continue
            centre = [rng.uniform(*ends) for ends in zip(low, high, strict=True)]
            pose = turned(turn, centre) @ shift(0, -table.size[1] / 2)
            if not self._free_standing(table, pose):
                continue
            middle = table.size[1] / 2
            spots = [(0.3, -0.42, 0), (-0.3, -0.42, 0), (0.3, 0.42, 2), (-0.3, 0.42, 2)]
            seed = int(rng.integers(1 << 30))
            for x, y, k in spots if rng.uniform() < 0.6 else spots[1::2] + spots[:1]:
                chair = furniture.chair(np.random.default_rng(seed), self.palette)
                there = np.sign(y) * (middle + 0.12)
                local = shift(x, middle + there) @ turned(k, (0, 0)) @ shift(0, -0.3)
                self._free_standing(chair, pose @ local, margin=-0.2)
            return

    def rug(self) -> None:
        """Lay a rug in the middle."""
        piece = self.make("rug")
        x0, y0, x1, y1 = self.room.rect
        turn = int(y1 - y0 > x1 - x0)
        w, d = piece.size[:2] if turn == 0 else piece.size[1::-1]
        if x1 - x0 > w + 0.4 and y1 - y0 > d + 0.4:
            middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2]) + self.rng.uniform(-0.15, 0.15, 2)
            pose = turned(turn, middle) @ shift(0, -piece.size[1] / 2)
            self.placed.append((piece, pose))

    def hang(self, piece: Piece, bottom: float) -> None:
        """Hang a piece on a free stretch of wall."""
        width, depth, high = piece.size
        for _ in range(TRIES):
            side = int(self.rng.integers(4))
            low, end = self.room.span(side)
            if end - low < width + 0.3:
                continue
            at = self.rng.uniform(low + width / 2 + 0.12, end - width / 2 - 0.12)
            half = width / 2
            span = (at - half - 0.06, bottom - 0.05, at + half + 0.06, bottom + high + 0.05)
            if any(overlap(span, other) for other in self.used[side]):
                continue
            # Pieces that reach far into the room also block the floor: cameras pass below them.
            rect = against(self.room, side, at, depth, width)
            if depth < 0.1 or self._accept(rect, over_others=True):
                pose = wall_frame(self.room, side, at)
                pose[2, 3] = bottom
                self.placed.append((piece, pose))
                self.used[side].append(span)
                return

    def _stand(self, piece: Piece, side: int, at: float) -> bool:
        """Put a piece with its back to a wall if wall and floor are free; return whether so."""
        width, depth, high = piece.size
        span = (at - width / 2, 0.0, at + width / 2, high)
        if any(overlap(span, other) for other in self.used[side]):
            return False
        if not self._accept(against(self.room, side, at, depth, width)):
            return False
        self.placed.append((piece, wall_frame(self.room, side, at)))
        self.used[side].append(span)
        self._last = (side, at, width)
        return True

    def _free_standing(self, piece: Piece, pose: np.ndarray, margin: float = 0.0) -> bool:
        half, depth = piece.size[0] / 2, piece.size[1]
        corners = (np.array([[-half, 0, 0, 1], [half, depth, 0, 1]]) @ pose.T)[:, :2]
        left, near, right, far = map(float, (*corners.min(0), *corners.max(0)))
        x0, y0, x1, y1 = self.room.rect
        inside = left > x0 and near > y0 and right < x1 and far < y1
        if not inside or not self._accept((left, near, right, far), margin):
            return False
        self.placed.append((piece, pose))
        return True

    def _accept(self, rect: Rect, margin: float = 0.0, *, over_others: bool = False) -> bool:
        """Occupy a footprint if it is clear and the doorways stay connected; return whether so."""
        grown = (rect[0] - margin, rect[1] - margin, rect[2] + margin, rect[3] + margin)
        if not over_others and any(overlap(grown, other) for other in self.footprints):
            return False
        if any(overlap(rect, door) for door in self.doors):
            return False
        region = self._cells(rect, CLEAR_M)
        before = self.blocked[region].copy()
        self.blocked[region] = True
        if self._reachable():
            self.footprints.append(rect)
            return True
        self.blocked[region] = before
        return False

    def _cells(self, rect: Rect, grow: float) -> tuple[slice, slice]:
        """Return the rows and columns of cells with centres in a rectangle, grown by a margin."""
        x0, y0 = self.room.rect[:2]
        low = [int(np.ceil((rect[i] - o - grow) / CELL_M - 0.5)) for i, o in ((0, x0), (1, y0))]
        high = [int(np.floor((rect[i] - o + grow) / CELL_M + 0.5)) for i, o in ((2, x0), (3, y0))]
        return slice(max(0, low[1]), max(0, high[1])), slice(max(0, low[0]), max(0, high[0]))

    def _reachable(self) -> bool:
        """Return whether one region of free floor has all doorways and most of the free cells."""
        free = ~self.blocked
        region = largest_region(free)
        if not free.any() or region.sum() < max(0.22 * self.open_cells, 0.85 * free.sum()):
            return False
        x0, y0 = self.room.rect[:2]
        for door in self.doors:
            cx, cy = (door[0] + door[2]) / 2, (door[1] + door[3]) / 2
            row = np.clip(int((cy - y0) / CELL_M), 0, self.shape[0] - 1)
            column = np.clip(int((cx - x0) / CELL_M), 0, self.shape[1] - 1)
            if not region[row, column]:
                return False
        return True
