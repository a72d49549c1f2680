"""Pictures of a world of blocks: what cameras see of recorded cells.

The world of the published PERSIST is a game of blocks. These are such pictures of houses: every
cell is a block in the colour of its class, lit as ``geometry.block_light`` says.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.data.render import Rendered
from pewm_jax.data.voxel_classes import table_colours
from pewm_jax.data.voxel_frames import VoxelFrames
from pewm_jax.geometry.block_light import light
from pewm_jax.geometry.cameras import resize_intrinsics, unproject
from pewm_jax.geometry.march import EMPTY, through_pixels
from pewm_jax.types import Array, Camera

RAYS = 2
"""Rays along each side of a pixel."""
AIR = 24
"""Grey level where a ray leaves the grid."""


def pictures(voxels: VoxelFrames, camera: Camera, height: int, width: int) -> Rendered:
    """Return what T cameras see of the grids of T frames; drawn by the processor.

    Args:
        voxels: the grids.
        camera: (T,) cameras: intrinsics (T, 4) or one (4,) for all, for images of ``height`` ×
            ``width``.
        height: of the images, pixels.
        width: of the images, pixels.

    Returns:
        Colours; depth along z, 0 where nothing is met; and as ids those of the classes, −1 there.
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
    """Return ``_draw`` for a size of images, compiled."""
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
