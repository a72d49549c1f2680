"""Parts with poses of their own, such as doors and arms, rendered in front of a static scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import trimesh

from pewm_jax.data.render import Rendered, render
from pewm_jax.data.scenes import Scene, from_trimesh
from pewm_jax.houses.shapes import Piece
from pewm_jax.types import Camera

_APART_M = 20.0
"""Distance between parts while their light is baked, so that none occludes another, metres."""


def make_parts(pieces: Sequence[Piece]) -> Scene:
    """Return pieces as one scene, each lit alone and in its own frame.

    ``object_F`` is the number of the part.
    """
    scene = trimesh.Scene(metadata={"shading": "soft"})
    for number, piece in enumerate(pieces):
        apart = np.eye(4)
        apart[0, 3] = _APART_M * number
        solid = piece.solid()
        assert solid is not None
        scene.add_geometry(solid, node_name=f"{piece.kind}{number}", transform=apart)
    made = from_trimesh(scene, "parts")
    assert list(made.objects) == [f"{piece.kind}{k}" for k, piece in enumerate(pieces)]
    vertices = made.vertices_V3.copy()
    vertices[:, 0] -= _APART_M * part_of_vertex(made)
    return dataclasses.replace(made, vertices_V3=vertices)


def place_parts(parts: Scene, world_from_part_P44: np.ndarray) -> Scene:
    """Return the parts at their poses of one frame."""
    pose = world_from_part_P44[part_of_vertex(parts)]
    vertices = np.einsum("vij,vj->vi", pose[:, :3, :3], parts.vertices_V3) + pose[:, :3, 3]
    turn = world_from_part_P44[parts.object_F, :3, :3]
    normals = np.einsum("fij,fj->fi", turn, parts.normals_F3)
    return dataclasses.replace(parts, vertices_V3=vertices, normals_F3=normals)


def part_of_vertex(parts: Scene) -> np.ndarray:
    """Return (V,) the part that each vertex belongs to."""
    part_V = np.zeros(len(parts.vertices_V3), np.int64)
    part_V[parts.faces_F3.ravel()] = np.repeat(parts.object_F, 3)
    return part_V


def render_over(
    seen: Rendered, parts: Scene, poses_TP44: np.ndarray, camera: Camera, first_id: int
) -> None:
    """Render parts into T frames where they are nearer than what the frames show.

    Args:
        seen: the frames, which are changed.
        parts: the parts, each in its own frame, as of ``make_parts``.
        poses_TP44: world_from_part.
        camera: the cameras of the frames.
        first_id: the id of the first part.
    """
    pose = np.asarray(camera.world_from_camera)
    intrinsics = np.broadcast_to(np.asarray(camera.intrinsics_4), (len(pose), 4))
    height, width = seen.depth_THW.shape[1:]
    for t in range(len(pose)):
        one = Camera(intrinsics[t : t + 1], pose[t : t + 1])
        over = render(place_parts(parts, poses_TP44[t]), one, height, width)
        depth, behind = over.depth_THW[0], seen.depth_THW[t]
        nearer = (over.ids_THW[0] >= 0) & ((behind <= 0) | (depth < behind))
        seen.rgb_THWC[t][nearer] = over.rgb_THWC[0][nearer]
        seen.depth_THW[t][nearer] = depth[nearer]
        seen.ids_THW[t][nearer] = over.ids_THW[0][nearer] + first_id
