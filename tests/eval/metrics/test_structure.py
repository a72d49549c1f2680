"""SCS: identical masks, shifts computed by hand, what is dropped, and a known distortion."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from pewm_jax.config import UserError
from pewm_jax.data.episodes import read_episode
from pewm_jax.data.make_episode import CollectConfig, house_seed, make_episode
from pewm_jax.data.render import render
from pewm_jax.data.scenes import house
from pewm_jax.eval.metrics import structure
from pewm_jax.eval.metrics.structure import (
    average,
    first_visible,
    frames_in_view,
    object_ids,
    object_masks,
    overlaps,
    scs,
    structural_consistency,
)
from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw
from pewm_jax.houses.kinds import SHELL, kind_of
from pewm_jax.types import Camera

EVER = np.ones(9, bool)
"""Something that is first visible is visible ever after."""


def squares(frames=3, size=12, side=4, *, at=(2, 6)):
    """Masks of two things, each a square, that stand still."""
    masks = np.zeros((2, frames, size, size), bool)
    for thing, corner in enumerate(at):
        masks[thing, :, corner : corner + side, corner : corner + side] = True
    return masks


def test_identical_masks_score_100():
    assert scs(squares(), squares(), EVER[:3]) == 100


def test_a_shift_costs_what_the_overlap_says():
    true = squares()
    pred = true.copy()
    pred[0, 1] = np.roll(true[0, 1], 1, 1)  # 4 × 3 of 4 × 5 pixels: 0.6
    pred[1, 2] = np.roll(true[1, 2], 2, 1)  # 4 × 2 of 4 × 6 pixels: 1/3
    assert scs(pred, true, EVER[:3]) == pytest.approx(100 * (0.6 + 1 + 1 + 1 / 3) / 4)
    pred[:, 0] = False  # the observed frame does not count
    assert scs(pred, true, EVER[:3]) == pytest.approx(100 * (0.6 + 1 + 1 + 1 / 3) / 4)


def test_a_thing_that_is_gone_counts_only_where_it_should_be_or_is():
    true = squares()
    true[0, 2] = False
    pred = true.copy()
    assert scs(pred, true, EVER[:3]) == 100  # out of view in both: no pair
    pred[0, 2, 0, 0] = True
    assert scs(pred, true, EVER[:3]) == 75  # one of four


def test_frames_count_until_nothing_that_was_first_visible_is():
    true = squares(frames=6)
    visible = np.array([True, True, True, True, False, True])  # what comes back comes too late
    assert frames_in_view(visible) == 4
    assert frames_in_view(visible[:3]) == 3
    pred = true.copy()
    pred[:, 4:] = ~pred[:, 4:]
    assert scs(pred, true, visible) == 100
    assert scs(pred, true, EVER[:6]) < 100
    assert np.isnan(scs(true, true, ~visible))
    assert np.isnan(scs(true[:, :1], true[:, :1], visible[:1]))


def test_frames_count_after_all_things_have_left_while_a_wall_is_still_visible():
    true = squares(frames=6)
    true[:, 3:] = False  # both things are gone from frame 3 on
    wall = np.array([True] * 5 + [False])
    stuck = squares(frames=6)  # a model that never moves
    assert scs(stuck, true, wall) == 50  # right in two frames of four
    assert scs(true, true, wall) == 100
    np.testing.assert_array_equal(overlaps(stuck, true, wall)[0], [100, 100, 0, 0, np.nan])


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
        structural_consistency(walk([0, step, 2 * step, 3 * step])[0], truth, masks, EVER[:4])
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

    score = structural_consistency(blank, truth, masks, EVER[:2], oracle)
    assert (score.value, score.ceiling) == (0, 100)


def test_what_is_no_mask_and_no_clip_is_refused():
    with pytest.raises(UserError, match="cannot be compared"):
        scs(squares(), squares()[:1], EVER[:3])
    with pytest.raises(UserError, match="of bool"):
        scs(squares().astype(float), squares(), EVER[:3])
    with pytest.raises(UserError, match="one bool per frame"):
        scs(squares(), squares(), EVER[:2])
    truth, masks = walk([0, 1])
    with pytest.raises(UserError, match="does not fit masks of shape"):
        structural_consistency(truth[:1], truth, masks, EVER[:2])
    with pytest.raises(UserError, match="instance ids"):
        structure.object_masks(np.zeros((4, 4)))
    nowhere = Camera(np.ones((2, 4)), np.tile(np.eye(4), (2, 1, 1)))
    with pytest.raises(UserError, match="no measurement in its first frame"):
        first_visible(np.zeros((2, 4, 4)), nowhere)


SIZE = 24
TURN = 10


def reference(scene, camera, depth):
    """Return (T,) whether each frame shows a point that frame 0 shows, by a ray to every point."""
    fx, fy, cx, cy = np.asarray(camera.intrinsics_4[0], np.float64)
    height, width = depth.shape[1:]
    v, u = np.mgrid[:height, :width] + 0.5
    z = depth[0].astype(np.float64)
    known = z > 0
    points = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], -1)[known]
    poses = np.asarray(camera.world_from_camera, np.float64)
    points = points @ poses[0, :3, :3].T + poses[0, :3, 3]
    found = []
    for pose in poses:
        x, y, far = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        ahead = far > 1e-3
        column, row = (
            np.where(ahead, f * a / np.where(ahead, far, 1) + c, -1.0)
            for f, a, c in ((fx, x, cx), (fy, y, cy))
        )
        inside = ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        rays = points[inside] - pose[:3, 3]
        reach = np.linalg.norm(rays, axis=1)
        origins = np.tile(pose[:3, 3] - scene.centre_3, (len(rays), 1)).astype(np.float32)
        way = (rays / reach[:, None]).astype(np.float32)
        hit = scene.tracer.run(
            origins, way, dists=(reach - 0.02).astype(np.float32), query="OCCLUDED"
        )
        found.append(bool((hit < 0).any()))
    return np.array(found)


@pytest.fixture(scope="module")
def turn():
    """A made house seen from one place in turns of 10 degrees, with 90 degrees of view."""
    scene = house(3)
    x0, y0, x1, y1 = scene.metadata["rooms"][0]
    place = np.array([(x0 + x1) / 2, (y0 + y1) / 2, 1.25])
    poses = np.stack([pose_from_yaw(place, np.radians(40 + TURN * k)) for k in range(13)])
    intrinsics = intrinsics_from_fov(SIZE, SIZE, 90.0)
    camera = Camera(np.tile(intrinsics, (len(poses), 1)), poses.astype(np.float32))
    return scene, camera, render(scene, camera, SIZE, SIZE)


def test_walls_stay_visible_after_the_tracked_things_have_left_the_view(turn):
    scene, camera, seen = turn
    visible = first_visible(seen.depth_THW, camera)
    # The outermost pixel centres of a view of 90 degrees are 87.6 degrees apart.
    np.testing.assert_array_equal(visible, np.arange(13) * TURN < 87)
    np.testing.assert_array_equal(visible, reference(scene, camera, seen.depth_THW))
    things = object_ids({"objects": scene.objects})
    assert all(kind_of(scene.objects[thing]) not in SHELL for thing in things)
    masks = object_masks(seen.ids_THW, things)
    left = masks[~masks[:, 5:].any((1, 2, 3))]  # those that are gone from frame 5 on
    assert len(left) > 0
    end = frames_in_view(visible)
    assert end == 9
    stuck = np.repeat(left[:, :1], 13, 1)
    per_frame = average(overlaps(stuck, left, visible), 0)
    assert (per_frame[5 - 1 : end - 1] == 0).all()  # frame 0 has no score
    assert np.isnan(per_frame[end - 1 :]).all()
    assert scs(stuck, left, visible) < scs(stuck[:, :5], left[:, :5], visible[:5])
    assert scs(left, left, visible) == 100


@pytest.mark.parametrize("start", [0, 14, 30])
def test_what_is_first_visible_is_exact_on_a_recorded_walk_through_a_house(start):
    config = CollectConfig(Path("x"), frames=60, size=SIZE, ids=True, test_policy="follow")
    episode = read_episode(make_episode(config, "revisit", 1))
    scene = house(house_seed(config, "revisit", 1))
    assert episode.info["objects"] == list(scene.objects)
    frames = np.arange(start, 60)
    clip = episode.frames(frames)
    visible = first_visible(clip.depth_THW, clip.camera)
    np.testing.assert_array_equal(visible, reference(scene, clip.camera, clip.depth_THW))
    assert 1 < frames_in_view(visible) < len(frames)
