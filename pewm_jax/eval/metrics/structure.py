"""SCS, the structural consistency score: whether objects are where they should be (EgoWM, Eq. 7).

The mean over objects and frames of IoU(mask in the imagined clip, mask in the true one), times 100
(arXiv 2601.15284). Frame 0 is the observed one: it defines the objects and is not counted. A pair
of empty masks is not counted either, because there is no overlap to measure.

The paper trims every sequence at the frame where all points visible in the first frame have left
the view, so that frames that show only new places are not counted. These points include walls,
floors and ceilings, which are not tracked objects. So an object that has left the view while a wall
of the first frame is still visible is still counted: a model that still shows it scores 0 there.
The paper finds the end with a point tracker. Here it is computed from depth and poses
(``first_visible``).

Masks of the ground truth are exact, from a renderer's instance ids (``object_masks``). Those of an
imagined clip need a segmenter, a function ``(video_THWC, first_KHW) -> masks_KTHW`` that propagates
the first frame's masks. The paper uses SAM 2. ``follow_by_flow`` is a substitute without weights
that tracks pixels by optical flow: it loses objects that the model redraws elsewhere, and its
scores are not comparable with the paper's. So each score is reported with its ceiling, the score of
the true clip with the same segmenter.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import UserError
from pewm_jax.eval.metrics.images import visible_in
from pewm_jax.geometry.cameras import unproject
from pewm_jax.houses.kinds import SHELL, kind_of
from pewm_jax.types import Array, Camera

Segmenter: TypeAlias = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""``(video_THWC uint8, first_KHW bool) -> masks_KTHW bool``: tracks K objects through T frames."""

SMALLEST = 0.002
"""Share of the first frame's pixels below which an object is not tracked."""
RETURN = 1.5
"""Largest forward-backward error of the flow, pixels; pixels above it are new or occluded and
belong to no object."""


@dataclasses.dataclass(frozen=True)
class Structure:
    """SCS of one clip.

    Attributes:
        value: score of the imagined clip; NaN if no frame or no object counts.
        ceiling: score of the true clip with the same segmenter.
        frames: number of imagined frames that count.
        objects: number of tracked objects.
    """

    value: float
    ceiling: float
    frames: int
    objects: int


@dataclasses.dataclass(frozen=True)
class Consistency:
    """SCS with a segmenter and its name, such as ``flow`` or ``sam2``.

    ``sha256`` is the hash of its weights; "" if it has none.
    """

    segment: Segmenter
    encoder: str
    sha256: str = ""

    @property
    def name(self) -> str:
        """Return the name including the segmenter, such as ``SCS[flow]``."""
        return f"SCS[{self.encoder}]"

    def __call__(self, video_THWC: Array, masks_true_KTHW: Array, visible_T: Array) -> np.ndarray:
        """Return ``overlaps`` of a uint8 clip with masks by the segmenter.

        Frame 0 of the clip is the observed one.

        Raises:
            UserError: the clip and the masks differ in shape.
        """
        masks, frames = np.asarray(masks_true_KTHW), np.asarray(video_THWC)
        if frames.dtype != np.uint8 or frames.shape != (*masks.shape[1:], 3):
            raise UserError(
                f"a clip of shape {frames.shape} and type {frames.dtype} does not fit masks of "
                f"shape {masks.shape}: give uint8 colours (T, H, W, 3) and masks (K, T, H, W)."
            )
        end = max(_end(visible_T, len(frames)), 1)
        found = np.zeros_like(masks)
        found[:, :end] = self.segment(frames[:end], masks[:, 0])
        return overlaps(found, masks, visible_T)


def scs(masks_pred_KTHW: Array, masks_true_KTHW: Array, visible_T: Array) -> float:
    """Return SCS of one clip, 0 … 100; NaN if nothing counts.

    Args:
        masks_pred_KTHW: (K, T, H, W) bool, K objects in T imagined frames; frame 0 is the observed
            one, whose masks are not compared.
        masks_true_KTHW: the same for the true clip.
        visible_T: (T,) bool, whether each frame still shows any surface point visible in frame 0
            (``first_visible``). Frames from the first False on are not counted.

    Raises:
        UserError: the masks differ in shape, are not masks, or the numbers of frames differ.
    """
    return float(average(overlaps(masks_pred_KTHW, masks_true_KTHW, visible_T)))


def overlaps(masks_pred_KTHW: Array, masks_true_KTHW: Array, visible_T: Array) -> np.ndarray:
    """Return (K, T - 1) float64, 100 × IoU of each object in each frame but the first.

    NaN where the frame is not counted, or the object is visible in neither clip. Arguments and
    errors are those of ``scs``.
    """
    pred, true = _masks(masks_pred_KTHW, masks_true_KTHW)
    end = _end(visible_T, true.shape[1])
    both = np.logical_and(pred, true).sum((2, 3))
    either = np.logical_or(pred, true).sum((2, 3))
    found = np.where(either > 0, 100 * both / np.maximum(either, 1), np.nan)
    found[:, end:] = np.nan
    return found[:, 1:]


