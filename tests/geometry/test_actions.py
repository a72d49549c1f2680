"""Cameras in ten numbers, and steps from one to the next."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.config import ActionConfig
from pewm_jax.geometry import actions, cameras
from pewm_jax.geometry.actions import (
    CAMERA_NUMBERS,
    CAMERA_STEP_NUMBERS,
    camera_numbers,
    camera_steps_between,
    follow_camera_steps,
)
from pewm_jax.types import Camera
from tests.properties import examples

START = cameras.pose_from_yaw(np.array([1.0, -2.0, 1.25]), 0.7)


@examples(20)
@given(seed=st.integers(0, 10_000))
def test_actions_between_inverts_integrate(seed):
    rng = np.random.default_rng(seed)
    moves = rng.uniform([-1, -1, -3], [1, 1, 3], (7, 3)).astype(np.float32)
    poses = actions.integrate(START, moves)
    np.testing.assert_allclose(actions.actions_between(poses), moves, atol=2e-4)


def test_the_way_back_leads_through_the_same_poses():
    moves = np.random.default_rng(0).uniform([-1, -1, -3], [1, 1, 3], (5, 3)).astype(np.float32)
    both = actions.there_and_back(moves)
    assert both.shape == (10, 3)
    poses = actions.integrate(START, both)
    np.testing.assert_allclose(poses, poses[::-1], atol=1e-5)
    np.testing.assert_allclose(poses[:6], actions.integrate(START, moves), atol=1e-6)
    batch = actions.there_and_back(np.stack([moves, -moves]))
    np.testing.assert_allclose(batch[0], both, atol=1e-6)


def test_action_k_leads_from_frame_k_to_frame_k_plus_1():
    moves = jnp.zeros((4, 3)).at[2, 0].set(1.0)
    poses = np.asarray(actions.integrate(START, moves))
    moved = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=-1)
    np.testing.assert_allclose(moved, [0, 0, 1, 0], atol=1e-6)


def test_forward_goes_where_the_camera_looks_and_left_turns_left():
    table = actions.discrete_table(ActionConfig(step_m=0.5, turn_deg=90))
    poses = np.asarray(actions.integrate(cameras.pose_from_yaw(np.zeros(3), 0.0), table[[1, 0]]))
    np.testing.assert_allclose(poses[2, :3, 3], [0, 0.5, 0], atol=1e-6)
    np.testing.assert_allclose(actions.heading(poses[2]), math.pi / 2, atol=1e-6)


def test_the_agent_moves_first_and_turns_after():
    poses = np.asarray(
        actions.integrate(cameras.pose_from_yaw(np.zeros(3), 0.0), [[1.0, 0.0, math.pi / 2]])
    )
    np.testing.assert_allclose(poses[1, :3, 3], [1, 0, 0], atol=1e-6)


def test_twelve_turns_of_thirty_degrees_come_back():
    table = actions.discrete_table(ActionConfig())
    poses = actions.integrate(START, table[[1] * 12])
    np.testing.assert_allclose(poses[-1], START, atol=1e-5)


def test_discrete_actions_are_rows_of_the_table():
    config = ActionConfig()
    moves = actions.continuous(config, jnp.array([0, 1, 2]))
    np.testing.assert_allclose(moves, actions.discrete_table(config))
    floats = jnp.ones((2, 3))
    np.testing.assert_array_equal(actions.continuous(config, floats), floats)


def looking(seed, count=6):
    """Return upright cameras with some pitch and several fields of view."""
    rng = np.random.default_rng(seed)
    poses = [
        cameras.pose_from_yaw(rng.uniform(-3, 3, 3), rng.uniform(-3, 3), rng.uniform(-1, 1))
        for _ in range(count)
    ]
    views = [cameras.intrinsics_from_fov(24, 32, rng.uniform(50, 110)) for _ in range(count)]
    return Camera(np.stack(views), np.stack(poses))


def test_following_the_steps_between_cameras_leads_to_them():
    before, after = looking(0), looking(1)
    step = jax.jit(camera_steps_between, static_argnums=2)(before, after, 32)
    assert step.shape == (6, CAMERA_STEP_NUMBERS)
    made = jax.jit(follow_camera_steps, static_argnums=2)(before, step, 32)
    np.testing.assert_allclose(made.world_from_camera, after.world_from_camera, atol=1e-5)
    np.testing.assert_allclose(made.intrinsics_4, after.intrinsics_4, rtol=1e-5)


def test_a_step_of_a_walk_is_the_planar_action():
    action = np.array([[0.25, -0.1, 0.5]], np.float32)
    poses = actions.integrate(cameras.pose_from_yaw(np.array([1, 2, 1.5]), 2.0, 0.3), action)
    camera = Camera(np.tile(cameras.intrinsics_from_fov(24, 32, 90), (2, 1)), poses)
    first, second = (jax.tree.map(lambda x, i=i: x[i], camera) for i in range(2))
    step = camera_steps_between(first, second, 32)
    np.testing.assert_allclose(step, [0.25, -0.1, 0, 0, 0.5, 0], atol=1e-6)


def test_the_numbers_are_rotation_place_in_the_grid_and_field_of_view():
    camera = looking(2)
    middle = np.random.default_rng(3).normal(size=(6, 3)).astype(np.float32)
    numbers = np.asarray(camera_numbers(camera, 32, middle))
    assert numbers.shape == (6, CAMERA_NUMBERS)
    pose = camera.world_from_camera
    across = np.cross(numbers[:, :3], numbers[:, 3:6])  # two columns are the whole rotation
    np.testing.assert_allclose(across, pose[:, :3, 0], atol=1e-5)
    np.testing.assert_allclose(numbers[:, 6:9] + middle, pose[:, :3, 3], atol=1e-6)
    focal = 16 / np.tan(numbers[:, 9] / 2)
    np.testing.assert_allclose(focal, camera.intrinsics_4[:, 0], rtol=1e-5)
    moved = Camera(camera.intrinsics_4, pose + np.eye(4, k=3) * 5)
    same = camera_numbers(moved, 32, middle + np.array([5, 0, 0]))
    np.testing.assert_allclose(same, numbers, atol=1e-5)
