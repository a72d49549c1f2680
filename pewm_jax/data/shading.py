"""Textures and baked light of scenes.

Texture images form one flat array of texels with mip levels, which is sampled bilinearly. Colours
are multiplied as they are stored (sRGB), without conversion to linear light.

Light is baked and independent of the view: a surface point has the same colour from everywhere. The
light at a vertex is a soft directional term of the face normal × ambient occlusion, the fraction of
short rays over the hemisphere that hit nothing.
"""

from __future__ import annotations

import dataclasses
import platform
from typing import TYPE_CHECKING

import cv2
import numpy as np

from pewm_jax.config import UserError

if TYPE_CHECKING:
    from embreex.rtcore_scene import EmbreeScene

LEVELS = 7
"""Mip levels kept per texture: beyond 1/64 of a scan's atlas, charts bleed into each other."""


@dataclasses.dataclass(frozen=True, eq=False)
class Textures:
    """All images of a scene, concatenated.

    Attributes:
        texels_P4: uint8 RGB and padding, every level of every image, row-major.
        offset_L: (images × LEVELS,) int32, first texel of a level.
        width_L: int32, texels in a row of a level; ``height_L`` are its rows.
    """

    texels_P4: np.ndarray
    offset_L: np.ndarray
    width_L: np.ndarray
    height_L: np.ndarray


