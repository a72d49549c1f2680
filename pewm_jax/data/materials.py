"""Texture images as one flat array of texels with mip levels, sampled bilinearly.

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
        width_L: (images × LEVELS,) int32, texels in a row of a level.
        height_L: (images × LEVELS,) int32, rows of a level.
    """

    texels_P4: np.ndarray
    offset_L: np.ndarray
    width_L: np.ndarray
    height_L: np.ndarray


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
    width_L, height_L = np.array(sizes, np.int32).T.copy()
    return Textures(texels, np.array(offsets, np.int32), width_L, height_L)


def sample(textures: Textures, level_P: np.ndarray, s_P: np.ndarray, t_P: np.ndarray) -> np.ndarray:
    """Look colours up bilinearly, repeating at the borders.

    Args:
        textures: the scene's images.
        level_P: int32 row of the level table (image × LEVELS + level).
        s_P: float32, 0 → 1 from the left to the right border of the image.
        t_P: float32, 0 → 1 from the top to the bottom border.

    Returns:
        (3, P) float32 in [0, 255]; channels first, as whole rows are fastest to work on.
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
