"""SCS: identical masks, shifts computed by hand, what is dropped, and a known distortion."""

import cv2
import numpy as np
import pytest

from pewm_jax.config import UserError
from pewm_jax.evaluation.metrics import structure
from pewm_jax.evaluation.metrics.structure import (
    frames_in_view,
    object_masks,
    scs,
    structural_consistency,
)


def squares(frames=3, size=12, side=4, *, at=(2, 6)):
    """Masks of two things, each a square, that stand still."""
    masks = np.zeros((2, frames, size, size), bool)
    for thing, corner in enumerate(at):
        masks[thing, :, corner : corner + side, corner : corner + side] = True
    return masks


def test_identical_masks_score_100():
    assert scs(squares(), squares()) == 100


def test_a_shift_costs_what_the_overlap_says():
    true = squares()
    pred = true.copy()
    pred[0, 1] = np.roll(true[0, 1], 1, 1)  # 4 × 3 of 4 × 5 pixels: 0.6
    pred[1, 2] = np.roll(true[1, 2], 2, 1)  # 4 × 2 of 4 × 6 pixels: 1/3
    assert scs(pred, true) == pytest.approx(100 * (0.6 + 1 + 1 + 1 / 3) / 4)
    pred[:, 0] = False  # the observed frame does not count
    assert scs(pred, true) == pytest.approx(100 * (0.6 + 1 + 1 + 1 / 3) / 4)


def test_a_thing_that_is_gone_counts_only_where_it_should_be_or_is():
    true = squares()
    true[0, 2] = False
    pred = true.copy()
    assert scs(pred, true) == 100  # out of view in both: no pair
    pred[0, 2, 0, 0] = True
    assert scs(pred, true) == 75  # one of four


def test_frames_after_everything_has_left_the_view_are_dropped():
    true = squares(frames=6)
    true[0, 2:] = False
    true[1, 3:] = False
    true[:, 5] = squares(frames=1)[:, 0]  # what comes back comes too late
    assert frames_in_view(true) == 3
    pred = true.copy()
    pred[:, 3:] = ~pred[:, 3:]
    assert scs(pred, true) == 100
    assert np.isnan(scs(true[:, :1], true[:, :1]))


def test_masks_are_of_the_things_that_the_first_frame_shows():
    ids = np.full((2, 10, 10), -1, np.int32)
    ids[:, :5] = 7
    ids[0, 9, 9] = 3  # a pixel
    ids[1, 6:] = 4  # only later
    masks = object_masks(ids, smallest=0.02)
    np.testing.assert_array_equal(masks, (ids == 7)[None])
    assert len(object_masks(ids, smallest=0.0)) == 2
    assert len(object_masks(ids, objects=[3, 4], smallest=0.0)) == 1


def walk(shifts, size=48):
    """A textured picture that moves to the left, and the exact masks of two things in it."""
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.uniform(0, 255, (size, 2 * size, 3)), (0, 0), 2)
    picture = np.uint8((picture - picture.min()) / np.ptp(picture) * 255)
    ids = np.full((size, 2 * size), -1, np.int32)
    ids[8:24, 16:32], ids[26:44, 26:46] = 0, 1
    video, marks = (
        np.stack([x[:, shift : shift + size] for shift in shifts]) for x in (picture, ids)
    )
    return video, object_masks(marks)


def test_the_more_a_clip_moves_otherwise_the_lower_it_scores():
    truth, masks = walk([0, 2, 4, 6])
    scores = [
        structural_consistency(walk([0, step, 2 * step, 3 * step])[0], truth, masks)
        for step in (2, 3, 4, 0)
    ]
    same, near, far, still = (score.value for score in scores)
    assert same == scores[0].ceiling == scores[2].ceiling > 90
    assert same > near + 3 > far + 6
    assert still < same - 6
    assert (scores[0].frames, scores[0].objects) == (3, 2)


def test_any_segmenter_will_do():
    truth, masks = walk([0, 1])
    blank = np.zeros_like(truth)

    def oracle(video, first):
        assert video.dtype == np.uint8
        np.testing.assert_array_equal(first, masks[:, 0])
        return masks if video.any() else np.zeros_like(masks)

    score = structural_consistency(blank, truth, masks, oracle)
    assert (score.value, score.ceiling) == (0, 100)


def test_what_is_no_mask_and_no_clip_is_refused():
    with pytest.raises(UserError, match="cannot be compared"):
        scs(squares(), squares()[:1])
    with pytest.raises(UserError, match="of bool"):
        scs(squares().astype(float), squares())
    truth, masks = walk([0, 1])
    with pytest.raises(UserError, match="has no masks of shape"):
        structural_consistency(truth[:1], truth, masks)
    with pytest.raises(UserError, match="instance ids"):
        structure.object_masks(np.zeros((4, 4)))