def pack(images: list[np.ndarray]) -> Textures:
    """Build mip chains of (H, W, 3) uint8 images, first row on top, and concatenate them."""
    parts, offsets, sizes, total = [], [], [], 0
    for image in images:
        level = np.ascontiguousarray(image)
        for index in range(LEVELS):
            if index and max(level.shape[:2]) > 1:
                height, width = (max(1, side // 2) for side in level.shape[:2])
                level = cv2.resize(level, (width, height), interpolation=cv2.INTER_AREA)
                new = True
            else:
                new = index == 0
            if new:
                parts.append(level.reshape(-1, 3))
                total += parts[-1].shape[0]
            offsets.append(total - parts[-1].shape[0])
            sizes.append((level.shape[1], level.shape[0]))
    texels = np.zeros((total, 4), np.uint8)
    np.concatenate(parts, out=texels[:, :3])
    width_L, height_L = np.array(sizes, np.int32).T.copy()
    return Textures(texels, np.array(offsets, np.int32), width_L, height_L)


def sample(textures: Textures, level_P: np.ndarray, s_P: np.ndarray, t_P: np.ndarray) -> np.ndarray:
    """Sample colours bilinearly, repeating at the borders, as (3, P) float32 in [0, 255].

    Channels come first, because contiguous rows are faster.

    Args:
        textures: the scene's images.
        level_P: int32 row of the level table (image × LEVELS + level).
        s_P: float32, 0 → 1 from the left to the right border of the image.
        t_P: float32, 0 → 1 from the top to the bottom border.
    """
    width, height = textures.width_L.take(level_P), textures.height_L.take(level_P)
    x0, x1, right = _neighbours(s_P, width)
    y0, y1, below = _neighbours(t_P, height)
    both = right * below
    right -= both
    below -= both
    neither = 1.0 - right - below - both
    y0 *= width
    y1 *= width
    offset = textures.offset_L.take(level_P)
    y0 += offset
    y1 += offset
    packed = textures.texels_P4.view(np.uint32)[:, 0]
    corners = [
        (packed.take(row + column).view(np.uint8).reshape(-1, 4), weight)
        for row, column, weight in (
            (y0, x0, neither),
            (y0, x1, right),
            (y1, x0, below),
            (y1, x1, both),
        )
    ]
    result = np.zeros((3, len(s_P)), np.float32)
    for channel in range(3):
        for texel, weight in corners:
            result[channel] += texel[:, channel] * weight
    return result


def _neighbours(
    coordinate_P: np.ndarray, count_P: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the two texels around a coordinate along one axis and the weight of the second."""
    position = coordinate_P - np.floor(coordinate_P)
    position *= count_P
    position -= 0.5
    low = np.floor(position)
    position -= low
    first = low.astype(np.int32)
    second = first + 1
    first += count_P * (first < 0)
    second -= count_P * (second >= count_P)
    return first, second, position.astype(np.float32, copy=False)


SUN_3 = np.array([0.35, 0.55, 0.76])
"""Direction towards the soft main light (unit length)."""
RAYS = 16
"""Occlusion rays per vertex."""
LIFT_M = 0.04
"""Occlusion rays start this far above a surface, so that skirting and frames cast no halos."""


def require_embree() -> None:
    """Raise UserError if Embree cannot be imported; it has no wheels for some processors."""
    try:
        import embreex.rtcore_scene  # noqa: F401, PLC0415 - only rendering needs it
    except ImportError as error:
        raise UserError(
            f"rendering needs embreex, which cannot be imported on this {platform.machine()} "
            f"machine ({error}): pip install embreex, or collect where it is installed."
        ) from None


def embree(vertices_V3: np.ndarray, faces_F3: np.ndarray) -> EmbreeScene:
    """Build Embree's structure over a triangle mesh; UserError if it is not installed."""
    require_embree()
    from embreex.mesh_construction import TriangleMesh  # noqa: PLC0415
    from embreex.rtcore_scene import EmbreeScene  # noqa: PLC0415

    scene = EmbreeScene(robust=True)
    vertices = np.ascontiguousarray(vertices_V3, np.float32)
    TriangleMesh(scene, vertices, np.ascontiguousarray(faces_F3, np.int32))
    return scene


def face_light(normals_F3: np.ndarray) -> np.ndarray:
    """Return (F, 3) RGB light for unit face normals: warm from above, cool from below."""
    up = normals_F3[:, 2:] * 0.5 + 0.5
    sky, ground = np.array([1.02, 1.0, 0.97]), np.array([0.84, 0.855, 0.89])
    side = 0.12 * np.tanh(1.5 * normals_F3[:, :2] @ SUN_3[:2])[:, None]
    return ground + (sky - ground) * up + side


def occlusion(
    tracer: EmbreeScene, points_P3: np.ndarray, normals_P3: np.ndarray, reach_m: float = 1.2
) -> np.ndarray:
    """Return the (P,) openness of points in [0, 1]; 1 means that nothing is within ``reach_m``.

    The points on surfaces are in the tracer's coordinates; the normals have length 1.
    """
    count = len(points_P3)
    k = np.arange(RAYS)
    # A Vogel spiral over the disc, lifted to the hemisphere: cosine-weighted directions.
    radius, angle = np.sqrt((k + 0.5) / RAYS), k * 2.399963
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], -1)
    reach = reach_m * (0.1 + 0.9 * ((k * 7) % RAYS + 0.5) / RAYS)
    helper = np.where(np.abs(normals_P3[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    tangent = np.cross(helper, normals_P3)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    frame = np.stack([tangent, np.cross(normals_P3, tangent), normals_P3], 1)
    rays = np.matmul(local.astype(np.float32), frame.astype(np.float32)).reshape(-1, 3)
    origins = np.repeat((points_P3 + LIFT_M * normals_P3).astype(np.float32), RAYS, 0)
    reaches = np.tile(reach.astype(np.float32), count)
    hit = tracer.run(origins, rays, dists=reaches, query="OCCLUDED") >= 0
    return 1.0 - hit.reshape(count, RAYS).mean(1)


def soft_light(
    tracer: EmbreeScene, vertices_V3: np.ndarray, faces_F3: np.ndarray, normals_F3: np.ndarray
) -> np.ndarray:
    """Return (F, 3, 3) baked RGB light at the corners of every face.

    The vertices are in the tracer's coordinates and not shared across hard edges; the normals have
    length 1.
    """
    centroid = vertices_V3[faces_F3].mean(1)
    index, size = faces_F3.ravel(), len(vertices_V3)
    faces_at = np.bincount(index, minlength=size).clip(1)[:, None]
    normal, inside = (
        np.stack([np.bincount(index, np.repeat(a[:, i], 3), size) for i in range(3)], -1) / faces_at
        for a in (normals_F3, centroid)
    )
    normal[np.abs(normal).sum(1) < 1e-6] = (0.0, 0.0, 1.0)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    inward = inside - vertices_V3
    length = np.linalg.norm(inward, axis=-1, keepdims=True).clip(1e-9)
    # Corners touch the next surface, so the rays start a little inside the face.
    points = vertices_V3 + inward * np.minimum(0.03 / length, 0.4)
    used = np.flatnonzero(np.bincount(index, minlength=size))
    openness = np.ones(size)
    openness[used] = occlusion(tracer, points[used], normal[used])
    shade = 0.42 + 0.58 * openness
    return shade[faces_F3][:, :, None] * face_light(normals_F3)[:, None, :]
