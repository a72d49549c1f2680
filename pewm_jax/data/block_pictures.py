"""Pictures of a world of blocks: what cameras see of recorded cells, lit and shaded.

The world of the published PERSIST is a game of blocks, whose pictures show nothing that its voxels
do not have. These are such pictures of houses: every cell is a block in the colour of its class.
Sides are lit by their direction, light falls off with distance, and corners are dark where blocks
meet.
"""

from __future__ import annotations

import functools

import cv2
import jax
import numpy as np

from pewm_jax.data.render import Rendered
from pewm_jax.data.voxel_classes import table_colours
from pewm_jax.data.voxel_frames import VoxelFrames
from pewm_jax.geometry.cameras import resize_intrinsics
from pewm_jax.geometry.march import EMPTY, Layers, through_pixels
from pewm_jax.types import Camera

SIDES = np.array([0.88, 0.74, 1.0, 0.5], np.float32)
"""Light on a side that is met across x, y, z, and on the cell in which a ray begins."""
BELOW = 0.62
"""Light on a side that is seen from below, such as a ceiling."""
HALF_M = 7.0
"""At this distance light has fallen to a half, metres."""
CORNER, CORNER_M = 0.35, 0.2
"""How much darker a corner is than what lies this far from it, metres."""
RAYS = 2
"""Rays along each side of a pixel."""
AIR = 24
"""Grey level where a ray leaves the grid."""


def pictures(voxels: VoxelFrames, camera: Camera, height: int, width: int) -> Rendered:
    """Return what T cameras see of the grids of T frames.

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
    colours = table_colours(voxels.names).astype(np.float32)
    rgb = np.zeros((count, height, width, 3), np.uint8)
    depth = np.zeros((count, height, width), np.float32)
    ids = np.full((count, height, width), -1, np.int32)
    for t in range(count):
        pose = np.asarray(camera.world_from_camera[t], np.float32)
        grid, low = voxels.classes_TXYZ[t], voxels.origin_T3[t].astype(np.float32)
        fine = np.asarray(resize_intrinsics(intrinsics[t], RAYS, RAYS))
        hits = _met(grid, low, voxels.cell_m, fine, pose, height * RAYS, width * RAYS)
        way = _ways(fine, height * RAYS, width * RAYS) @ pose[:3, :3].T
        shown = colours[hits.ids_L] * light(grid, low, voxels.cell_m, pose[:3, 3], way, hits)
        shown = np.where((hits.ids_L != EMPTY)[..., None], shown, AIR).astype(np.float32)
        rgb[t] = np.round(cv2.resize(shown, (width, height), interpolation=cv2.INTER_AREA))
        hits = _met(grid, low, voxels.cell_m, intrinsics[t], pose, height, width)
        seen = hits.ids_L != EMPTY
        depth[t], ids[t] = np.where(seen, hits.distance_L, 0), np.where(seen, hits.ids_L, -1)
    return Rendered(rgb, depth, ids)


def light(
    classes_XYZ: np.ndarray,
    low_3: np.ndarray,
    cell_m: float,
    eye_3: np.ndarray,
    way_HW3: np.ndarray,
    hits: Layers,
) -> np.ndarray:
    """Return by what the colours of what rays meet are multiplied, (H, W, 1).

    Args:
        classes_XYZ: class ids.
        low_3: lowest corner of the grid, metres.
        cell_m: side of a cell, metres.
        eye_3: where the rays begin, metres.
        way_HW3: where they go, with length 1 along the camera's axis.
        hits: (H, W) the first cell that each meets.
    """
    far, side = np.asarray(hits.distance_L), np.asarray(hits.side_L)
    facing = SIDES[side]
    facing = np.where((side == 2) & (way_HW3[..., 2] > 0), BELOW, facing)
    metres = far * np.linalg.norm(way_HW3, axis=-1)
    shine = facing / (1 + np.square(np.where(np.isfinite(metres), metres, 0) / HALF_M))
    return (shine * _corners(classes_XYZ, low_3, cell_m, eye_3, way_HW3, far, side))[..., None]


def _corners(
    classes_XYZ: np.ndarray,
    low_3: np.ndarray,
    cell_m: float,
    eye_3: np.ndarray,
    way_HW3: np.ndarray,
    far_HW: np.ndarray,
    side_HW: np.ndarray,
) -> np.ndarray:
    """Return how much light comes into corners, (H, W): 1 far from them."""
    met = np.isfinite(far_HW) & (side_HW >= 0)
    at = (eye_3 + np.where(met, far_HW, 0)[..., None] * way_HW3 - low_3) / cell_m
    axis = np.where(met, side_HW, 0)
    across = np.arange(3) == axis[..., None]
    # The open cell before the side: the side's plane is a border, the ray comes from before it.
    before = np.where(across, np.round(at) - (way_HW3 > 0), np.floor(at)).astype(int)
    inside = at - np.floor(at)
    shape, dark = np.array(classes_XYZ.shape), np.zeros(far_HW.shape, np.float32)
    for other in range(3):
        for sign in (-1, 1):
            beside = before + sign * (np.arange(3) == other)
            within = ((beside >= 0) & (beside < shape)).all(-1)
            x, y, z = np.moveaxis(np.clip(beside, 0, shape - 1), -1, 0)
            wall = within & (classes_XYZ[x, y, z] != EMPTY) & (axis != other)
            gap = inside[..., other] if sign < 0 else 1 - inside[..., other]
            dark = np.maximum(dark, np.where(wall, 1 - gap * cell_m / CORNER_M, 0))
    return np.where(met, 1 - CORNER * dark, 1)


def _ways(intrinsics_4: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return the rays through the middles of pixels in the camera, (H, W, 3), z = 1."""
    fx, fy, cx, cy = np.asarray(intrinsics_4, np.float32)
    across = (np.arange(width, dtype=np.float32) + 0.5 - cx) / fx
    down = (np.arange(height, dtype=np.float32) + 0.5 - cy) / fy
    return np.stack([*np.meshgrid(across, down), np.ones((height, width), np.float32)], -1)


def _met(
    grid_XYZ: np.ndarray,
    low_3: np.ndarray,
    cell_m: float,
    intrinsics_4: np.ndarray,
    pose_44: np.ndarray,
    height: int,
    width: int,
) -> Layers:
    """Return the first cell that the rays of a camera meet, (H, W)."""
    camera = Camera(intrinsics_4[None], pose_44[None])
    hits = _march(height, width)(grid_XYZ.astype(np.int32), low_3, np.float32(cell_m), camera)
    return jax.tree.map(lambda x: np.asarray(x)[0, ..., 0], hits)


@functools.lru_cache(maxsize=4)
def _march(height: int, width: int):
    """Return the march for a size of images, compiled."""
    march = functools.partial(through_pixels, height=height, width=width, layers=1)
    return jax.jit(march)
