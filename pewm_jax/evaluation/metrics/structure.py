"""SCS, the structural consistency score: does each thing stay where it really is (EgoWM, Eq. 7)?

The mean over things and frames of IoU(mask in the imagined clip, mask in the true one), times 100
(arXiv 2601.15284). Frame 0 is the observed one: it says which things there are and does not count.
Frames from the first on in which none of them is in view are dropped. A pair of masks that are both
empty does not count either: that a thing is out of view in both is no overlap.

Masks of the truth are exact, from a renderer's instance ids (``object_masks``). Those of an
imagined clip need a segmenter, a function ``(video_THWC, first_KHW) -> masks_KTHW`` that follows
the first frame's masks. The paper's is SAM 2. ``follow_by_flow`` is a stand-in without weights,
which follows pixels by optical flow: it loses things that the model redraws elsewhere, and its
scores are not to be compared with the paper's. So a score stands beside its ceiling, that of the
true clip through the same segmenter.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TypeAlias

import cv2
import numpy as np

from pewm_jax.config import UserError
from pewm_jax.types import Array

Segmenter: TypeAlias = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""``(video_THWC uint8, first_KHW bool) -> masks_KTHW bool``: follows K things through T frames."""

SMALLEST = 0.002
"""Share of the first frame's pixels below which a thing is not followed."""
RETURN = 1.5
"""Pixels by which flow there and back may miss its start; where it misses by more, pixels are new
or hidden, and belong to nothing."""


@dataclasses.dataclass(frozen=True)
class Structure:
    """SCS of one clip.

    Attributes:
        value: of the imagined clip; NaN where no frame or no thing counts.
        ceiling: of the true clip through the same segmenter.
        frames: frames that count.
        objects: things that are followed.
    """

    value: float
    ceiling: float
    frames: int
    objects: int


def scs(masks_pred_KTHW: Array, masks_true_KTHW: Array) -> float:
    """Return SCS of one clip, 0 … 100; NaN where nothing counts.

    Args:
        masks_pred_KTHW: (K, T, H, W) bool, K things in T imagined frames; frame 0 is the observed
            one, whose masks are not compared.
        masks_true_KTHW: the same in the true clip.

    Raises:
        UserError: the masks are not alike, or no masks.
    """
    pred, true = _masks(masks_pred_KTHW, masks_true_KTHW)
    end = frames_in_view(true)
    pred, true = pred[:, 1:end], true[:, 1:end]
    both = np.logical_and(pred, true).sum((2, 3))
    either = np.logical_or(pred, true).sum((2, 3))
    counted = either > 0
    if not counted.any():
        return float("nan")
    return float(100 * np.mean(both[counted] / either[counted]))


def frames_in_view(masks_true_KTHW: Array) -> int:
    """Return how many leading frames there are before all that was first visible has left the view.

    Args:
        masks_true_KTHW: (K, T, H, W) bool, of things visible in frame 0.
    """
    seen_T = np.asarray(masks_true_KTHW, bool).sum((0, 2, 3)) > 0
    gone = np.flatnonzero(~seen_T)
    return int(gone[0]) if gone.size else seen_T.size


def object_masks(
    ids_THW: np.ndarray, objects: Sequence[int] | None = None, smallest: float = SMALLEST
) -> np.ndarray:
    """Return (K, T, H, W) exact masks of the things in the first frame.

    Args:
        ids_THW: (T, H, W) instance ids, below 0 where there is nothing: ``ids_THW`` of
            ``data.render.render``.
        objects: ids of the things to follow, such as furniture without walls; None follows all.
        smallest: share of the first frame's pixels that a thing must have.

    Raises:
        UserError: no instance ids of frames.
    """
    ids = np.asarray(ids_THW)
    if ids.ndim != 3 or not np.issubdtype(ids.dtype, np.integer):
        raise UserError(
            f"instance ids of shape {ids.shape} and type {ids.dtype}: give whole numbers (T, H, W)."
        )
    found, pixels = np.unique(ids[0], return_counts=True)
    large = found[(pixels >= smallest * ids[0].size) & (found >= 0)]
    kept = large if objects is None else large[np.isin(large, objects)]
    return ids[None] == kept[:, None, None, None]


