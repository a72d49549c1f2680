"""Scenes: triangle meshes as flat arrays for ray casting and shading.

A scene is built once. The colours, texture coordinates and baked light of a triangle are stored as
one row, affine in the barycentric coordinates of a hit, so that shading needs one gather per pixel.
``read_surface`` reads the positions and colours of one mesh, with any kind of colours.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import trimesh
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from pewm_jax.config import UserError
from pewm_jax.data import shading
from pewm_jax.data.shading import LEVELS, Textures, pack
from pewm_jax.houses.generate import generate_house

if TYPE_CHECKING:
    from embreex.rtcore_scene import EmbreeScene


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """A static world of triangles, z up, metres.

    Attributes:
        name: identifies the scene in episodes.
        vertices_V3: (V, 3) float64 world positions.
        faces_F3: (F, 3) int32 vertex indices.
        normals_F3: (F, 3) float64 unit face normals.
        object_F: (F,) int32 instance id of each face, an index into ``objects``.
        objects: names of the instances.
        shading_16F: (16, F) float32; five quantities q (light × colour as r, g, b; texture
            s, t) stored as q₀, q₁ − q₀, q₂ − q₀ over the corners; last, texels per metre.
        texture_F: (F,) int32 first row of the face's image in the level table.
        textures: the images.
        albedo_F3: (F, 3) float32 mean RGB in [0, 1] of each face's own colour, without light.
        metadata: plain values that came with the scene (rooms, seed).
    """

    name: str
    vertices_V3: np.ndarray
    faces_F3: np.ndarray
    normals_F3: np.ndarray
    object_F: np.ndarray
    objects: tuple[str, ...]
    shading_16F: np.ndarray
    texture_F: np.ndarray
    textures: Textures
    albedo_F3: np.ndarray
    metadata: dict[str, Any]

    @functools.cached_property
    def centre_3(self) -> np.ndarray:
        """Return the bounding box's middle; rays are cast relative to it for float32 accuracy."""
        return np.asarray((self.vertices_V3.min(0) + self.vertices_V3.max(0)) / 2)

    @functools.cached_property
    def tracer(self) -> EmbreeScene:
        """Return Embree's structure of ``vertices_V3 − centre_3``, built on first use."""
        return shading.embree(self.vertices_V3 - self.centre_3, self.faces_F3)

    def __getstate__(self) -> dict[str, Any]:
        """Pickle without Embree's structure, which other processes rebuild."""
        return {key: value for key, value in self.__dict__.items() if key != "tracer"}


def house(seed: int) -> Scene:
    """Return the procedural house of a seed, ready to render."""
    mesh = generate_house(seed)
    return from_trimesh(mesh, mesh.metadata["name"])


