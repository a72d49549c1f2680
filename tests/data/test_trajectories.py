"""Walks: actions and poses agree with the geometry chapter, and nobody walks through walls."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from pewm_jax.config import ActionConfig, UserError
from pewm_jax.data.navigation import NavGrid, is_free
from pewm_jax.data.trajectories import make_trajectory
from pewm_jax.geometry.actions import actions_between, discrete_table, integrate
from tests.data.two_rooms import two_rooms
from tests.properties import examples

GRID = two_rooms()


def walk(seed=0, frames=96, **options):
    actions = options.pop("actions", ActionConfig())
    return make_trajectory(GRID, actions, frames, np.random.default_rng(seed), **options)


def longest_blocked(start, end):
    """Metres of the longest piece of a straight way that lies in cells that are not free."""
    count = 2 + int(np.linalg.norm(end - start) / 1e-3)
    free = is_free(GRID, start + np.linspace(0, 1, count)[:, None] * (end - start))
    runs = np.diff(np.flatnonzero(np.concatenate([[True], free, [True]]))) - 1
    return runs.max() * np.linalg.norm(end - start) / (count - 1)


@example(seed=1512, policy="follow", continuous=False)  # grazes a corner
@examples(30)
@given(
    seed=st.integers(0, 10_000),
    policy=st.sampled_from(["follow", "walk", "revisit"]),
    continuous=st.booleans(),
)
def test_every_walk_is_integrable_and_never_passes_a_wall(seed, policy, continuous):
    made = walk(seed, policy=policy, continuous=continuous)
    assert made.planar_T3.shape == (96, 3)
    assert made.actions.shape == (95, 3)
    pose = made.world_from_camera(1.25)
    np.testing.assert_allclose(integrate(pose[0], made.actions), pose, atol=1e-4)
    np.testing.assert_allclose(actions_between(pose), made.actions, atol=1e-4)
    for start, end in zip(made.planar_T3[:-1, :2], made.planar_T3[1:, :2], strict=True):
        assert longest_blocked(start, end) <= 0.25 * GRID.cell_m, "at most a corner is grazed"
    if continuous:
        assert made.action_ids is None
        assert np.abs(made.actions[:, 0]).max() <= 0.25 + 1e-9 or policy == "revisit"
    else:
        table = discrete_table(ActionConfig())
        np.testing.assert_allclose(table[made.action_ids], made.actions, atol=1e-6)


def test_a_walk_is_a_function_of_its_seed():
    np.testing.assert_array_equal(walk(3).planar_T3, walk(3).planar_T3)
    assert not np.array_equal(walk(3).planar_T3, walk(4).planar_T3)


def test_the_follower_goes_through_the_door_and_back():
    """The follower visits both rooms; that is what it is for."""
    crossings = []
    for seed in range(10):
        left = walk(seed, frames=200, turn_around=0.0).planar_T3[:, 0] < 3.0
        crossings.append(int((left[1:] != left[:-1]).sum()))
    assert np.mean(np.array(crossings) >= 1) >= 0.9
    assert np.mean(crossings) >= 2


def test_the_walker_moves_far():
    spread = [np.ptp(walk(s, policy="walk").planar_T3[:, :2], axis=0).max() for s in range(10)]
    assert np.mean(spread) > 1.5


def test_the_turn_around_is_a_full_circle_on_the_spot():
    made = walk(5, turn_around=1.0)
    assert len(set(made.action_ids[:12])) == 1
    np.testing.assert_allclose(made.planar_T3[12, :2], made.planar_T3[0, :2], atol=1e-9)
    assert abs(abs(made.planar_T3[12, 2] - made.planar_T3[0, 2]) - 2 * math.pi) < 1e-9
    assert len(set(walk(5, turn_around=0.0).action_ids[:12])) > 1


@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_a_revisit_comes_back_over_the_same_places(seed, continuous):
    made = walk(seed, policy="revisit", continuous=continuous)
    turn = made.return_frame
    assert turn is not None
    assert 0.4 * 96 <= turn <= 0.6 * 96
    out, back = made.planar_T3[12 : turn + 1], made.planar_T3[turn + 6 :][: turn - 11]
    np.testing.assert_allclose(back[:, :2], out[::-1, :2], atol=1e-9)
    opposite = np.cos(back[:, 2] - out[::-1, 2])
    np.testing.assert_allclose(opposite, -1, atol=1e-9)
    assert np.linalg.norm(out[-1, :2] - out[0, :2]) > 1.0


def test_other_steps_and_angles_are_kept():
    made = walk(1, actions=ActionConfig(step_m=0.1, turn_deg=15.0))
    assert set(np.round(np.abs(made.actions).max(1), 6)) <= {0.1, round(math.radians(15), 6)}


@pytest.mark.parametrize("policy", ["follow", "walk", "revisit"])
@pytest.mark.parametrize("continuous", [False, True])
def test_in_a_closet_the_agent_only_turns(policy, continuous):
    """Where no step fits, every policy still ends, and stays inside."""
    free = np.zeros((9, 9), bool)
    free[4, 4] = True
    closet = NavGrid(free, np.zeros(2), 0.1, 0.0)
    rng = np.random.default_rng(0)
    made = make_trajectory(closet, ActionConfig(), 60, rng, policy=policy, continuous=continuous)
    assert np.ptp(made.planar_T3[:, :2], axis=0).max() < 0.1
    assert np.ptp(made.planar_T3[:, 2]) > 1.0


def test_what_cannot_be_walked_is_refused():
    with pytest.raises(UserError, match="too few for a revisit"):
        walk(0, frames=20, policy="revisit")
    with pytest.raises(UserError, match="divides 180"):
        walk(0, policy="revisit", actions=ActionConfig(turn_deg=50.0))
