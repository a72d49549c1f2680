import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import worlds
from pewm_jax.config import UserError
from pewm_jax.geometry import actions as action_geometry
from pewm_jax.memory import interface as memories
from pewm_jax.memory import voxel_map
from pewm_jax.types import Frames
from pewm_jax.worlds import rollouts
from tests.helpers import random_frames, random_world, tiny_config

CONFIG = tiny_config()
MODEL = CONFIG.model
ACTIONS = jnp.asarray([0, 0, 1, 0, 2, 0, 0, 1])
KEY = jax.random.key(1)


@pytest.fixture(scope="module")
def params():
    return random_world(CONFIG)


def a_state(params, seed=0, count=3):
    return worlds.start(CONFIG, params, random_frames(np.random.default_rng(seed), count))


@pytest.fixture(scope="module")
def rolled(params):
    """A state, the world after ``ACTIONS``, and the frames."""
    state = a_state(params)
    return state, *rollouts.rollout(CONFIG, params, state, ACTIONS, KEY)


def test_frames_come_one_per_action_along_the_integrated_poses(rolled):
    state, after, frames = rolled
    assert frames.rgb_THWC.shape == (8, 16, 24, 3)
    assert frames.depth_THW.shape == (8, 16, 24)
    moves = action_geometry.continuous(MODEL.actions, ACTIONS)
    poses = action_geometry.integrate(state.frame.camera.world_from_camera[0], moves)
    np.testing.assert_allclose(frames.camera.world_from_camera, poses[1:], atol=1e-5)
    np.testing.assert_array_equal(after.frame.rgb_THWC[0], frames.rgb_THWC[-1])
    assert float(jnp.abs(frames.rgb_THWC).max()) <= 1


@pytest.mark.slow
def test_discrete_and_continuous_actions_agree(params):
    state, actions = a_state(params), jnp.concatenate([ACTIONS, ACTIONS[::-1]])
    moves = action_geometry.continuous(MODEL.actions, actions)
    _, by_name = rollouts.rollout(CONFIG, params, state, actions, KEY)
    _, by_number = rollouts.rollout(CONFIG, params, state, moves, KEY)
    np.testing.assert_array_equal(by_name.rgb_THWC, by_number.rgb_THWC)


def test_imagined_frames_enter_the_map_as_observed_ones_where_they_are_trusted(rolled):
    state, after, frames = rolled

    @jax.jit
    def inserted(memory, frames):
        features = MODEL.memory.encoder.encode({}, frames.rgb_THWC)
        trusted = memories.trusted(MODEL, frames)
        return voxel_map.insert_frames(MODEL.memory, memory, trusted, features)

    expected = inserted(state.map, frames)
    for name in ("cell_of_slot_V", "features_VF", "occupied"):
        np.testing.assert_array_equal(getattr(after.map, name), getattr(expected, name))
    assert int(after.map.occupied) > int(state.map.occupied)


def test_the_map_changes_what_is_imagined_unless_ignored(params, rolled):
    state, _, with_map = rolled
    emptied = dataclasses.replace(state, map=voxel_map.empty(MODEL.memory, state.map.origin_3, 6))
    _, ignored = rollouts.rollout(CONFIG, params, state, ACTIONS, KEY, memory=False)
    _, without = rollouts.rollout(CONFIG, params, emptied, ACTIONS, KEY)
    np.testing.assert_array_equal(ignored.rgb_THWC, without.rgb_THWC)
    assert float(jnp.abs(with_map.rgb_THWC - ignored.rgb_THWC).max()) > 1e-3


@pytest.mark.slow
def test_rollout_is_a_pure_function_of_its_arguments_and_vmaps(params):
    states = [a_state(params, s) for s in range(2)]
    keys = jax.random.split(jax.random.key(5), 2)
    plans = jnp.stack([ACTIONS, ACTIONS[::-1]])
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *states)
    many = jax.jit(jax.vmap(lambda s, a, k: rollouts.rollout(CONFIG, params, s, a, k)))
    _, both = many(stacked, plans, keys)
    for i in range(2):
        _, one = rollouts.rollout(CONFIG, params, states[i], plans[i], keys[i])
        np.testing.assert_allclose(both.rgb_THWC[i], one.rgb_THWC, atol=2e-3)
        _, again = rollouts.rollout(CONFIG, params, states[i], plans[i], keys[i])
        np.testing.assert_array_equal(again.rgb_THWC, one.rgb_THWC)


def test_start_takes_bytes_or_floats_and_remembers_every_frame(params):
    frames = random_frames(np.random.default_rng(0), 3)
    floats = Frames(frames.rgb_THWC / np.float32(127.5) - 1, frames.depth_THW, frames.camera)
    a, b = (worlds.start(CONFIG, params, f) for f in (frames, floats))
    np.testing.assert_allclose(a.map.features_VF, b.map.features_VF, atol=1e-6)
    last = jax.tree.map(lambda x: x[-1:], frames)
    assert int(a.map.occupied) > int(worlds.start(CONFIG, params, last).map.occupied)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda f: jax.tree.map(lambda x: x[:0], f), "S ≥ 1"),
        (lambda f: dataclasses.replace(f, depth_THW=f.depth_THW[:, :8]), "resize the frames"),
        (lambda f: dataclasses.replace(f, camera=jax.tree.map(lambda x: x[:1], f.camera)), "poses"),
    ],
)
def test_start_refuses_frames_that_do_not_fit(params, change, sentence):
    with pytest.raises(UserError, match=sentence):
        worlds.start(CONFIG, params, change(random_frames(np.random.default_rng(0), 2)))


@pytest.mark.parametrize("actions", [jnp.zeros((0,), int), jnp.zeros((0, 3)), jnp.zeros((8, 2))])
def test_rollout_refuses_what_are_no_actions(params, actions):
    with pytest.raises(UserError, match=r"give at least one|dx, dy, dyaw"):
        rollouts.rollout(CONFIG, params, a_state(params), actions, jax.random.key(0))


@pytest.mark.slow(only="uint8")
@pytest.mark.parametrize("kind", ["list", "int64", "uint8"])
def test_lists_and_numpy_arrays_are_actions_too(params, rolled, kind):
    state, _, expected = rolled
    given = ACTIONS.tolist() if kind == "list" else np.asarray(ACTIONS, kind)
    got = rollouts.rollout(CONFIG, params, state, given, KEY)[1]
    np.testing.assert_array_equal(got.rgb_THWC, expected.rgb_THWC)


@pytest.mark.parametrize("wrong", [3, -1])
def test_rollout_refuses_discrete_actions_that_do_not_exist(params, wrong):
    with pytest.raises(UserError, match=rf"discrete actions \[{wrong}\]; the 3 actions are 0 f"):
        rollouts.rollout(CONFIG, params, a_state(params), [0] * 7 + [wrong], jax.random.key(0))
