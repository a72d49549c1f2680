"""Worlds are started, observed and imagined: any number of frames, by actions or by cameras."""

import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import worlds
from pewm_jax.config import Config, UserError
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.geometry import actions as action_geometry
from pewm_jax.memory import interface as memories
from pewm_jax.types import Camera, Control, Frames, WorldState
from tests import properties
from tests.helpers import TINY, random_camera, random_frames, random_world, tiny_model
from tests.memory.test_memories import KINDS, model_of

MODEL = tiny_model(
    clip=dataclasses.replace(TINY.clip, frames=5),
    backbone=dataclasses.replace(TINY.backbone, layers=1),
    noise=DDPMConfig(sample_steps=1),
)
LENGTH = 4
"""Frames of a clip that are imagined."""
KEY = jax.random.key(1)
MOVES = jnp.asarray(
    np.random.default_rng(4).uniform((-0.1, -0.1, -0.3), (0.4, 0.1, 0.3), (8, 3)), jnp.float32
)
MOVES = MOVES.at[LENGTH - 1].set(0)
"""Those of two clips; the first ends standing still."""
start, observe = (jax.jit(act, static_argnums=0) for act in (worlds.start, worlds.observe))
imagine = jax.jit(worlds.imagine, static_argnums=0, static_argnames=("remember", "memory"))


def equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.fixture(scope="module")
def params():
    return random_world(MODEL)


@functools.cache
def seen(seed=0, count=3):
    return jax.tree.map(jnp.asarray, random_frames(np.random.default_rng(seed), count))


@pytest.fixture(scope="module")
def state(params):
    return start(MODEL, params, seen())


@pytest.fixture(scope="module")
def two_clips(params, state):
    """The world after eight moves, and the frames."""
    return imagine(MODEL, params, state, MOVES, KEY)


def still(moves):
    """The moves of one clip, standing still after them."""
    return jnp.zeros((LENGTH, 3)).at[: len(moves)].set(moves)


@functools.partial(jax.jit, static_argnums=0)
def remembered(model, memory, frames):
    features = model.memory.encoder.encode({}, frames.rgb_THWC)
    return memories.insert(model, {}, memory, frames, features, observed=False)


@pytest.mark.slow(but="3")
@pytest.mark.parametrize("count", [1, LENGTH - 1, LENGTH, LENGTH + 2])
def test_as_many_frames_are_imagined_as_are_asked_for(params, state, two_clips, count):
    """A clip that is cut is that of standing still after the last move."""
    after, frames = imagine(MODEL, params, state, MOVES[:count], KEY)
    assert frames.rgb_THWC.shape == (count, 16, 24, 3)
    assert frames.depth_THW.shape == (count, 16, 24)
    poses = action_geometry.integrate(state.frame.camera.world_from_camera[0], MOVES[:count])
    np.testing.assert_allclose(frames.camera.world_from_camera, poses[1:], atol=1e-5)
    equal(after.frame, jax.tree.map(lambda x: x[-1:], frames))
    whole = count // LENGTH * LENGTH
    equal(frames.rgb_THWC[:whole], two_clips[1].rgb_THWC[:whole])
    if whole == 0:
        _, rest = two_clips
        if count < LENGTH - 1:
            _, rest = imagine(MODEL, params, state, still(MOVES[:count]), KEY)
        np.testing.assert_allclose(frames.rgb_THWC, rest.rgb_THWC[:count], atol=1e-5)
        np.testing.assert_allclose(frames.depth_THW, rest.depth_THW[:count], rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, LENGTH - 1, LENGTH + 2])
def test_only_what_was_asked_for_is_remembered(params, state, count):
    after, frames = imagine(MODEL, params, state, MOVES[:count], KEY)
    expected = remembered(MODEL, state.map, frames)
    equal(after.map.cell_of_slot_V, expected.cell_of_slot_V)
    np.testing.assert_allclose(after.map.features_VF, expected.features_VF, atol=1e-5)
    assert int(after.map.occupied) > int(state.map.occupied)
    assert int(after.map.outside) == int(expected.outside)


