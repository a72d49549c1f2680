"""The bare house: walls with openings, floors, ceilings, door frames, skirting, windows."""

from __future__ import annotations

import itertools

import numpy as np
import trimesh

from pewm_jax.houses import textures
from pewm_jax.houses.floorplan import WALL_M, Opening, Rect, Room
from pewm_jax.houses.shapes import Palette, Piece, textured
from pewm_jax.houses.textures import shade

GRID_M = 0.5
"""Largest side of a surface's cells, so that the light baked at their corners is smooth, metres."""
TILE_M = 2.0
"""Metres covered by one repeat of a floor or ceiling image."""


def _cuts(low: float, high: float, marks: list[float]) -> np.ndarray:
    """Return coordinates from low to high that include the marks, at most GRID_M apart."""
    edges = sorted({low, high, *(m for m in marks if low < m < high)})
    parts = [
        np.linspace(a, b, max(1, int(np.ceil((b - a) / GRID_M))) + 1)[:-1]
        for a, b in itertools.pairwise(edges)
    ]
    return np.append(np.concatenate(parts), high)


def _lattice(u: np.ndarray, v: np.ndarray, holes: list[Rect]) -> tuple[np.ndarray, np.ndarray]:
    """Return (V, 2) points and (F, 3) counter-clockwise triangles of a grid without its holes."""
    uu, vv = np.meshgrid(u, v)
    middle_u, middle_v = np.meshgrid((u[1:] + u[:-1]) / 2, (v[1:] + v[:-1]) / 2)
    keep = np.ones(middle_u.shape, bool)
    for u0, v0, u1, v1 in holes:
        keep &= ~((middle_u > u0) & (middle_u < u1) & (middle_v > v0) & (middle_v < v1))
    j, i = np.nonzero(keep)
    a = j * len(u) + i
    b, c, d = a + 1, a + len(u) + 1, a + len(u)
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    used, faces = np.unique(faces, return_inverse=True)
    return np.stack([uu.ravel(), vv.ravel()], 1)[used], faces.reshape(-1, 3)


def wall_mesh(room: Room, side: int, height: float, image: np.ndarray) -> trimesh.Trimesh:
    """Return one wall of a room, seen from inside, with its openings cut out."""
    low, high = room.span(side)
    holes = [(o.low, o.bottom, o.high, o.top) for o in room.openings if o.side == side]
    u = _cuts(low, high, [low + 0.15, high - 0.15] + [e for h in holes for e in (h[0], h[2])])
    v = _cuts(0.0, height, [0.15, height - 0.15] + [e for h in holes for e in (h[1], h[3])])
    points, faces = _lattice(u, v, holes)
    x0, y0, x1, y1 = room.rect
    along, up = points[:, 0], points[:, 1]
    across = np.full_like(along, (y0, x1, y1, x0)[side])
    columns = (along, across, up) if side % 2 == 0 else (across, along, up)
    # Seen from inside, the world axes run to the left on the south and east walls.
    flipped = side in {0, 1}
    uv = np.stack([-along if flipped else along, up * TILE_M / height], 1) / TILE_M
    return textured(np.stack(columns, 1), faces[:, ::-1] if flipped else faces, uv, image)


def level_mesh(rect: Rect, z: float, image: np.ndarray, *, facing_up: bool) -> trimesh.Trimesh:
    """Return a floor or a ceiling."""
    x0, y0, x1, y1 = rect
    marks = ([x0 + 0.15, x1 - 0.15], [y0 + 0.15, y1 - 0.15])
    points, faces = _lattice(_cuts(x0, x1, marks[0]), _cuts(y0, y1, marks[1]), [])
    vertices = np.concatenate([points, np.full((len(points), 1), z)], 1)
    return textured(vertices, faces if facing_up else faces[:, ::-1], points / TILE_M, image)