def structural_consistency(
    imagined_THWC: Array,
    truth_THWC: Array,
    masks_true_KTHW: Array,
    segment: Segmenter | None = None,
) -> Structure:
    """Return SCS of an imagined clip with its ceiling.

    Args:
        imagined_THWC: (T, H, W, 3) uint8; frame 0 is the observed one.
        truth_THWC: the true clip, the same shape.
        masks_true_KTHW: (K, T, H, W) exact masks of the true clip, such as ``object_masks``.
        segment: how masks are followed; by default ``follow_by_flow``, the stand-in.

    Raises:
        UserError: clips or masks that are not alike.
    """
    follow = follow_by_flow if segment is None else segment
    masks = np.asarray(masks_true_KTHW, bool)
    end = frames_in_view(masks)
    scores = []
    for video in (imagined_THWC, truth_THWC):
        frames = np.asarray(video)
        if frames.dtype != np.uint8 or frames.shape != (*masks.shape[1:], 3):
            raise UserError(
                f"a clip of shape {frames.shape} and type {frames.dtype} has no masks of shape "
                f"{masks.shape}: give uint8 colours (T, H, W, 3) and masks (K, T, H, W)."
            )
        scores.append(scs(follow(frames[:end], masks[:, 0]), masks[:, :end]))
    return Structure(scores[0], scores[1], max(end - 1, 0), len(masks))


def follow_by_flow(video_THWC: np.ndarray, first_KHW: np.ndarray) -> np.ndarray:
    """Follow masks by dense optical flow from frame to frame; a stand-in, and not SAM 2.

    Every pixel takes what the pixel that it comes from had in the frame before (dense inverse
    search, Kroeger et al. 2016). Pixels whose flow does not lead back belong to nothing. No weights
    are needed, and nothing is known of things: errors add up over frames.

    Args:
        video_THWC: (T, H, W, 3) uint8.
        first_KHW: (K, H, W) bool, masks of the first frame; where they overlap, the last counts.

    Returns:
        (K, T, H, W) bool.
    """
    frames, height, width = video_THWC.shape[:3]
    labels = np.zeros((frames, height, width), np.int32)
    for number, mask in enumerate(np.asarray(first_KHW, bool), 1):
        labels[0][mask] = number
    grey = [cv2.cvtColor(np.ascontiguousarray(frame), cv2.COLOR_RGB2GRAY) for frame in video_THWC]
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    for now in range(1, frames):
        back, forth = _flow(grey[now], grey[now - 1]), _flow(grey[now - 1], grey[now])
        x, y = columns + back[..., 0], rows + back[..., 1]
        there = cv2.remap(forth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        missed = np.hypot(*np.moveaxis(back + there, -1, 0))
        column, row = np.rint(x).astype(int), np.rint(y).astype(int)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        from_there = labels[now - 1][row.clip(0, height - 1), column.clip(0, width - 1)]
        labels[now] = np.where(inside & (missed <= RETURN), from_there, 0)
    return labels[None] == np.arange(1, len(first_KHW) + 1)[:, None, None, None]


def _flow(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return (H, W, 2) pixels, right and down, by which pixels of one picture move to the other."""
    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    method.setFinestScale(0)
    method.setPatchStride(2)
    return np.asarray(method.calc(one, other, np.zeros((*one.shape, 2), np.float32)))


def _masks(pred: Array, true: Array) -> tuple[np.ndarray, np.ndarray]:
    """Return two sets of masks.

    Raises:
        UserError: they are not alike, or no masks.
    """
    pair = np.asarray(pred), np.asarray(true)
    shapes = [masks.shape for masks in pair]
    if shapes[0] != shapes[1] or pair[0].ndim != 4 or any(x.dtype != np.bool_ for x in pair):
        raise UserError(
            f"masks of shapes {shapes[0]} and {shapes[1]} and types {pair[0].dtype} and "
            f"{pair[1].dtype} cannot be compared: give both as (K, T, H, W) of bool."
        )
    return pair