@pytest.mark.parametrize("kind", properties.first(KINDS, 1))
def test_every_memory_remembers_only_what_was_asked_for(kind):
    model = dataclasses.replace(MODEL, memory=model_of(kind).memory)
    params = random_world(model, memory=False)
    state = start(model, params, seen())
    after, frames = imagine(model, params, state, MOVES[:2], KEY)
    expected = remembered(model, state.map, frames)
    for a, b in zip(jax.tree.leaves(after.map), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)


@pytest.mark.slow
def test_cameras_steer_as_the_actions_that_lead_to_them(params, state, two_clips):
    after, frames = two_clips
    by_camera, seen_by = imagine(MODEL, params, state, frames.camera, KEY)
    np.testing.assert_allclose(seen_by.rgb_THWC, frames.rgb_THWC, atol=1e-4)
    equal(seen_by.camera, frames.camera)
    equal(by_camera.map.cell_of_slot_V, after.map.cell_of_slot_V)
    control = Control(frames.camera, MOVES)
    _, with_actions = imagine(MODEL, params, state, control, KEY)
    np.testing.assert_allclose(with_actions.rgb_THWC, seen_by.rgb_THWC, atol=1e-4)


@pytest.mark.slow
def test_cameras_have_six_degrees_of_freedom(params, state):
    rng = np.random.default_rng(0)
    camera = random_camera(rng, 6)
    turned = random_camera(rng, 1).world_from_camera[0, :3, :3]
    poses = np.array(camera.world_from_camera)
    poses[:, :3, :3] = poses[:, :3, :3] @ turned  # rolled, too
    camera = Camera(camera.intrinsics_4, poses)
    after, frames = imagine(MODEL, params, state, camera, KEY)
    equal(frames.camera, jax.tree.map(jnp.asarray, camera))
    equal(after.frame.camera.world_from_camera[0], poses[-1])
    assert np.isfinite(frames.rgb_THWC).all()
    expected = remembered(MODEL, state.map, frames)
    equal(after.map.cell_of_slot_V, expected.cell_of_slot_V)


def test_without_remembering_the_memory_stays_and_the_first_clip_is_the_same(
    params, state, two_clips
):
    after, frames = imagine(MODEL, params, state, MOVES, KEY, remember=False)
    equal(after.map, state.map)
    expected = two_clips[1]
    np.testing.assert_allclose(frames.rgb_THWC[:LENGTH], expected.rgb_THWC[:LENGTH], atol=1e-5)
    equal(after.frame, jax.tree.map(lambda x: x[-1:], frames))
    later = np.abs(frames.rgb_THWC[LENGTH:] - expected.rgb_THWC[LENGTH:]).max()
    assert later > 1e-4, "the second clip would have read the first"


def round_trip(count=3):
    """Frames of which the last stands where the first does, so that grids have one centre."""
    frames = seen(1, count)
    pose = frames.camera.world_from_camera
    camera = dataclasses.replace(frames.camera, world_from_camera=pose.at[-1].set(pose[0]))
    return dataclasses.replace(frames, camera=camera)


