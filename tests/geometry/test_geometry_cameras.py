import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pewm_jax.geometry import cameras
from pewm_jax.types import Camera
from tests.helpers import random_camera, rigid


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_every_unprojected_pixel_projects_back_to_its_centre(seed):
    rng = np.random.default_rng(seed)
    camera = random_camera(rng, 3, 6, 8)
    depth = rng.uniform(0.3, 9, (3, 6, 8)).astype(np.float32)
    points = cameras.unproject(depth, camera)
    uv, z = cameras.project(points.reshape(3, -1, 3), camera)
    np.testing.assert_allclose(uv.reshape(3, 6, 8, 2)[0], cameras.pixel_grid(6, 8), atol=2e-3)
    np.testing.assert_allclose(z.reshape(3, 6, 8), depth, rtol=1e-4)


def test_pixel_centres_are_at_one_half():
    intrinsics = cameras.intrinsics_from_fov(4, 4, 90.0)
    rays = np.asarray(cameras.ray_directions(intrinsics, 4, 4))
    np.testing.assert_allclose(rays.sum((0, 1))[:2], 0, atol=1e-6)
    np.testing.assert_allclose(rays[0, 0], [-0.75, -0.75, 1])


def test_resized_intrinsics_see_the_same_directions():
    small = cameras.intrinsics_from_fov(4, 6, 70.0)
    large = cameras.resize_intrinsics(small, 2.0, 2.0)
    np.testing.assert_allclose(large, cameras.intrinsics_from_fov(8, 12, 70.0), rtol=1e-6)


def test_an_upright_camera_looks_where_its_yaw_says():
    pose = cameras.pose_from_yaw(np.array([1.0, 2.0, 3.0]), math.pi / 2, 0.0)
    point_ahead = np.array([[1.0, 4.0, 3.0]], np.float32)
    point_above_left = np.array([[0.5, 4.0, 3.5]], np.float32)
    camera = Camera(np.array([10, 10, 5, 5], np.float32), pose)
    uv, z = cameras.project(point_ahead, camera)
    np.testing.assert_allclose(uv, [[5, 5]], atol=1e-4)
    np.testing.assert_allclose(z, [2], atol=1e-5)
    uv, _ = cameras.project(point_above_left, camera)
    assert uv[0, 0] < 5, "left of the view axis is left in the image"
    assert uv[0, 1] < 5, "up in the world is up in the image"


@pytest.mark.parametrize("seed", range(3))
def test_inverse_and_relative_poses(seed):
    rng = np.random.default_rng(seed)
    motion = rigid(rng)
    np.testing.assert_allclose(cameras.invert_rigid(motion) @ motion, np.eye(4), atol=1e-5)
    camera = random_camera(rng, 4)
    relative = cameras.relative_to_first(camera)
    np.testing.assert_allclose(relative.world_from_camera[0], np.eye(4), atol=1e-5)
    moved = Camera(camera.intrinsics_4, motion @ camera.world_from_camera)
    again = cameras.relative_to_first(moved)
    np.testing.assert_allclose(again.world_from_camera, relative.world_from_camera, atol=1e-5)
