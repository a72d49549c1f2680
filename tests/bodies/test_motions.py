"""Motions of the humanoid: inside its limits, smooth, and along the walk."""

import numpy as np
import pytest

from pewm_jax.bodies import motions
from pewm_jax.bodies.humanoid import HUMANOID
from pewm_jax.bodies.kinematics import advance, walking

ARMS = slice(6, 20)


def walk(frames, seed):
    """A walk of steps and turns, one after the other."""
    rng = np.random.default_rng(seed)
    planar = [np.array([0.0, 0.0, 0.5])]
    for _ in range(frames - 1):
        planar.append(advance(planar[-1], [(0.12, 0), (0, 0.17), (0, -0.17)][rng.integers(3)]))
    return np.stack(planar)


@pytest.mark.parametrize("seed", range(3))
def test_states_are_inside_the_limits_smooth_and_along_the_walk(seed):
    planar = walk(80, seed)
    state = motions.motion(HUMANOID, planar, np.random.default_rng(seed))
    assert state.shape == (80, 25)
    assert (state >= HUMANOID.low).all()
    assert (state <= HUMANOID.high).all()
    assert (np.abs(np.diff(state[:, :-2], axis=0)) <= HUMANOID.fastest[:-2]).all()
    np.testing.assert_array_equal(state[:, -2:], walking(planar))
    assert np.ptp(state[:, ARMS], axis=0).max() > 0.5
    again = motions.motion(HUMANOID, planar, np.random.default_rng(seed))
    np.testing.assert_array_equal(state, again)
    other = motions.motion(HUMANOID, planar, np.random.default_rng(seed + 9))
    assert np.abs(other - state)[:, ARMS].max() > 0.5


@pytest.mark.parametrize("frames", [5, 33, 96])
def test_pauses_repeat_frames_of_the_walk(frames):
    planar = walk(motions.walked(frames), 4)
    paused, source = motions.with_pauses(planar, frames, np.random.default_rng(0))
    assert len(paused) == len(source) == frames
    np.testing.assert_array_equal(paused, planar[source])
    assert np.isin(np.diff(source), (0, 1)).all()
    assert source[0] == 0
    assert source[-1] == len(planar) - 1
    standing = (np.diff(source) == 0).sum()
    assert standing == frames - motions.walked(frames)