@pytest.mark.slow(but="voxel")
@pytest.mark.parametrize("kind", ["voxel", "map2d", "none"])
def test_observing_later_is_observing_at_the_start(params, kind):
    model = dataclasses.replace(MODEL, memory=model_of(kind).memory)
    frames = round_trip()
    first, rest = (jax.tree.map(lambda x, s=s: x[s], frames) for s in (slice(1), slice(1, None)))
    at_once = start(model, params, frames)
    later = observe(model, params, start(model, params, first), rest)
    equal(later.frame, at_once.frame)
    for a, b in zip(jax.tree.leaves(later.map), jax.tree.leaves(at_once.map), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


def test_what_is_observed_half_way_is_the_present_and_changes_what_is_imagined(params, two_clips):
    after, _ = two_clips
    real = seen(5, 2)
    there = observe(MODEL, params, after, real)
    equal(there.frame.depth_THW[0], real.depth_THW[-1])
    equal(there.frame.camera, jax.tree.map(lambda x: x[-1:], real.camera))
    assert int(there.map.occupied) > int(after.map.occupied)
    _, frames = imagine(MODEL, params, there, MOVES, KEY)
    poses = action_geometry.integrate(real.camera.world_from_camera[-1], MOVES)
    np.testing.assert_allclose(frames.camera.world_from_camera, poses[1:], atol=1e-5)


def test_observe_imagine_and_start_are_jitted_and_take_an_experiment_too(params, state):
    config = Config(model=MODEL)
    started = worlds.start(config, params, seen())
    for a, b in zip(jax.tree.leaves(started), jax.tree.leaves(state), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    observed = observe(config, params, state, seen(5, 2))
    expected = worlds.observe(MODEL, params, state, seen(5, 2))
    for a, b in zip(jax.tree.leaves(observed), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_many_controls_are_compared_from_one_state_whose_memory_is_not_copied(params, state):
    rng = np.random.default_rng(2)
    plans = jnp.asarray(rng.uniform(-0.3, 0.3, (4, LENGTH, 3)), jnp.float32)
    keys = jax.random.split(KEY, 4)

    def one(moves, key):
        return worlds.imagine(MODEL, params, state, moves, key, remember=False)

    out_axes = (WorldState(0, None), 0)  # refused if the memory were one for each control
    after, frames = jax.jit(jax.vmap(one, out_axes=out_axes))(plans, keys)
    equal(after.map, state.map)
    assert frames.rgb_THWC.shape == (4, LENGTH, 16, 24, 3)
    for i in range(4):
        _, alone = imagine(MODEL, params, state, plans[i], keys[i], remember=False)
        np.testing.assert_allclose(frames.rgb_THWC[i], alone.rgb_THWC, atol=2e-3)
        equal(after.frame.rgb_THWC[i, 0], frames.rgb_THWC[i, -1])


CAMERA = random_camera(np.random.default_rng(0), 3)


@pytest.mark.parametrize(
    ("control", "says"),
    [
        ([], "no actions; give at least one"),
        (np.zeros((0, 3)), "no actions; give at least one"),
        (0, "no actions; give at least one"),
        (np.zeros((3, 2), np.float32), "of shape (3, 2); give (3,) integers or (3, 3)"),
        (np.zeros((3,), np.float32), "of shape (3,); give"),
        ([0, 5], "discrete actions [5]; the 3 actions are 0 forward"),
        (jax.tree.map(lambda x: x[:0], CAMERA), "a camera for each of n ≥ 1"),
        (jax.tree.map(lambda x: x[0], CAMERA), "a camera for each of n ≥ 1"),
        (Camera(CAMERA.intrinsics_4[:2], CAMERA.world_from_camera), "a camera for each of n ≥ 1"),
        (Control(CAMERA, np.zeros((2, 3))), "3 cameras and actions of shape (2, 3); give (3, A)"),
        (Control(CAMERA, [0, 1, 2]), "3 cameras and actions of shape (3,); give (3, A)"),
    ],
)
def test_controls_of_another_form_are_refused_in_a_sentence(params, state, control, says):
    with pytest.raises(UserError, match=re.escape(says)) as caught:
        worlds.imagine(MODEL, params, state, control, KEY)
    told = str(caught.value)
    assert told.startswith("imagine() got ")
    assert told.endswith(".")
    assert "\n" not in told


@pytest.mark.parametrize(
    "change",
    [
        lambda f: jax.tree.map(lambda x: x[:0], f),
        lambda f: dataclasses.replace(f, depth_THW=f.depth_THW[:, :8]),
        lambda f: dataclasses.replace(f, rgb_THWC=f.rgb_THWC[..., :2]),
        lambda f: dataclasses.replace(f, camera=jax.tree.map(lambda x: x[:1], f.camera)),
    ],
)
def test_frames_that_do_not_fit_are_refused_in_a_sentence(params, state, change):
    wrong = change(seen())
    for act, name in (
        (lambda: worlds.start(MODEL, params, wrong), "start"),
        (lambda: worlds.observe(MODEL, params, state, wrong), "observe"),
    ):
        with pytest.raises(UserError) as caught:
            act()
        told = str(caught.value)
        assert told.startswith(f"{name}() got ")
        assert told.endswith(".")
        assert "\n" not in told


def test_frames_travel_as_frames(two_clips):
    _, frames = two_clips
    assert isinstance(frames, Frames)
    assert frames.rgb_THWC.dtype == frames.depth_THW.dtype == jnp.float32
    assert float(jnp.abs(frames.rgb_THWC).max()) <= 1
    assert float(frames.depth_THW.min()) > 0