def load_scene(path: Path, up: Literal["auto", "z", "y"] = "auto") -> Scene:
    """Read a mesh file of any kind that trimesh loads (GLB, OBJ, PLY, STL, …).

    ``up`` is the axis of the file that points up; ``auto`` is y for glTF, as in its specification,
    and z for all others.

    Raises:
        UserError: the file is absent or unreadable, or holds no usable triangles.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path} is not a file: give the path of a mesh (GLB, OBJ, PLY, …).")
    try:
        loaded = trimesh.load_scene(path)
    except Exception as error:  # trimesh's parsers raise many kinds for files they cannot read
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise UserError(
            f"{path} could not be read as a mesh ({reason}): check that the file is complete and "
            "of a kind that trimesh loads (GLB, OBJ, PLY, …)."
        ) from error
    if up == "auto":
        up = "y" if path.suffix.lower() in {".glb", ".gltf"} else "z"
    return from_trimesh(loaded, path.stem, up, where=str(path))


def from_trimesh(
    scene: trimesh.Scene | trimesh.Trimesh,
    name: str,
    up: Literal["z", "y"] = "z",
    *,
    where: str | None = None,
) -> Scene:
    """Convert a trimesh scene in metres, with its instances, textures and colours, to a `Scene`.

    Meshes of one colour (grey if they have none) are shaded by the direction of each face. Textures
    and vertex colours are kept as they are, because scans contain their own light. A scene whose
    metadata says ``shading: soft`` gets light and ambient occlusion baked everywhere. Entries that
    are not triangle meshes are left out. If y points up, it is turned to z. Errors name the scene
    by ``where``, or by its name.

    Raises:
        UserError: there are no triangles, or vertices are not finite.
    """
    where = where or name
    if isinstance(scene, trimesh.Trimesh):
        scene = trimesh.Scene(scene)
    soft = scene.metadata.get("shading") == "soft"
    parts: list[_Part] = []
    surfaces: dict[str, Surface] = {}
    for node in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[node]
        key = str(geometry)
        mesh = scene.geometry[key]
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
            continue
        if key not in surfaces:
            surfaces[key] = read_surface(mesh, where)
        parts.append(_place(str(node), np.asarray(transform), up, surfaces[key], where))
    if not parts:
        raise UserError(
            f"{where} holds no triangles: give a surface mesh, not a point cloud or an empty file."
        )
    return _assemble(parts, name, soft, dict(scene.metadata))


@dataclasses.dataclass(frozen=True)
class _Part:
    """One placed instance."""

    node: str
    vertices_V3: np.ndarray
    surface: Surface
    mirrored: bool


def _place(node: str, transform: np.ndarray, up: str, surface: Surface, where: str) -> _Part:
    """Move one instance into the z-up world."""
    vertices = surface.vertices_V3 @ transform[:3, :3].T + transform[:3, 3]
    if not np.isfinite(vertices[surface.faces_F3]).all():
        raise UserError(
            f"{where} has vertices that are not finite numbers (in {node}): repair the mesh."
        )
    if up == "y":
        vertices = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], -1)
    vertices = np.where(np.isfinite(vertices), vertices, 0.0)
    return _Part(node, vertices, surface, bool(np.linalg.det(transform[:3, :3]) < 0))


def _assemble(parts: list[_Part], name: str, soft: bool, metadata: dict[str, Any]) -> Scene:
    """Concatenate instances, bake light and lay out the shading rows."""
    starts = np.cumsum([0] + [len(part.vertices_V3) for part in parts[:-1]])
    vertices = np.concatenate([part.vertices_V3 for part in parts])
    placed = [part.surface.faces_F3 + start for part, start in zip(parts, starts, strict=True)]
    faces = np.concatenate(placed).astype(np.int32)
    counts = [len(part.surface.faces_F3) for part in parts]

    def per_face(values: list[Any]) -> np.ndarray:
        return np.repeat(np.array(values), counts)

    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_area = np.linalg.norm(cross, axis=-1, keepdims=True)
    facing = per_face([-1.0 if part.mirrored else 1.0 for part in parts])
    normals = cross / double_area.clip(1e-12) * facing[:, None]
    colour = np.concatenate([part.surface.colour_F33 for part in parts])
    uv = np.concatenate([part.surface.uv_F32 for part in parts])
    white = np.full((1, 1, 3), 255, np.uint8)
    image_of_part = [white if p.surface.image is None else p.surface.image for p in parts]
    images = list({id(image): image for image in [white, *image_of_part]}.values())
    rows = {id(image): row for row, image in enumerate(images)}
    texture = per_face([rows[id(image)] for image in image_of_part]).astype(np.int32) * LEVELS
    textures = pack(images)
    size = np.stack([textures.width_L[texture], textures.height_L[texture]], -1)
    edges = (uv[:, 1:] - uv[:, :1]) * size[:, None, :]
    texels = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    density = np.sqrt(texels / double_area[:, 0].clip(1e-12))
    scene = Scene(
        name=name,
        vertices_V3=vertices,
        faces_F3=faces,
        normals_F3=normals,
        object_F=per_face(list(range(len(parts)))).astype(np.int32),
        objects=tuple(part.node for part in parts),
        shading_16F=np.zeros((16, len(faces)), np.float32),
        texture_F=texture,
        textures=textures,
        albedo_F3=_albedo(parts),
        metadata=metadata,
    )
    bare = per_face([part.surface.bare for part in parts])
    if soft:
        centred = vertices - scene.centre_3
        light = shading.soft_light(scene.tracer, centred, faces, normals)
        light[per_face([part.surface.glowing for part in parts])] = 1.0
        colour = colour * light
    elif bare.any():
        light = shading.face_light(normals)[:, None, :]
        colour = np.where(bare[:, None, None], colour * light, colour)
    values = np.concatenate([colour, uv], -1)
    scene.shading_16F[:5] = values[:, 0].T
    scene.shading_16F[5:10] = (values[:, 1] - values[:, 0]).T
    scene.shading_16F[10:15] = (values[:, 2] - values[:, 0]).T
    scene.shading_16F[15] = density
    return scene


def _albedo(parts: list[_Part]) -> np.ndarray:
    """Return (F, 3) float32 mean colours of faces; for an image, the mean of the whole image."""
    found = []
    for surface in (part.surface for part in parts):
        whole = 1.0 if surface.image is None else surface.image.mean((0, 1)) / 255
        found.append(surface.colour_F33.mean(1) * whole)
    return np.concatenate(found).astype(np.float32)


GREY = np.array([170, 170, 170], np.uint8)
"""Colour of a mesh without colours."""


@dataclasses.dataclass(frozen=True)
class Surface:
    """One geometry before it is placed.

    Attributes:
        vertices_V3: (V, 3) float64 in the geometry's own frame.
        faces_F3: (F, 3) int32.
        colour_F33: (F, 3, 3) float32, RGB in [0, 1] at each corner; multiplies the image.
        uv_F32: (F, 3, 2) float32, from the image's top left corner.
        image: (H, W, 3) uint8, or None.
        bare: whether it has a single colour and no image, and so is shaded by its normals.
        glowing: whether it emits light, and so is not shaded.
    """

    vertices_V3: np.ndarray
    faces_F3: np.ndarray
    colour_F33: np.ndarray
    uv_F32: np.ndarray
    image: np.ndarray | None
    bare: bool
    glowing: bool = False


def read_surface(mesh: trimesh.Trimesh, where: str) -> Surface:
    """Read positions, colours and image of one mesh; instances of it share the result.

    The colour is image × factor × vertex tint, as in glTF, but without its conversion to linear
    light: colours are multiplied as stored (sRGB), which reproduces the appearance of scans.

    Raises:
        UserError: faces point past the vertices.
    """
    vertices = np.asarray(mesh.vertices, np.float64)
    faces = np.asarray(mesh.faces, np.int32)
    if faces.max() >= len(vertices) or faces.min() < 0:
        raise UserError(
            f"{where} has faces that point past its {len(vertices)} vertices: export it again."
        )
    colour = np.ones((len(faces), 3, 3), np.float32)
    uv = np.zeros((len(faces), 3, 2), np.float32)
    visual = mesh.visual
    if isinstance(visual, TextureVisuals):
        image, factor = _image_of(visual.material)
        coordinates = None if visual.uv is None else np.asarray(visual.uv, np.float32)
        if coordinates is None or coordinates.shape != (len(vertices), 2):
            image = None if image is None else image.mean((0, 1), keepdims=True).astype(np.uint8)
        else:
            corners = np.nan_to_num(coordinates)[faces]
            uv = np.stack([corners[..., 0], 1 - corners[..., 1]], -1)
        tint = visual.vertex_attributes.get("color")
        if tint is not None and len(tint) == len(vertices):
            tint = np.asarray(tint)
            scale = 255.0 if np.issubdtype(tint.dtype, np.integer) else 1.0
            colour = (tint[:, :3] / scale).astype(np.float32)[faces]
        bare = image is None and tint is None
        base = (GREY / 255 if bare else np.ones(3)) if factor is None else factor
        colour *= base.astype(np.float32)
        glow = getattr(visual.material, "emissiveFactor", None)
        glowing = glow is not None and float(np.max(glow)) > 0
        return Surface(vertices, faces, colour, uv, image, bare, glowing)
    if isinstance(visual, ColorVisuals) and visual.kind in ("vertex", "face"):
        by_vertex = visual.kind == "vertex"
        rgba = visual.vertex_colors if by_vertex else visual.face_colors
        rgb = np.asarray(rgba)[:, :3].astype(np.float32) / 255
        colour = rgb[faces] if by_vertex else colour * rgb[:, None]
        return Surface(vertices, faces, colour, uv, None, bare=False)
    return Surface(vertices, faces, colour * np.float32(GREY / 255), uv, None, bare=True)


def _image_of(material: Any) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return the (H, W, 3) uint8 image and the (3,) factor in [0, 1] of a material."""
    if isinstance(material, PBRMaterial):
        image, factor = material.baseColorTexture, material.baseColorFactor
    else:
        image = getattr(material, "image", None)
        factor = getattr(material, "diffuse", None) if image is None else None
    pixels = None if image is None else np.asarray(image.convert("RGB"))
    if factor is None:
        return pixels, None
    factor = np.asarray(factor)
    scale = 255.0 if np.issubdtype(factor.dtype, np.integer) else 1.0
    return pixels, (factor[:3] / scale).astype(np.float64)
