"""Pieces of furniture built from boxes, prisms, ellipsoids and textured rectangles.

A piece has its own frame: x along the wall, y away from it (the back is at y = 0), z up, metres.
Faces do not share vertices, so that baked light has hard edges. Parts that many pieces share (legs,
books, small objects) are here as well, and the palette of a room.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from pewm_jax.houses.textures import Rgb, hsv

Colour = Sequence[float] | np.ndarray
"""Red, green, blue in [0, 1]."""
Span = tuple[float, float]
"""Begin and end along an axis, metres."""

_QUADS = np.array(
    [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
)
_CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
BOX_24 = _CORNERS[_QUADS].reshape(24, 3)
"""Corners of a unit box, four per face, counter-clockwise seen from outside."""
BOX_FACES = np.array([[4 * q, 4 * q + i, 4 * q + i + 1] for q in range(6) for i in (1, 2)])


@dataclasses.dataclass
class Piece:
    """A piece of furniture, built by adding shapes.

    Attributes:
        kind: what it is, e.g. ``sofa``.
        size: width along the wall, depth away from it, height; the space it needs, metres.
        meshes: vertices, triangles and the colour of each shape; boxes come first.
        sheets: corners and image of each picture, and whether it glows.
    """

    kind: str
    size: tuple[float, float, float]
    boxes: list[tuple[float, ...]] = dataclasses.field(default_factory=list)
    meshes: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = dataclasses.field(
        default_factory=list
    )
    sheets: list[tuple[np.ndarray, np.ndarray, bool]] = dataclasses.field(default_factory=list)

    def box(self, x: Span, y: Span, z: Span, colour: Colour) -> None:
        """Add an axis-aligned box given its three intervals."""
        r, g, b = colour
        self.boxes.append((x[0], y[0], z[0], x[1], y[1], z[1], r, g, b))

    def prism(self, centre: Span, z: Span, radius: Span, colour: Colour, sides: int = 10) -> None:
        """Add an upright prism, cone or frustum: radius at the bottom and at the top."""
        points, faces = _unit_prism(sides)
        scale = np.where(points[:, 2:] > 0, radius[1], radius[0])
        height = z[0] + (z[1] - z[0]) * points[:, 2:]
        placed = np.concatenate([points[:, :2] * scale + np.array(centre), height], 1)
        self.meshes.append((placed, faces, np.asarray(colour, float)))

    def ball(self, centre: Sequence[float], radii: Sequence[float], colour: Colour) -> None:
        """Add an ellipsoid."""
        points, faces = _unit_ball()
        placed = points * np.asarray(radii) + np.asarray(centre)
        self.meshes.append((placed, faces, np.asarray(colour, float)))

    def sheet(self, corners_43: Any, image: np.ndarray, *, glowing: bool = False) -> None:
        """Add a picture: corners bottom-left, bottom-right, top-right, top-left as seen."""
        self.sheets.append((np.asarray(corners_43, float), image, glowing))

    def solid(self) -> trimesh.Trimesh | None:
        """Return everything but the sheets as one mesh with vertex colours."""
        shapes = list(self.meshes)
        if self.boxes:
            table = np.array(self.boxes)
            low, high = table[:, None, :3], table[:, None, 3:6]
            corners = (low + BOX_24 * (high - low)).reshape(-1, 3)
            faces = BOX_FACES + 24 * np.arange(len(table))[:, None, None]
            shapes.insert(0, (corners, faces.reshape(-1, 3), np.repeat(table[:, 6:], 24, 0)))
        if not shapes:
            return None
        vertices, faces, colours = zip(*shapes, strict=True)
        starts = np.cumsum([0, *map(len, vertices[:-1])])
        return coloured(
            np.concatenate(vertices),
            np.concatenate([part + start for part, start in zip(faces, starts, strict=True)]),
            np.concatenate(list(map(np.broadcast_to, colours, (v.shape for v in vertices)))),
        )

    def pictures(self) -> list[trimesh.Trimesh]:
        """Return the sheets as textured meshes."""
        uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
        faces = np.array([[0, 1, 2], [0, 2, 3]])
        return [
            textured(corners, faces, uv, image, glowing=glowing)
            for corners, image, glowing in self.sheets
        ]


def coloured(vertices_V3: np.ndarray, faces_F3: np.ndarray, rgb_V3: np.ndarray) -> trimesh.Trimesh:
    """Return a mesh with vertex colours given in [0, 1]."""
    rgba = np.full((len(vertices_V3), 4), 255, np.uint8)
    rgba[:, :3] = np.clip(np.asarray(rgb_V3) * 255 + 0.5, 0, 255)
    return trimesh.Trimesh(vertices_V3, faces_F3, vertex_colors=rgba, process=False)


def textured(
    vertices_V3: np.ndarray,
    faces_F3: np.ndarray,
    uv_V2: np.ndarray,
    image_HW3: np.ndarray,
    *,
    glowing: bool = False,
) -> trimesh.Trimesh:
    """Return a mesh with an image; uv (0, 0) is the image's bottom left corner.

    ``glowing`` marks surfaces that need no light to be seen, such as windows and screens.
    """
    material = PBRMaterial(
        baseColorTexture=Image.fromarray(image_HW3),
        metallicFactor=0.0,
        roughnessFactor=1.0,
        emissiveFactor=[1.0, 1.0, 1.0] if glowing else None,
    )
    visual = TextureVisuals(uv=uv_V2, material=material)
    return trimesh.Trimesh(vertices_V3, faces_F3, visual=visual, process=False)


@functools.lru_cache(maxsize=32)
def _unit_prism(sides: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a prism of radius 1 and height 1 with split vertices: sides, then the two caps."""
    angle = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(sides)], 1)
    top = ring + np.array([0, 0, 1])
    after = np.roll(np.arange(sides), -1)
    wall = np.stack([ring, ring[after], top[after], top], 1).reshape(-1, 3)
    quads = 4 * np.arange(sides)[:, None]
    faces = [np.concatenate([quads + np.array(corner) for corner in ((0, 1, 2), (0, 2, 3))])]
    fan = np.stack([np.zeros(sides - 2, int), np.arange(1, sides - 1), np.arange(2, sides)], 1)
    faces += [fan + 4 * sides, fan[:, ::-1] + 5 * sides]
    return np.concatenate([wall, top, ring]), np.concatenate(faces)


