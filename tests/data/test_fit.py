"""Images keep their aspect ratio, and intrinsics say where every pixel came from."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.data.fit import Fit, resampled, turn_intrinsics, turn_poses, turns_upright
from pewm_jax.geometry.cameras import pose_from_yaw
from tests.data.two_rooms import box_views

SIDES = st.integers(12, 60)


@given(
    source=st.tuples(SIDES, SIDES),
    size=st.tuples(SIDES, SIDES),
    way=st.sampled_from(["crop", "letterbox"]),
    turns=st.integers(0, 3),
)
def test_pixels_stay_square_and_boxes_inside(source, size, way, turns):
    fit = Fit(source, size, way, turns)
    fx, fy, _, _ = fit.intrinsics(np.array([20.0, 20.0, source[0] / 2, source[1] / 2]))
    (left, top, broad, tall), (x, y, width, height) = fit.boxes
    assert fx / fy == pytest.approx(1, abs=1 / min(broad, tall, width, height))
    assert min(left, top, x, y) >= 0
    assert left + broad <= fit.turned[0]
    assert top + tall <= fit.turned[1]
    assert x + width <= size[0]
    assert y + height <= size[1]
    if way == "crop":
        assert (x, y, width, height) == (0, 0, *size)
        assert broad == fit.turned[0] or tall == fit.turned[1]
    else:
        assert (left, top, broad, tall) == (0, 0, *fit.turned)
        assert width == size[0] or height == size[1]


@pytest.mark.parametrize("way", ["crop", "letterbox"])
@pytest.mark.parametrize(("source", "size"), [((64, 48), (32, 32)), ((48, 64), (32, 24))])
@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_a_fitted_view_is_what_the_fitted_camera_sees(way, source, size, turns):
    pose = pose_from_yaw(np.array([2.0, 2.0, 1.2]), 0.7, 0.1)[None]
    own = np.array([40.0, 41.0, source[0] / 2 + 1, source[1] / 2 - 2])
    rgb, depth = box_views(pose, own, *source[::-1])
    fit = Fit(source, size, way, turns)
    made = fit.intrinsics(own)
    expected_rgb, expected = box_views(turn_poses(pose, turns), made, *size[::-1])
    inside = np.zeros(expected[0].shape, bool)
    x, y, width, height = fit.boxes[1]
    inside[y : y + height, x : x + width] = True
    found = fit.depth(depth[0], None, own)
    assert not found[~inside].any()
    assert not fit.colours(rgb[0])[~inside].any()
    near = np.abs(found - expected[0])[inside]
    assert np.median(near) < 0.04  # a picked pixel lies up to half of its size away
    error = np.abs(fit.colours(rgb[0]).astype(float) - expected_rgb[0])[inside]
    assert np.median(error) < 3
    whole = {"source": (8 * source[0], 8 * source[1]), "size": size, "way": way, "turns": turns}
    fine_4 = own * 8
    _, fine = box_views(pose, fine_4, *whole["source"][::-1])
    close = np.abs(Fit(**whole).depth(fine[0], None, fine_4) - expected[0])[inside]
    assert np.median(close) < 0.006  # finer source pixels lie nearer to the target's centres


def test_without_a_size_nothing_changes():
    image = np.random.default_rng(0).integers(0, 255, (7, 9, 3), np.uint8)
    fit = Fit((9, 7))
    np.testing.assert_array_equal(fit.colours(image), image)
    own = np.array([8.0, 8.5, 4.4, 3.6])
    np.testing.assert_array_equal(fit.depth(image[..., 0], None, own), image[..., 0])
    np.testing.assert_array_equal(fit.intrinsics(own), own)


def test_a_depth_image_of_another_size_is_taken_by_its_own_intrinsics():
    pose = pose_from_yaw(np.array([2.0, 2.0, 1.2]), 0.7)[None]
    own, deep = np.array([40.0, 40.0, 32.0, 24.0]), np.array([170.0, 160.0, 130.0, 90.0])
    _, depth = box_views(pose, deep, 192, 256)
    _, expected = box_views(pose, own, 48, 64)
    found = Fit((64, 48)).depth(depth[0], deep, own)
    seen = found > 0
    assert seen.mean() > 0.9
    assert np.median(np.abs(found - expected[0])[seen]) < 0.01


@pytest.mark.parametrize("turns", range(4))
def test_turning_moves_every_point_with_its_pixel(turns):
    image = np.arange(12.0).reshape(3, 4)
    pose, focal = pose_from_yaw(np.zeros(3), 0.4, 0.2)[None], np.array([3.0, 2.5, 2.2, 1.4])
    point = np.array([2.0, 0.9, 0.3, 1.0])

    def seen(k):
        x, y, z, _ = np.linalg.inv(turn_poses(pose, k)[0]) @ point
        fx, fy, cx, cy = turn_intrinsics(focal, (4, 3), k)
        return np.array([fx * x / z + cx, fy * y / z + cy])

    (u, v), (du, dv) = seen(0), seen(turns)
    assert np.rot90(image, -turns)[int(dv), int(du)] == image[int(v), int(u)]


@pytest.mark.parametrize("turns", range(4))
def test_an_upright_turn_is_found_from_the_poses(turns):
    level = np.stack([pose_from_yaw(np.zeros(3), yaw, 0.3) for yaw in (0.0, 1.0, 2.0)])
    lost = np.full((1, 4, 4), np.nan)
    sideways = turn_poses(np.concatenate([level, lost]), -turns % 4)
    assert turns_upright(sideways) == turns
    assert turns_upright(lost) == 0


def test_resampling_to_another_camera_moves_pixels_as_its_intrinsics_say():
    pose = pose_from_yaw(np.array([2.0, 2.0, 1.2]), 0.7)[None]
    own, other = np.array([40.0, 40.0, 32.0, 24.0]), np.array([42.0, 41.5, 31.0, 24.5])
    rgb, _ = box_views(pose, own, 48, 64)
    expected, _ = box_views(pose, other, 48, 64)
    found = resampled(rgb[0], own, other)[3:-3, 3:-3]
    assert np.abs(found.astype(float) - expected[0, 3:-3, 3:-3]).mean() < 1.5
