import math

import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pewm_jax.config import ActionConfig
from pewm_jax.geometry import actions, cameras

START = cameras.pose_from_yaw(np.array([1.0, -2.0, 1.25]), 0.7)


@settings(max_examples=20, deadline=None)
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
