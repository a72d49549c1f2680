"""Masks of arms by colour, and their IoU."""

import numpy as np
import pytest

from pewm_jax.config import UserError
from pewm_jax.eval.metrics.arms import arms_by_colour, arms_iou

ARM, PALE, OTHER = (140, 0, 140), (200, 90, 200), (120, 160, 60)


def image(*blocks):
    """A 16 × 16 picture of one colour with columns of others: (first, last, colour)."""
    rgb = np.full((16, 16, 3), OTHER, np.uint8)
    for first, last, colour in blocks:
        rgb[:, first:last] = colour
    return rgb


def test_arms_count_in_light_and_shade_and_pale_regions_do_not():
    for light in (0.4, 1.0, 1.6):
        found = arms_by_colour(image((3, 6, tuple(light * np.array(ARM))), (10, 13, PALE)))
        assert found[:, 3:6].all()
        assert found.sum() == 3 * 16


def test_blurred_edges_belong_to_the_arm_beside_them():
    found = arms_by_colour(image((3, 6, ARM), (6, 7, PALE), (10, 13, PALE)))
    assert found[:, 3:7].all()
    assert found.sum() == 4 * 16


def test_any_number_of_pictures():
    one = image((3, 6, ARM))
    stacked = arms_by_colour(np.stack([one, image()])[None])
    assert stacked.shape == (1, 2, 16, 16)
    np.testing.assert_array_equal(stacked[0, 0], arms_by_colour(one))
    assert not stacked[0, 1].any()
    with pytest.raises(UserError, match="give uint8"):
        arms_by_colour(one.astype(np.float32))


def test_iou_counts_frames_with_visible_arms():
    true = np.zeros((3, 16, 16), bool)
    true[0, :, :4] = true[1, :, :4] = True
    found = np.zeros_like(true)
    found[0, :, 2:6] = found[2] = True
    np.testing.assert_allclose(arms_iou(found, true), [2 / 6, 0, np.nan])
    with pytest.raises(UserError, match="cannot be compared"):
        arms_iou(found, true[:2])
