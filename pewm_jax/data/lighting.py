"""Baked, view-independent light: the same surface point has the same colour from everywhere.

Light at a vertex = a soft directional term of the face normal × ambient occlusion, the fraction
of short rays over the hemisphere that meet nothing. All of it is fixed to the world.
"""

from __future__ import annotations

import platform
from typing import TYPE_CHECKING

import numpy as np

from pewm_jax.config import UserError

if TYPE_CHECKING:
    from embreex.rtcore_scene import EmbreeScene

SUN_3 = np.array([0.35, 0.55, 0.76])
"""Direction towards the soft main light (unit length)."""
RAYS = 16
"""Occlusion rays per vertex."""
LIFT_M = 0.04
"""Occlusion rays start this far above a surface, so that skirting and frames cast no halos."""


def require_embree() -> None:
    """Refuse to render where Embree is not installed; it has no wheel for every processor.

    Raises:
        UserError: it cannot be imported.
    """
    try:
        import embreex.rtcore_scene  # noqa: F401, PLC0415 - only what renders needs it
    except ImportError as error:
        raise UserError(
            f"rendering needs embreex, which cannot be imported on this {platform.machine()} "
            f"machine ({error}): pip install embreex, or collect where it is installed."
        ) from None


def embree(vertices_V3: np.ndarray, faces_F3: np.ndarray) -> EmbreeScene:
    """Build Embree's acceleration structure over a triangle mesh.

    Raises:
        UserError: Embree is not installed.
    """
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
    """Return the ambient occlusion of points, (P,) in [0, 1]; 1 = nothing within reach.

    Args:
        tracer: the scene's rays.
        points_P3: points on surfaces, in the tracer's coordinates.
        normals_P3: unit normals.
        reach_m: the longest occlusion ray, metres.
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

    Args:
        tracer: the scene's rays, in the coordinates of ``vertices_V3``.
        vertices_V3: vertices, not shared across hard edges.
        faces_F3: vertex indices.
        normals_F3: unit face normals.
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
    # Corners touch the next surface: the rays start a little inside the face.
    points = vertices_V3 + inward * np.minimum(0.03 / length, 0.4)
    used = np.flatnonzero(np.bincount(index, minlength=size))
    openness = np.ones(size)
    openness[used] = occlusion(tracer, points[used], normal[used])
    shade = 0.42 + 0.58 * openness
    return shade[faces_F3][:, :, None] * face_light(normals_F3)[:, None, :]
