"""Images of grids of class ids: as a camera sees them, as a block world, and from above.

The world of the published PERSIST is a game of blocks. ``draw_blocks`` renders such images of
houses: every cell is a block in the colour of its class, lit as in ``geometry.block_light``.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.data.render import Rendered
from pewm_jax.data.voxels import VoxelFrames, table_colours
from pewm_jax.geometry.block_light import light
from pewm_jax.geometry.cameras import resize_intrinsics, unproject
from pewm_jax.geometry.march import EMPTY, through_pixels
from pewm_jax.types import Array, Camera

SIDES = np.array([0.85, 0.7, 1.0, 0.5])
"""Brightness of faces perpendicular to x, y and z, and of the cell in which a ray begins."""
ABOVE_M = 0.5
"""Cells this far above the camera (ceilings) are omitted from the view from above, metres."""
BACKGROUND = 24
PIXELS = 8
"""Pixels along the side of a cell in the view from above."""


@dataclasses.dataclass(frozen=True)
class GridView:
    """A grid as a camera sees it.

    Attributes:
        rgb_HWC: (H, W, 3) uint8 colours of the classes, shaded by the side of the cell.
        depth_HW: (H, W) float32 metres along z, 0 where the ray hits nothing.
        classes_HW: (H, W) class ids, 0 where the ray hits nothing.
    """

    rgb_HWC: np.ndarray
    depth_HW: np.ndarray
    classes_HW: np.ndarray


def grid_from_camera(
    voxels: VoxelFrames, frame: int, camera: Camera, height: int, width: int
) -> GridView:
    """Return the grid of one frame as its camera sees it.

    Args:
        voxels: the grids of T frames.
        frame: number of the frame.
        camera: (T,) cameras, whose intrinsics belong to images of ``height`` × ``width``.
        height: image height in pixels.
        width: image width in pixels.
    """
    one = Camera(camera.intrinsics_4[frame : frame + 1], camera.world_from_camera[frame][None])
    hits = _march(height, width)(
        voxels.classes_TXYZ[frame], voxels.origin_T3[frame], np.float32(voxels.cell_m), one
    )
    ids, depth, side = (
        np.asarray(x)[0, ..., 0] for x in (hits.ids_L, hits.distance_L, hits.side_L)
    )
    seen = ids != EMPTY
    colours = table_colours(voxels.names)[ids] * SIDES[side][..., None]
    rgb = np.where(seen[..., None], colours, BACKGROUND).astype(np.uint8)
    return GridView(rgb, np.where(seen, depth, 0).astype(np.float32), ids)


@functools.lru_cache(maxsize=4)
def _march(height: int, width: int):
    """Return the compiled march for an image size."""
    march = functools.partial(through_pixels, height=height, width=width, layers=1)
    return jax.jit(march)


def grid_from_above(voxels: VoxelFrames, frame: int, camera: Camera) -> np.ndarray:
    """Return the grid of one frame from above (RGB, x to the right, y up), with the field of view.

    Of each column the highest cell below ``ABOVE_M`` over the camera is drawn; higher cells are
    lighter.
    """
    grid, origin, cell = voxels.classes_TXYZ[frame], voxels.origin_T3[frame], voxels.cell_m
    pose = np.asarray(camera.world_from_camera[frame], np.float64)
    top = int(np.clip((pose[2, 3] + ABOVE_M - origin[2]) / cell, 1, grid.shape[2]))
    full = grid[:, :, :top] != EMPTY
    height = np.where(full.any(2), top - 1 - full[:, :, ::-1].argmax(2), 0)
    ids = np.take_along_axis(grid[:, :, :top], height[..., None], 2)[..., 0]
    light = 0.55 + 0.45 * height / max(1, top - 1)
    colours = table_colours(voxels.names)[ids] * light[..., None]
    colours = np.where(full.any(2)[..., None], colours, BACKGROUND)
    image = np.repeat(np.repeat(colours.swapaxes(0, 1), PIXELS, 0), PIXELS, 1)
    image = np.ascontiguousarray(image[::-1], np.uint8)
    at = (pose[:2, 3] - origin[:2]) / cell * PIXELS
    fx, width = float(camera.intrinsics_4[frame][0]), 2 * float(camera.intrinsics_4[frame][2])
    for sign in (-1, 0, 1):
        way = (pose[:2, :3] @ [sign * width / 2 / fx, 0.0, 1.0]) * 2.0 / cell * PIXELS
        ends = [(round(x), round(len(image) - 1 - y)) for x, y in (at, at + way)]
        cv2.line(image, ends[0], ends[1], (255, 60, 60), 2, cv2.LINE_AA)
    return image


RAYS = 2
"""Rays along each side of a pixel."""
AIR = 24
"""Grey level where a ray leaves the grid."""


def draw_blocks(voxels: VoxelFrames, camera: Camera, height: int, width: int) -> Rendered:
    """Render the grids of T frames as block worlds from T cameras, on the CPU.

    Args:
        voxels: the grids.
        camera: (T,) cameras: intrinsics (T, 4) or one (4,) for all, of images of ``height`` ×
            ``width``.
        height: image height in pixels.
        width: image width in pixels.

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