def trim_piece(room: Room, palette: Palette) -> Piece:
    """Return a room's skirting boards and the frames around its openings, in world axes."""
    piece = Piece("trim", (0.0, 0.0, 0.0))
    colour = palette.white
    for side in range(4):
        start, end = room.span(side)
        doors = sorted(
            (o.low - 0.07, o.high + 0.07)
            for o in room.openings
            if o.side == side and o.kind == "door"
        )
        edges = [start, *(e for door in doors for e in door), end]
        for a, b in zip(edges[::2], edges[1::2], strict=True):
            if b - a > 0.02:
                _strip(
                    piece, room, side, (a, b), (0.0, 0.09), thick=0.015, colour=shade(colour, 0.95)
                )
    for hole in room.openings:
        side, a, b, low, top = hole.side, hole.low, hole.high, hole.bottom, hole.top
        for span in ((a - 0.07, a), (b, b + 0.07)):
            _strip(
                piece,
                room,
                side,
                span,
                (max(0.0, low - 0.07), top + 0.07),
                thick=0.02,
                colour=colour,
            )
        _strip(piece, room, side, (a, b), (top, top + 0.07), thick=0.02, colour=colour)
        if hole.kind == "window":
            _strip(piece, room, side, (a, b), (low - 0.07, low), thick=0.07, colour=colour)
    return piece


def _strip(
    piece: Piece,
    room: Room,
    side: int,
    span: tuple[float, float],
    z: tuple[float, float],
    *,
    thick: float,
    colour: np.ndarray,
) -> None:
    """Add a board on a wall, reaching into the room."""
    x0, y0, x1, y1 = room.rect
    across = ((y0, y0 + thick), (x1 - thick, x1), (y1 - thick, y1), (x0, x0 + thick))[side]
    if side % 2 == 0:
        piece.box(span, across, z, colour)
    else:
        piece.box(across, span, z, colour)


def doorway_piece(rect: Rect, top: float, palette: Palette) -> Piece:
    """Return the lining of a doorway: threshold, two sides and the top, as thin boards."""
    piece = Piece("doorway", (0.0, 0.0, 0.0))
    x0, y0, x1, y1 = rect
    colour, thin = shade(palette.white, 0.92), 0.01
    piece.box((x0, x1), (y0, y1), (-thin, 0.004), shade(palette.wood, 0.8))
    piece.box((x0, x1), (y0, y1), (top, top + thin), colour)
    if x1 - x0 < y1 - y0:
        piece.box((x0, x1), (y0 - thin, y0), (0, top), colour)
        piece.box((x0, x1), (y1, y1 + thin), (0, top), colour)
    else:
        piece.box((x0 - thin, x0), (y0, y1), (0, top), colour)
        piece.box((x1, x1 + thin), (y0, y1), (0, top), colour)
    return piece


def window_meshes(
    room: Room, hole: Opening, rng: np.random.Generator, palette: Palette
) -> list[trimesh.Trimesh]:
    """Return the lining of a window and its view, a picture set back in the wall."""
    x0, y0, x1, y1 = room.rect
    outward = ((0, -1), (1, 0), (0, 1), (-1, 0))[hole.side]
    depth = WALL_M
    wall = np.array(((0, y0), (x1, 0), (0, y1), (x0, 0))[hole.side], float)
    axis = np.array([1.0, 0.0] if hole.side % 2 == 0 else [0.0, 1.0])
    back = wall + depth * np.array(outward)
    left, right = (hole.high, hole.low) if hole.side in {0, 1} else (hole.low, hole.high)

    def corner(base: np.ndarray, at: float, z: float) -> list[float]:
        return [*(base * (1 - axis) + at * axis), z]

    piece = Piece("window", (0.0, 0.0, 0.0))
    lo, hi = hole.bottom, hole.top
    piece.sheet(
        [
            corner(back, left, lo),
            corner(back, right, lo),
            corner(back, right, hi),
            corner(back, left, hi),
        ],
        textures.window_view(rng),
        glowing=True,
    )
    low_2 = np.minimum(wall, back) * (1 - axis)
    high_2 = np.maximum(wall, back) * (1 - axis)
    thin = 0.01
    for (a, b), z in (
        ((hole.low - thin, hole.low), (lo, hi)),
        ((hole.high, hole.high + thin), (lo, hi)),
        ((hole.low, hole.high), (lo - thin, lo)),
        ((hole.low, hole.high), (hi, hi + thin)),
    ):
        p, q = low_2 + a * axis, high_2 + b * axis
        piece.box((p[0], q[0]), (p[1], q[1]), z, palette.white)
    solid = piece.solid()
    return piece.pictures() + ([solid] if solid is not None else [])
