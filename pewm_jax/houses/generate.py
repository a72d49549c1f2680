"""Generate a furnished house of 3 to 8 rooms from a seed, as a trimesh scene.

The scene is z-up with its floor at z = 0, in metres. Its bytes depend on the seed alone.
"""

from __future__ import annotations

import itertools

import numpy as np
import trimesh

from pewm_jax.houses import textures
from pewm_jax.houses.floorplan import (
    DOOR_TOP_M,
    WALL_M,
    Opening,
    Rect,
    Room,
    all_reachable,
    draw_plan,
)
from pewm_jax.houses.furnish import Furnisher
from pewm_jax.houses.shapes import Palette, Piece, Span, textured
from pewm_jax.houses.textures import hsv, shade

GRID_M = 0.5
"""Largest side of a surface's cells, so that the light baked at their corners is smooth, metres."""
TILE_M = 2.0
"""Metres covered by one repeat of a floor or ceiling image."""
_STREAM = 0x50457
"""Seed offset that separates the generator's random numbers from other uses of the same seed."""
_WALLS = ("plaster", "stripes", "wainscot", "diamonds", "band", "plaster")
_FLOORS = {
    "kitchen": ("checks", "tiles"),
    "bathroom": ("tiles", "checks"),
    "hall": ("tiles", "parquet", "planks"),
    "bedroom": ("carpet", "planks", "parquet"),
    "kids": ("carpet", "planks"),
}
_WOOD = (0.05, 0.1), (0.35, 0.6), (0.45, 0.8)
_TILES = (0.0, 1.0), (0.05, 0.3), (0.65, 0.9)
_FLOOR_COLOURS = {
    "tiles": _TILES,
    "checks": _TILES,
    "carpet": ((0.0, 1.0), (0.2, 0.45), (0.45, 0.75)),
}
"""Ranges of hue, saturation and value of a floor; wood for the others."""


def generate_house(seed: int) -> trimesh.Scene:
    """Build the house of a seed, which is the same in every process.

    Returns:
        A scene whose metadata contains ``name``, ``seed``, ``shading`` ("soft": light is to be
        baked), ``rooms`` ([x0, y0, x1, y1] per room, metres), ``uses`` (one word per room) and
        ``doorways`` ([room, room, x0, y0, x1, y1]).
    """
    attempts = (_draw(np.random.default_rng([_STREAM, seed, k])) for k in itertools.count())
    scene = next(scene for scene in attempts if scene is not None)
    scene.metadata.update(name=f"house-{seed:06d}", seed=int(seed), shading="soft")
    return scene


def object_boxes(seed: int) -> dict[str, np.ndarray]:
    """Return the (2, 3) lowest and highest corners, metres, of the parts of a seed's house."""
    scene = generate_house(seed)
    found = {}
    for node in sorted(scene.graph.nodes_geometry):
        transform, geometry = scene.graph[node]
        points = trimesh.transform_points(scene.geometry[geometry].vertices, transform)
        found[node] = np.stack([points.min(0), points.max(0)])
    return found


def _draw(rng: np.random.Generator) -> trimesh.Scene | None:
    """Draw one house; return None if one of its rooms cannot be reached."""
    plan = draw_plan(rng)
    first_hue = rng.uniform()
    palettes = [_palette(rng, first_hue + 0.618034 * k, r.use) for k, r in enumerate(plan.rooms)]
    furnishers = [
        Furnisher(room, rng, palette, plan.height)
        for room, palette in zip(plan.rooms, palettes, strict=True)
    ]
    furniture = [furnisher.furnish() for furnisher in furnishers]
    if not all_reachable(plan, [rect for each in furnishers for rect in each.footprints]):
        return None
    scene = trimesh.Scene()
    for index, (room, palette) in enumerate(zip(plan.rooms, palettes, strict=True)):
        _add_shell(scene, rng, room, f"room{index}-{room.use}", palette, plan.height)
        for number, (piece, pose) in enumerate(furniture[index]):
            _add_piece(scene, f"room{index}-{piece.kind}-{number}", piece, pose)
    for index, (a, _, rect) in enumerate(plan.doorways):
        _add_piece(scene, f"doorway{index}", doorway_piece(rect, DOOR_TOP_M, palettes[a]))
    scene.metadata.update(
        rooms=[[float(value) for value in room.rect] for room in plan.rooms],
        uses=[room.use for room in plan.rooms],
        doorways=[[a, b, *map(float, rect)] for a, b, rect in plan.doorways],
    )
    return scene