@functools.lru_cache(maxsize=1)
def _unit_ball() -> tuple[np.ndarray, np.ndarray]:
    """Return an icosphere of 80 triangles."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    return np.array(ball.vertices), np.array(ball.faces)


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


def legs(piece: Piece, width: float, y: Span, top: float, thick: float, colour: Rgb) -> None:
    """Add four legs under a top of that width between two depths."""
    for x0 in (-width / 2, width / 2 - thick):
        for y0 in (y[0], y[1] - thick):
            piece.box((x0, x0 + thick), (y0, y0 + thick), (0, top), colour)


def books(
    piece: Piece, rng: np.random.Generator, x: Span, y: Span, *, z: float, tallest: float
) -> None:
    """Fill a shelf with books of many colours, here and there a vase or a box."""
    at = x[0]
    while at < x[1] - 0.07:
        what = rng.uniform()
        if what < 0.72:
            width = min(rng.uniform(0.06, 0.13), x[1] - at)
            high = z + tallest * rng.uniform(0.6, 0.95)
            deep = (y[0], y[1] - rng.uniform(0, 0.05))
            piece.box((at, at + width * 0.94), deep, (z, high), bright(rng))
            at += width
        elif what < 0.86 and x[1] - at > 0.2:
            centre = (at + 0.1, (y[0] + y[1]) / 2)
            piece.prism(centre, (z, z + tallest * 0.7), (0.05, 0.09), bright(rng), 8)
            at += 0.22
        else:
            at += rng.uniform(0.08, 0.2)


def small_objects(
    piece: Piece, rng: np.random.Generator, x: Span, y: Span, *, z: float, count: int
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
