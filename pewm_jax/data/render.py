"""Render RGB, metric z-depth and instance ids of a scene, casting one ray per pixel with Embree.

Ray directions have z = 1 in the camera, so the distance that Embree returns is the z-depth in
metres.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.data.scenes import Scene
from pewm_jax.data.shading import LEVELS, sample
from pewm_jax.types import Camera

CHUNK = 1 << 14
"""Pixels shaded at a time: large enough to amortise calls, small enough for the caches."""


@dataclasses.dataclass(frozen=True)
class Rendered:
    """Rendered images.

    Attributes:
        rgb_THWC: (T, H, W, 3) uint8, black where nothing is hit.
        depth_THW: (T, H, W) float32 metres along the camera's z axis, 0 where nothing is hit.
        ids_THW: (T, H, W) int32 index into ``Scene.objects``, −1 where nothing is hit.
    """

    rgb_THWC: np.ndarray
    depth_THW: np.ndarray
    ids_THW: np.ndarray


def render(scene: Scene, camera: Camera, height: int, width: int) -> Rendered:
    """Render a scene from T cameras.

    Args:
        scene: the scene.
        camera: (T,) cameras: intrinsics (T, 4) or one (4,) for all, poses (T, 4, 4), metres.
        height: image height in pixels.
        width: image width in pixels.

    Raises:
        UserError: the cameras have the wrong shape, are not finite, or the image is empty.
    """
    pose = np.asarray(camera.world_from_camera, np.float64)
    intrinsics = np.asarray(camera.intrinsics_4, np.float64)
    if pose.ndim != 3 or pose.shape[1:] != (4, 4) or intrinsics.shape[-1:] != (4,):
        raise UserError(
            f"render needs poses (T, 4, 4) and intrinsics (T, 4) or (4,), got {pose.shape} and "
            f"{intrinsics.shape}: add a leading axis to a single camera."
        )
    if height < 1 or width < 1:
        raise UserError(f"an image of {height} x {width} pixels is empty: ask for at least 1 x 1.")
    if not (np.isfinite(pose).all() and np.isfinite(intrinsics).all()):
        raise UserError("a camera to render has values that are not finite: check its pose.")
    frames = len(pose)
    intrinsics = np.broadcast_to(intrinsics, (frames, 4))
    rgb = np.zeros((frames, height, width, 3), np.uint8)
    depth = np.zeros((frames, height, width), np.float32)
    ids = np.full((frames, height, width), -1, np.int32)
    step = max(1, CHUNK // (height * width))
    for first in range(0, frames, step):
        part = slice(first, min(first + step, frames))
        origins, directions = camera_rays(scene, pose[part], intrinsics[part], height, width)
        hits = scene.tracer.run(origins, directions, output=1)
        focal = np.repeat(intrinsics[part, 0].astype(np.float32), height * width)
        colour, z, instance = _shade(scene, hits, focal)
        pixels = rgb[part].reshape(-1, 3)
        for channel in range(3):
            pixels[:, channel] = colour[channel]
        depth[part] = z.reshape(depth[part].shape)
        ids[part] = instance.reshape(ids[part].shape)
    return Rendered(rgb, depth, ids)


def camera_rays(
    scene: Scene, pose_T44: np.ndarray, intrinsics_T4: np.ndarray, height: int, width: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return origins and directions (T·H·W, 3) float32; directions advance z by 1 m per unit."""
    fx, fy, cx, cy = (intrinsics_T4[:, i : i + 1, None] for i in range(4))
    x = (np.arange(width)[None, :, None] + 0.5 - cx) / fx
    y = (np.arange(height)[None, :, None] + 0.5 - cy) / fy
    right, down, forward = (pose_T44[:, None, :3, i] for i in range(3))
    across = (x * right).astype(np.float32)
    along = (y * down + forward).astype(np.float32)
    directions = along[:, :, None, :] + across[:, None, :, :]
    origin = (pose_T44[:, :3, 3] - scene.centre_3).astype(np.float32)
    return np.repeat(origin, height * width, 0), directions.reshape(-1, 3)


def _shade(
    scene: Scene, hits: dict[str, np.ndarray], focal_P: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return colour (3, P) in [0, 255], z-depth (P,) and instance ids (P,) of hits."""
    missed = hits["primID"] < 0
    face = np.where(missed, 0, hits["primID"])
    z = np.where(missed, np.float32(0), hits["tfar"])
    row = scene.shading_16F.take(face, 1)
    value, second = row[5:10], row[10:15]
    value *= hits["u"]
    value += row[:5]
    second *= hits["v"]
    value += second
    texels_per_pixel = row[15]
    texels_per_pixel *= z
    texels_per_pixel /= focal_P
    np.clip(texels_per_pixel, 1.0, float(1 << (LEVELS - 1)), out=texels_per_pixel)
    level = np.rint(np.log2(texels_per_pixel)).astype(np.int32)
    level += scene.texture_F.take(face)
    colour = sample(scene.textures, level, value[3], value[4])
    colour *= value[:3]
    colour += 0.5
    np.minimum(colour, 255.0, out=colour)
    colour *= ~missed
    return colour, z, np.where(missed, np.int32(-1), scene.object_F.take(face))
