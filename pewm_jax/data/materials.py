"""Texture images → one flat array of texels with mip levels, sampled bilinearly.

Colours are multiplied as they are stored (sRGB); nothing is converted to linear light.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

LEVELS = 7
"""Mip levels kept per texture: beyond 1/64 of a scan's atlas, charts bleed into each other."""


@dataclasses.dataclass(frozen=True, eq=False)
class Textures:
    """All images of a scene, end to end.

    Attributes:
        texels_P4: uint8 RGB and padding, every level of every image, row-major.
        offset_L: (images × LEVELS,) int32, first texel of a level.
        size_L2: (images × LEVELS, 2) float32, width and height of a level in texels.
    """

    texels_P4: np.ndarray
    offset_L: np.ndarray
    size_L2: np.ndarray


def pack(images: list[np.ndarray]) -> Textures:
    """Build mip chains and lay them end to end.

    Args:
        images: (H, W, 3) uint8 each, first row on top.
    """
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
    return Textures(texels, np.array(offsets, np.int32), np.array(sizes, np.float32))


def sample(textures: Textures, level_P: np.ndarray, s_P: np.ndarray, t_P: np.ndarray) -> np.ndarray:
    """Look colours up bilinearly, repeating at the borders.

    Args:
        textures: the scene's images.
        level_P: int32 row of the level table (image × LEVELS + level).
        s_P: float32, 0 → 1 from the left to the right border of the image.
        t_P: float32, 0 → 1 from the top to the bottom border.

    Returns:
        (P, 3) float32 in [0, 255].
    """
    size = textures.size_L2[level_P]
    width, height = size[:, 0], size[:, 1]
    x = (s_P - np.floor(s_P)) * width
    y = (t_P - np.floor(t_P)) * height
    x -= 0.5
    y -= 0.5
    left, top = np.floor(x), np.floor(y)
    x -= left
    y -= top
    w, h = width.astype(np.int32), height.astype(np.int32)
    x0, y0 = left.astype(np.int32), top.astype(np.int32)
    x1, y1 = x0 + 1, y0 + 1
    x0 += w * (x0 < 0)
    y0 += h * (y0 < 0)
    x1 -= w * (x1 >= w)
    y1 -= h * (y1 >= h)
    offset = textures.offset_L[level_P]
    row0, row1 = offset + y0 * w, offset + y1 * w
    texels, x, y = textures.texels_P4, x[:, None], y[:, None]
    upper = _mix(texels.take(row0 + x0, 0), texels.take(row0 + x1, 0), x)
    lower = _mix(texels.take(row1 + x0, 0), texels.take(row1 + x1, 0), x)
    lower -= upper
    lower *= y
    upper += lower
    return upper[:, :3]


def _mix(a_P4: np.ndarray, b_P4: np.ndarray, weight_P1: np.ndarray) -> np.ndarray:
    a, b = a_P4.astype(np.float32), b_P4.astype(np.float32)
    b -= a
    b *= weight_P1
    a += b
    return a
