"""Generate a furnished house of 3 to 8 rooms from a seed, as a trimesh scene.

The scene is z-up with its floor at z = 0, in metres. Its bytes depend on the seed alone.
"""

from __future__ import annotations

import numpy as np
import trimesh

from pewm_jax.houses import textures
from pewm_jax.houses.floorplan import DOOR_TOP_M, Room, all_reachable, draw_plan
from pewm_jax.houses.furnish import Furnisher, Placed
from pewm_jax.houses.shapes import Palette, Piece
from pewm_jax.houses.shell import doorway_piece, level_mesh, trim_piece, wall_mesh, window_meshes
from pewm_jax.houses.textures import hsv, shade

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
_TILED = {"tiles", "checks"}


def generate_house(seed: int) -> trimesh.Scene:
    """Build a house.

    Args:
        seed: any non-negative integer; the same seed gives the same house in every process.

    Returns:
        A scene whose metadata contains ``name``, ``seed``, ``shading`` ("soft": light is to be
        baked), ``rooms`` ([x0, y0, x1, y1] per room, metres), ``uses`` (one word per room) and
        ``doorways`` ([room, room, x0, y0, x1, y1]).
    """
    attempt, scene = 0, None
    while scene is None:
        scene = _draw(np.random.default_rng([_STREAM, seed, attempt]))
        attempt += 1
    scene.metadata.update(name=f"house-{seed:06d}", seed=int(seed), shading="soft")
    return scene


def _draw(rng: np.random.Generator) -> trimesh.Scene | None:
    """Draw one house; return None if one of its rooms cannot be reached."""
    plan = draw_plan(rng)
    first_hue = rng.uniform()
    palettes = [
        _palette(rng, first_hue + 0.618034 * index, room.use)
        for index, room in enumerate(plan.rooms)
    ]
    furnishers = [
        Furnisher(room, rng, palette, plan.height)
        for room, palette in zip(plan.rooms, palettes, strict=True)
    ]
    furniture = [furnisher.furnish() for furnisher in furnishers]
    if not all_reachable(plan, [rect for each in furnishers for rect in each.footprints]):
        return None
    scene = trimesh.Scene()
    for index, (room, palette) in enumerate(zip(plan.rooms, palettes, strict=True)):
        name = f"room{index}-{room.use}"
        _add_shell(scene, rng, room, name=name, palette=palette, height=plan.height)
        for number, placed in enumerate(furniture[index]):
            _add_piece(scene, f"room{index}-{placed.piece.kind}-{number}", placed)
    for index, (a, _, rect) in enumerate(plan.doorways):
        piece = doorway_piece(rect, DOOR_TOP_M, palettes[a])
        _add_piece(scene, f"doorway{index}", Placed(piece, np.eye(4)))
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
    *,
    name: str,
    palette: Palette,
    height: float,
) -> None:
    """Add a room's walls, floor, ceiling, trim and windows."""
    style = str(rng.choice(_WALLS))
    image = textures.wall(rng, palette.wall, height, style)
    accent_side = int(rng.integers(4)) if rng.uniform() < 0.5 else -1
    strong = textures.wall(
        rng, shade(palette.wall, 0.8) * [1, 0.96, 0.96], height, str(rng.choice(["bricks", style]))
    )
    for side in range(4):
        mesh = wall_mesh(room, side, height, strong if side == accent_side else image)
        scene.add_geometry(mesh, node_name=f"{name}-wall{side}")
    floor_style = str(rng.choice(_FLOORS.get(room.use, ("planks", "parquet", "planks"))))
    if floor_style in _TILED:
        ground = hsv(rng.uniform(), rng.uniform(0.05, 0.3), rng.uniform(0.65, 0.9))
    elif floor_style == "carpet":
        ground = hsv(rng.uniform(), rng.uniform(0.2, 0.45), rng.uniform(0.45, 0.75))
    else:
        ground = hsv(rng.uniform(0.05, 0.1), rng.uniform(0.35, 0.6), rng.uniform(0.45, 0.8))
    covering = textures.floor(rng, ground, floor_style)
    scene.add_geometry(
        level_mesh(room.rect, 0.0, covering, facing_up=True), node_name=f"{name}-floor"
    )
    ceiling_style = str(rng.choice(["plain", "plain", "panels", "beams"]))
    above = textures.ceiling(rng, np.array([0.97, 0.96, 0.94]), ceiling_style)
    scene.add_geometry(
        level_mesh(room.rect, height, above, facing_up=False), node_name=f"{name}-ceiling"
    )
    _add_piece(scene, f"{name}-trim", Placed(trim_piece(room, palette), np.eye(4)))
    for number, hole in enumerate(hole for hole in room.openings if hole.kind == "window"):
        for part, mesh in enumerate(window_meshes(room, hole, rng, palette)):
            scene.add_geometry(mesh, node_name=f"{name}-window{number}-{part}")


def _add_piece(scene: trimesh.Scene, name: str, placed: Placed) -> None:
    """Add a piece: its solid parts as one instance, each picture on it as another."""
    piece: Piece = placed.piece
    solid = piece.solid()
    meshes = piece.pictures() if solid is None else [solid, *piece.pictures()]
    for number, mesh in enumerate(meshes):
        node = name if number == 0 else f"{name}-face{number}"
        scene.add_geometry(mesh, node_name=node, transform=placed.world_from_piece)