def _palette(rng: np.random.Generator, hue: float, use: str) -> Palette:
    """Draw a room's colours: walls of one hue, furniture in hues apart from it."""
    saturation = rng.uniform(0.25, 0.5) if use != "bathroom" else rng.uniform(0.2, 0.4)
    accent_hue = hue + rng.choice([0.42, 0.5, 0.58])
    fabric_hue = hue + rng.choice([0.25, 0.33, 0.67, 0.75])
    return Palette(
        wall=hsv(hue, saturation, rng.uniform(0.78, 0.93)),
        wood=hsv(rng.uniform(0.05, 0.1), rng.uniform(0.4, 0.65), rng.uniform(0.35, 0.75)),
        fabric=hsv(fabric_hue, rng.uniform(0.5, 0.8), rng.uniform(0.45, 0.75)),
        accent=hsv(accent_hue, rng.uniform(0.6, 0.85), rng.uniform(0.6, 0.9)),
        second=hsv(hue + rng.uniform(-0.06, 0.06), rng.uniform(0.15, 0.6), rng.uniform(0.55, 0.9)),
        white=np.array([0.96, 0.95, 0.92]),
        dark=np.array([0.2, 0.19, 0.2]),
    )


def _add_shell(
    scene: trimesh.Scene,
    rng: np.random.Generator,
    room: Room,
    name: str,
    palette: Palette,
    height: float,
) -> None:
    """Add a room's walls, floor, ceiling, trim and windows."""
    style = str(rng.choice(_WALLS))
    image = textures.wall(rng, palette.wall, height, style)
    accent_side = int(rng.integers(4)) if rng.uniform() < 0.5 else -1
    accent = shade(palette.wall, 0.8) * [1, 0.96, 0.96]
    strong = textures.wall(rng, accent, height, str(rng.choice(["bricks", style])))
    for side in range(4):
        mesh = wall_mesh(room, side, height, strong if side == accent_side else image)
        scene.add_geometry(mesh, node_name=f"{name}-wall{side}")
    floor_style = str(rng.choice(_FLOORS.get(room.use, ("planks", "parquet", "planks"))))
    hues, saturations, values = _FLOOR_COLOURS.get(floor_style, _WOOD)
    ground = hsv(rng.uniform(*hues), rng.uniform(*saturations), rng.uniform(*values))
    covering = level_mesh(room.rect, 0.0, textures.floor(rng, ground, floor_style), facing_up=True)
    scene.add_geometry(covering, node_name=f"{name}-floor")
    ceiling_style = str(rng.choice(["plain", "plain", "panels", "beams"]))
    above = textures.ceiling(rng, np.array([0.97, 0.96, 0.94]), ceiling_style)
    above = level_mesh(room.rect, height, above, facing_up=False)
    scene.add_geometry(above, node_name=f"{name}-ceiling")
    _add_piece(scene, f"{name}-trim", trim_piece(room, palette))
    for number, hole in enumerate(hole for hole in room.openings if hole.kind == "window"):
        for part, mesh in enumerate(window_meshes(room, hole, rng, palette)):
            scene.add_geometry(mesh, node_name=f"{name}-window{number}-{part}")


