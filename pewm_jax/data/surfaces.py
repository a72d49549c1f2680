"""Positions, texture coordinates and colours of one mesh, in one form for all kinds of colour."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import trimesh
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from pewm_jax.config import UserError

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
        bare: it has a single colour and no image; it is shaded by its normals.
        glowing: it emits light and is not shaded.
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

    Image × factor × vertex tint, as glTF has it, but without its conversion to linear light:
    colours are multiplied as they are stored, which is how scans are meant to look.

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
    if isinstance(visual, ColorVisuals) and visual.kind == "vertex":
        colours = np.asarray(visual.vertex_colors)[:, :3].astype(np.float32) / 255
        return Surface(vertices, faces, colours[faces], uv, None, bare=False)
    if isinstance(visual, ColorVisuals) and visual.kind == "face":
        colours = np.asarray(visual.face_colors)[:, :3].astype(np.float32) / 255
        return Surface(vertices, faces, colour * colours[:, None], uv, None, bare=False)
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