def average(values: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Return the mean of the values that are not NaN; NaN if there is none."""
    known = np.isfinite(values)
    total, count = np.where(known, values, 0).sum(axis), known.sum(axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def frames_in_view(visible_T: Array) -> int:
    """Return the number of leading frames that show a point visible in frame 0."""
    gone = np.flatnonzero(~np.asarray(visible_T, bool))
    return int(gone[0]) if gone.size else len(np.asarray(visible_T))


def _end(visible_T: Array, frames: int) -> int:
    """Return ``frames_in_view``, or raise a ``UserError`` if it is not one bool per frame."""
    if np.shape(visible_T) != (frames,) or np.asarray(visible_T).dtype != np.bool_:
        raise UserError(
            f"visible_T of shape {np.shape(visible_T)} and type {np.asarray(visible_T).dtype} does "
            f"not fit {frames} frames: give one bool per frame that says whether it shows a point "
            "of the first, such as first_visible returns."
        )
    return frames_in_view(visible_T)


def first_visible(depth_THW: Array, camera: Camera) -> np.ndarray:
    """Return (T,) bool: whether each frame shows a surface point that frame 0 shows.

    The points of frame 0's pixels are projected into the other frames, with true z-depth (metres, 0
    = no measurement) and cameras. A point is visible if it lies inside the image and agrees with
    the depth there (``images.visible_in``), so occluded points do not count: a frame that shows
    none shows only new places.

    Raises:
        UserError: there are no frames, or the first has no depth.
    """
    depth = np.asarray(depth_THW, np.float32)
    if depth.ndim != 3 or not len(depth) or not (depth[0] > 0).any():
        raise UserError(
            f"depth of shape {depth.shape} has no measurement in its first frame: visibility "
            "is computed from depth (T, H, W) in metres, such as the renderer's."
        )
    return np.asarray(_first_visible(depth, camera))


@jax.jit
def _first_visible(depth_THW: Array, camera: Camera) -> Array:
    points = unproject(depth_THW[0], jax.tree.map(lambda x: x[0], camera)).reshape(-1, 3)

    def shows(frame: tuple[Array, Camera]) -> Array:
        return (visible_in(points, *frame) & (depth_THW[0].reshape(-1) > 0)).any()

    return jax.lax.map(shows, (depth_THW, jax.tree.map(jnp.asarray, camera)))


def object_ids(info: Mapping[str, Any]) -> list[int] | None:
    """Return the instance ids of an episode's static objects, or None if it has no names.

    ``objects`` of its metadata are the names of instances, by id. Walls, floors, ceilings, doorways
    and windows are not objects. Moving parts, such as robots and doors, have ids after those of the
    named objects and are not included either: the score is about apparent motion caused by the
    camera.
    """
    names = info.get("objects")
    return None if names is None else [i for i, n in enumerate(names) if kind_of(n) not in SHELL]


def object_masks(
    ids_THW: np.ndarray, objects: Sequence[int] | None = None, smallest: float = SMALLEST
) -> np.ndarray:
    """Return (K, T, H, W) exact masks of the objects in the first frame.

    Args:
        ids_THW: (T, H, W) instance ids, negative where there is nothing: ``ids_THW`` of
            ``data.render.render``.
        objects: ids of the objects to track, such as furniture without walls; None for all.
        smallest: smallest share of the first frame's pixels of an object.

    Raises:
        UserError: the array does not contain instance ids of frames.
    """
    ids = np.asarray(ids_THW)
    if ids.ndim != 3 or not np.issubdtype(ids.dtype, np.integer):
        raise UserError(
            f"instance ids of shape {ids.shape} and type {ids.dtype}: give integers (T, H, W)."
        )
    found, pixels = np.unique(ids[0], return_counts=True)
    large = found[(pixels >= smallest * ids[0].size) & (found >= 0)]
    kept = large if objects is None else large[np.isin(large, objects)]
    return ids[None] == kept[:, None, None, None]


def structural_consistency(
    imagined_THWC: Array,
    truth_THWC: Array,
    masks_true_KTHW: Array,
    visible_T: Array,
    segment: Segmenter | None = None,
) -> Structure:
    """Return SCS of an imagined clip with its ceiling.

    Args:
        imagined_THWC: (T, H, W, 3) uint8; frame 0 is the observed one.
        truth_THWC: the true clip, the same shape.
        masks_true_KTHW: exact masks of the true clip, as from ``object_masks``.
        visible_T: as for ``scs``, from ``first_visible``.
        segment: the segmenter; by default ``follow_by_flow``, the substitute.

    Raises:
        UserError: clips, masks or numbers of frames do not fit.
    """
    measure = Consistency(follow_by_flow if segment is None else segment, "")
    value, ceiling = (
        float(average(measure(video, masks_true_KTHW, visible_T)))
        for video in (imagined_THWC, truth_THWC)
    )
    counted = max(frames_in_view(visible_T) - 1, 0)
    return Structure(value, ceiling, counted, len(np.asarray(masks_true_KTHW)))


def follow_by_flow(video_THWC: np.ndarray, first_KHW: np.ndarray) -> np.ndarray:
    """Propagate masks by dense optical flow from frame to frame; a substitute for SAM 2.

    Every pixel gets the label of the pixel in the previous frame from which it comes (dense inverse
    search, Kroeger et al. 2016). Pixels that fail the forward-backward check belong to no object.
    It needs no weights and has no notion of objects: errors accumulate over frames. Where the first
    frame's masks overlap, the last one counts.
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
    """Return the (H, W, 2) flow from one image to the other, pixels right and down."""
    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    method.setFinestScale(0)
    method.setPatchStride(2)
    return np.asarray(method.calc(one, other, np.zeros((*one.shape, 2), np.float32)))


def _masks(pred: Array, true: Array) -> tuple[np.ndarray, np.ndarray]:
    """Return two sets of masks as arrays, or raise a ``UserError`` if they cannot be compared."""
    pair = np.asarray(pred), np.asarray(true)
    shapes = [masks.shape for masks in pair]
    if shapes[0] != shapes[1] or pair[0].ndim != 4 or any(x.dtype != np.bool_ for x in pair):
        raise UserError(
            f"masks of shapes {shapes[0]} and {shapes[1]} and types {pair[0].dtype} and "
            f"{pair[1].dtype} cannot be compared: give both as (K, T, H, W) of bool."
        )
    return pair
