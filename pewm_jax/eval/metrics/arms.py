"""Arms of a humanoid in pictures: masks by colour, and IoU of those with exact masks.

The arms and hands of ``bodies.humanoid`` have one saturated hue between red and blue. Pixels of
this hue whose red and blue exceed green by a share of the larger one form regions, and a region
counts if one of its pixels is nearly as saturated as the arms are. So shadows do not matter,
blurred edges of an arm count, and walls and furniture of a similar but paler hue do not. No network
is involved. The mask of the true clip is exact, from the renderer's instance ids
(``bodies.humanoid.arm_ids``), and the score of the true clip by colour is reported as the ceiling.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.types import Array

SATURATED, PALEST = 0.7, 0.5
"""Smallest excess of red and blue over green, as a share of the larger of red and blue: of one
pixel of a region, and of all its pixels."""
ALIKE, MOST_ALIKE = 0.75, 0.85
"""Smallest ratio of red and blue: of all pixels of a region, and of one."""
DARKEST = 30
"""Smallest value of red and blue, of 255."""
SMALLEST = 0.003
"""Share of a frame's pixels below which the true arms are not counted as visible."""


def arms_by_colour(rgb_HWC: Array) -> np.ndarray:
    """Return (..., H, W) bool, whether each pixel has the colour of the arms.

    Args:
        rgb_HWC: (..., H, W, 3) colours, uint8.

    Raises:
        UserError: the colours have another type or shape.
    """
    rgb = np.asarray(rgb_HWC)
    if rgb.dtype != np.uint8 or rgb.shape[-1:] != (3,):
        raise UserError(
            f"colours of shape {rgb.shape} and type {rgb.dtype}: give uint8 with 3 channels last."
        )
    red, green, blue = np.moveaxis(rgb.astype(np.float32), -1, 0)
    high, low = np.maximum(red, blue), np.minimum(red, blue)
    pale = (low - green > PALEST * high) & (low > ALIKE * high) & (high > DARKEST)
    sure = pale & (low - green > SATURATED * high) & (low > MOST_ALIKE * high)
    return _regions_with(pale, sure)


def _regions_with(within: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """Return the connected regions of each image (..., H, W) that contain a seed."""
    shape = within.shape
    kept = np.zeros((math.prod(shape[:-2]), *shape[-2:]), bool)
    pairs = zip(within.reshape(kept.shape), seeds.reshape(kept.shape), strict=True)
    for image, (inside, seed) in zip(kept, pairs, strict=True):
        _, regions = cv2.connectedComponents(inside.astype(np.uint8), connectivity=4)
        image[:] = inside & np.isin(regions, np.unique(regions[seed]))
    return kept.reshape(shape)


def arms_iou(found_THW: Array, true_THW: Array, smallest: float = SMALLEST) -> np.ndarray:
    """Return (T,) float64 IoU of two masks in each frame; NaN where the true arms are not visible.

    Args:
        found_THW: (T, H, W) bool, as from ``arms_by_colour``.
        true_THW: (T, H, W) bool, exact masks.
        smallest: smallest share of a frame's pixels of visible arms.

    Raises:
        UserError: the masks differ in shape or are not masks.
    """
    found, true = np.asarray(found_THW), np.asarray(true_THW)
    if found.shape != true.shape or found.ndim != 3 or found.dtype != true.dtype != np.bool_:
        raise UserError(
            f"masks of shapes {found.shape} and {true.shape} and types {found.dtype} and "
            f"{true.dtype} cannot be compared: give both as (T, H, W) of bool."
        )
    both, either = (op(found, true).sum((1, 2)) for op in (np.logical_and, np.logical_or))
    visible = true.mean((1, 2)) >= smallest
    return np.where(visible, both / np.maximum(either, 1), np.nan)
