"""Fit images to a size without changing their aspect ratio, and their intrinsics with them.

Images are turned by right angles, cropped or put into a frame, and resized. Colours are averaged.
Depth is picked, because interpolated depths would lie between surfaces: a pixel gets the depth of
the recorded pixel that its centre falls on. The depth image may have another size than the colours.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Literal

import cv2
import numpy as np


@dataclasses.dataclass(frozen=True)
class Fit:
    """From recorded images to those of a data set.

    Attributes:
        source: width and height of the colour images, before they are turned.
        size: width and height to make; None keeps the size.
        way: how to get another aspect ratio.
        turns: quarter turns clockwise.
    """

    source: tuple[int, int]
    size: tuple[int, int] | None = None
    way: Literal["crop", "letterbox"] = "crop"
    turns: int = 0

    @property
    def turned(self) -> tuple[int, int]:
        """Width and height after turning."""
        width, height = self.source
        return (width, height) if self.turns % 2 == 0 else (height, width)

    @property
    def target(self) -> tuple[int, int]:
        """Width and height that are made."""
        return self.size or self.turned

    @functools.cached_property
    def boxes(self) -> tuple[tuple[int, int, int, int], tuple[int, int, int, int]]:
        """The part of the turned image, its place in the target: left, top, width, height."""
        (wide, high), (width, height) = self.turned, self.target
        if self.way == "crop":
            broad = max(1, min(wide, round(high * width / height)))
            tall = max(1, min(high, round(wide * height / width)))
            return ((wide - broad) // 2, (high - tall) // 2, broad, tall), (0, 0, width, height)
        scale = min(width / wide, height / high)
        broad, tall = max(1, round(wide * scale)), max(1, round(high * scale))
        return (0, 0, wide, high), ((width - broad) // 2, (height - tall) // 2, broad, tall)

    def intrinsics(self, intrinsics_4: np.ndarray) -> np.ndarray:
        """Return the intrinsics (4,) of the target, centres at +0.5; float64."""
        fx, fy, cx, cy = turn_intrinsics(intrinsics_4, self.source, self.turns)
        (left, top, broad, tall), (x, y, width, height) = self.boxes
        across, down = width / broad, height / tall
        return np.array(
            [fx * across, fy * down, (cx - left) * across + x, (cy - top) * down + y], np.float64
        )

    def colours(self, image_HWC: np.ndarray) -> np.ndarray:
        """Return colours of the target size, black in added borders."""
        (left, top, broad, tall), (x, y, width, height) = self.boxes
        part = np.rot90(image_HWC, -self.turns)[top : top + tall, left : left + broad]
        part = np.ascontiguousarray(part)
        if (width, height) != (broad, tall):
            how = cv2.INTER_AREA if width < broad else cv2.INTER_LINEAR
            part = cv2.resize(part, (width, height), interpolation=how)
        if (width, height) == self.target:
            return part
        framed = np.zeros((self.target[1], self.target[0], *part.shape[2:]), part.dtype)
        framed[y : y + height, x : x + width] = part
        return framed

    def depth(
        self, image_HW: np.ndarray, depth_4: np.ndarray | None, colours_4: np.ndarray
    ) -> np.ndarray:
        """Return a depth image of the target size, 0 outside the recorded image.

        Args:
            image_HW: depth as stored, of any size.
            depth_4: its intrinsics; None for those of the colours, scaled to it.
            colours_4: intrinsics of the colour images that the episode is made for.
        """
        high, wide = image_HW.shape
        if depth_4 is None:
            scale = np.array([wide / self.source[0], high / self.source[1]])
            depth_4 = np.asarray(colours_4) * np.tile(scale, 2)
        own = turn_intrinsics(depth_4, (wide, high), self.turns)
        turned = np.rot90(image_HW, -self.turns)
        made = self.intrinsics(colours_4)
        rows, rows_in = _picked(made[1::2], own[1::2], self.target[1], turned.shape[0])
        columns, columns_in = _picked(made[::2], own[::2], self.target[0], turned.shape[1])
        found = turned[rows][:, columns]
        if not (rows_in.all() and columns_in.all()):
            found[~rows_in] = 0
            found[:, ~columns_in] = 0
        return np.ascontiguousarray(found)


def _picked(
    made_2: np.ndarray, own_2: np.ndarray, count: int, there: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the source pixel of each pixel along one axis, and whether it is in the source.

    ``made_2`` and ``own_2`` are focal length and centre of the target and of the source.
    """
    at = (np.arange(count) + 0.5 - made_2[1]) / made_2[0] * own_2[0] + own_2[1]
    index = np.floor(at + 1e-6).astype(int)
    return index.clip(0, there - 1), (index >= 0) & (index < there)


def turn_intrinsics(intrinsics_4: np.ndarray, size: tuple[int, int], turns: int) -> np.ndarray:
    """Return intrinsics (4,) of an image (width, height) after quarter turns clockwise."""
    fx, fy, cx, cy = (float(x) for x in intrinsics_4)
    width, height = size
    for _ in range(turns % 4):
        fx, fy, cx, cy = fy, fx, height - cy, cx
        width, height = height, width
    return np.array([fx, fy, cx, cy])


def turn_poses(pose_T44: np.ndarray, turns: int) -> np.ndarray:
    """Return camera-to-world poses (T, 4, 4) of images after quarter turns clockwise."""
    quarter = np.eye(4)
    quarter[:2, :2] = [[0, 1], [-1, 0]]  # the new right is the old up
    return pose_T44 @ np.linalg.matrix_power(quarter, turns % 4)


def turns_upright(pose_T44: np.ndarray) -> int:
    """Return the quarter turns clockwise after which cameras in a z-up world are upright.

    ``pose_T44``: camera-to-world, OpenCV axes. 0 if they look so steeply up or down that no side
    of the image is up.
    """
    up_T3 = pose_T44[np.isfinite(pose_T44).all((1, 2))][:, 2, :3]  # the world's z in the cameras
    if not len(up_T3):
        return 0
    x, y = np.median(up_T3[:, 0]), np.median(up_T3[:, 1])
    if np.hypot(x, y) < 0.2:
        return 0
    # Up is −y in an upright image; if it is −x, to the left, one turn clockwise brings it there.
    return int(np.round(np.arctan2(-x, -y) / (np.pi / 2))) % 4


def resampled(image_HWC: np.ndarray, own_4: np.ndarray, wanted_4: np.ndarray) -> np.ndarray:
    """Return an image as a camera of the same size with other intrinsics sees it; black outside."""
    own_4, wanted_4 = np.asarray(own_4, float), np.asarray(wanted_4, float)
    scale = wanted_4[:2] / own_4[:2]
    shift = wanted_4[2:] - 0.5 - (own_4[2:] - 0.5) * scale
    matrix = np.array([[scale[0], 0, shift[0]], [0, scale[1], shift[1]]])
    size = (image_HWC.shape[1], image_HWC.shape[0])
    return cv2.warpAffine(image_HWC, matrix, size, flags=cv2.INTER_LINEAR)