def _add_piece(
    scene: trimesh.Scene, name: str, piece: Piece, pose: np.ndarray | None = None
) -> None:
    """Add a piece: its solid parts as one instance, each picture on it as another."""
    solid = piece.solid()
    meshes = piece.pictures() if solid is None else [solid, *piece.pictures()]
    for number, mesh in enumerate(meshes):
        node = name if number == 0 else f"{name}-face{number}"
        scene.add_geometry(mesh, node_name=node, transform=pose)


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
    piece, colour = Piece("trim", (0.0, 0.0, 0.0)), palette.white
    x0, y0, x1, y1 = room.rect

    def board(side: int, span: Span, z: Span, thick: float, shading: float = 1.0) -> None:
        """Add a board on a wall, reaching into the room."""
        across = ((y0, y0 + thick), (x1 - thick, x1), (y1 - thick, y1), (x0, x0 + thick))[side]
        x, y = (span, across) if side % 2 == 0 else (across, span)
        piece.box(x, y, z, shade(colour, shading))

    for side in range(4):
        start, end = room.span(side)
        doors = [o for o in room.openings if o.side == side and o.kind == "door"]
        gaps = sorted((door.low - 0.07, door.high + 0.07) for door in doors)
        edges = [start, *(edge for gap in gaps for edge in gap), end]
        for a, b in zip(edges[::2], edges[1::2], strict=True):
            if b - a > 0.02:
                board(side, (a, b), (0.0, 0.09), 0.015, 0.95)
    for hole in room.openings:
        side, a, b, low, top = hole.side, hole.low, hole.high, hole.bottom, hole.top
        for span in ((a - 0.07, a), (b, b + 0.07)):
            board(side, span, (max(0.0, low - 0.07), top + 0.07), 0.02)
        board(side, (a, b), (top, top + 0.07), 0.02)
        if hole.kind == "window":
            board(side, (a, b), (low - 0.07, low), 0.07)
    return piece


def doorway_piece(rect: Rect, top: float, palette: Palette) -> Piece:
    """Return the lining of a doorway: threshold, two sides and the top, as thin boards."""
    piece = Piece("doorway", (0.0, 0.0, 0.0))
    x0, y0, x1, y1 = rect
    colour, thin = shade(palette.white, 0.92), 0.01
    piece.box((x0, x1), (y0, y1), (-thin, 0.004), shade(palette.wood, 0.8))
    piece.box((x0, x1), (y0, y1), (top, top + thin), colour)
    if x1 - x0 < y1 - y0:
        sides = ((x0, x1), (y0 - thin, y0)), ((x0, x1), (y1, y1 + thin))
    else:
        sides = ((x0 - thin, x0), (y0, y1)), ((x1, x1 + thin), (y0, y1))
    for x, y in sides:
        piece.box(x, y, (0, top), colour)
    return piece


def window_meshes(
    room: Room, hole: Opening, rng: np.random.Generator, palette: Palette
) -> list[trimesh.Trimesh]:
    """Return the lining of a window and its view, a picture set back in the wall."""
    x0, y0, x1, y1 = room.rect
    wall = np.array(((0, y0), (x1, 0), (0, y1), (x0, 0))[hole.side], float)
    axis = np.array([1.0, 0.0] if hole.side % 2 == 0 else [0.0, 1.0])
    back = wall + WALL_M * np.array(((0, -1), (1, 0), (0, 1), (-1, 0))[hole.side])
    left, right = (hole.high, hole.low) if hole.side in {0, 1} else (hole.low, hole.high)
    lo, hi, thin = hole.bottom, hole.top, 0.01
    piece = Piece("window", (0.0, 0.0, 0.0))
    corners = [
        [*(back * (1 - axis) + at * axis), z]
        for at, z in ((left, lo), (right, lo), (right, hi), (left, hi))
    ]
    piece.sheet(corners, textures.window_view(rng), glowing=True)
    low_2, high_2 = np.minimum(wall, back) * (1 - axis), np.maximum(wall, back) * (1 - axis)
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
