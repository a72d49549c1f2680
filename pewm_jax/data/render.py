"""Render RGB, metric z-depth and ids: of a scene with Embree, of grids of class ids as blocks.

Rays into a scene have directions with z = 1 in the camera, so the distance that Embree returns is
the z-depth in metres.

The world of the published PERSIST is a game of blocks. ``draw_blocks`` renders such images of
houses: every cell is a block in the colour of its class, lit as in ``geometry.march``.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import UserError
from pewm_jax.data.scenes import Scene
from pewm_jax.data.shading import LEVELS, sample
from pewm_jax.data.voxels import VoxelFrames, table_colours
from pewm_jax.geometry.cameras import resize_intrinsics, unproject
from pewm_jax.geometry.march import EMPTY, light, through_pixels
from pewm_jax.types import Array, Camera

CHUNK = 1 << 14
"""Pixels shaded at a time: large enough to amortise calls, small enough for the caches."""


@dataclasses.dataclass(frozen=True)
class Rendered:
    """Rendered images.

    Attributes:
        rgb_THWC: uint8, black where nothing is hit.
        depth_THW: float32 metres along the camera's z axis, 0 where nothing is hit.
        ids_THW: int32 index into ``Scene.objects``, −1 where nothing is hit.
    """

    rgb_THWC: np.ndarray
    depth_THW: np.ndarray
    ids_THW: np.ndarray


def render(scene: Scene, camera: Camera, height: int, width: int) -> Rendered:
    """Render a scene from T cameras: intrinsics (T, 4) or one (4,) for all, poses (T, 4, 4).

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


RAYS = 2
"""Rays along each side of a pixel."""
AIR = 24
"""Grey level where a ray leaves the grid."""


def draw_blocks(voxels: VoxelFrames, camera: Camera, height: int, width: int) -> Rendered:
    """Render the grids of T frames as block worlds from T cameras (as for ``render``), on the CPU.

    Returns:
        Colours, z-depth (0 where a ray hits nothing), and class ids as ids (−1 there).
    """
    count = len(voxels.classes_TXYZ)
    intrinsics = np.broadcast_to(np.asarray(camera.intrinsics_4, np.float32), (count, 4))
    pose = np.asarray(camera.world_from_camera, np.float32)
    colours = table_colours(voxels.names).astype(np.float32)
    draw, made = _drawer(height, width), []
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        for t in range(count):
            grid = voxels.classes_TXYZ[t].astype(np.int32)
            low, cell = voxels.origin_T3[t].astype(np.float32), np.float32(voxels.cell_m)
            made.append(jax.device_get(draw(grid, low, cell, colours, intrinsics[t], pose[t])))
    rgb, depth, ids = (np.stack(each) for each in zip(*made, strict=True))
    return Rendered(np.round(rgb).astype(np.uint8), depth, ids)


@functools.lru_cache(maxsize=4)
def _drawer(height: int, width: int) -> Any:
    """Return ``_draw`` compiled for an image size."""
    return jax.jit(functools.partial(_draw, height, width))


def _draw(
    height: int,
    width: int,
    classes_XYZ: Array,
    low_3: Array,
    cell_m: Array,
    colours_N3: Array,
    intrinsics_4: Array,
    pose_44: Array,
) -> tuple[Array, Array, Array]:
    """Return colours (H, W, 3), depth and class ids (H, W) of one frame."""

    def met(rays: int) -> tuple[Any, Camera]:
        fine = Camera(resize_intrinsics(intrinsics_4, rays, rays)[None], pose_44[None])
        size = height * rays, width * rays
        found = through_pixels(classes_XYZ, low_3, cell_m, fine, *size, layers=1)
        return jax.tree.map(lambda x: x[0, ..., 0], found), fine

    hits, fine = met(RAYS)
    eye, ones = pose_44[:3, 3], jnp.ones((1, height * RAYS, width * RAYS))
    way = unproject(ones, fine)[0] - eye
    occupied = classes_XYZ != EMPTY
    lit = light(occupied, low_3, cell_m, eye, way, hits.distance_L, hits.side_L)
    seen = (hits.ids_L != EMPTY)[..., None]
    shown = jnp.where(seen, colours_N3[hits.ids_L] * lit[..., None], AIR)
    shown = shown.reshape(height, RAYS, width, RAYS, 3).mean((1, 3))
    hits, _ = met(1)
    seen = hits.ids_L != EMPTY
    return shown, jnp.where(seen, hits.distance_L, 0), jnp.where(seen, hits.ids_L, -1)
