"""The world of EgoWM: chunks chained, history kept, guidance on the image alone, and no map."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pewm_jax
from pewm_jax import config as configuration
from pewm_jax import worlds
from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import ClipConfig, Config, ConfigError, UserError
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.geometry import actions as action_geometry
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.planning import imagined_env
from pewm_jax.types import Camera, Control
from pewm_jax.worlds import world_model
from pewm_jax.worlds.egowm.world import EgoWM, EgoWMTrainConfig
from tests.helpers import random_frames, random_world

MODEL = EgoWM(
    clip=ClipConfig(frames=5, height=16, width=16, depth=False),
    codec=PixelConfig(temporal=1),
    backbone=DiTBackbone(layers=1, heads=1, head_dim=16, text_length=1, text_dim=8, time_dim=16),
    noise=DDPMConfig(sample_steps=1, guidance=2.0),
)
CONFIG = Config(model=MODEL, train=EgoWMTrainConfig())
LATER = dataclasses.replace(MODEL, history=3, noise=DDPMConfig(sample_steps=1))
KEY = jax.random.key(1)
MOVES = np.random.default_rng(4).uniform((-0.1, -0.1, -0.3), (0.4, 0.1, 0.3), (6, 3))
MOVES = MOVES.astype(np.float32)
imagine = jax.jit(worlds.imagine, static_argnums=0, static_argnames=("remember",))
many = jax.jit(worlds.imagine_many, static_argnums=0, static_argnames=("last",))


def equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def seen(count=4, seed=0):
    return jax.tree.map(jnp.asarray, random_frames(np.random.default_rng(seed), count, 16, 16))


@pytest.fixture(scope="module")
def params():
    return random_world(MODEL, memory=False)


@pytest.fixture(scope="module")
def state(params):
    return worlds.start(MODEL, params, seen())


@pytest.fixture(scope="module")
def two_chunks(params, state):
    return imagine(MODEL, params, state, MOVES, KEY)


def test_chunks_are_chained_along_the_actions(state, two_chunks):
    after, frames = two_chunks
    assert frames.rgb_THWC.shape == (6, 16, 16, 3)
    assert not np.any(frames.depth_THW)
    poses = action_geometry.integrate(state.frame.camera.world_from_camera[0], MOVES)
    np.testing.assert_allclose(frames.camera.world_from_camera, poses[1:], atol=1e-5)
    equal(after.frame, jax.tree.map(lambda x: x[-1:], frames))
    assert np.unique(np.asarray(frames.rgb_THWC).reshape(6, -1), axis=0).shape[0] == 6


def test_an_action_changes_no_frame_of_an_earlier_chunk(params, state, two_chunks):
    """Within a chunk the transformer's attention over time looks both ways."""
    moved = MOVES.copy()
    moved[4] *= 0.5
    _, other = imagine(MODEL, params, state, moved, KEY)
    _, frames = two_chunks
    equal(other.rgb_THWC[:4], frames.rgb_THWC[:4])
    assert np.abs(other.rgb_THWC[4] - frames.rgb_THWC[4]).max() > 1e-4


def test_only_actions_steer_and_discrete_ones_are_those_of_the_model(params, state):
    discrete = np.array([0, 1, 2, 0, 0, 1])
    moves = action_geometry.continuous(MODEL.actions, jnp.asarray(discrete))
    _, frames = imagine(MODEL, params, state, discrete, KEY)
    _, same = imagine(MODEL, params, state, moves, KEY)
    np.testing.assert_allclose(frames.rgb_THWC, same.rgb_THWC, atol=1e-5)
    still = Camera(
        frames.camera.intrinsics_4, np.repeat(state.frame.camera.world_from_camera, 6, 0)
    )
    _, elsewhere = imagine(MODEL, params, state, Control(still, moves), KEY)
    np.testing.assert_allclose(elsewhere.rgb_THWC, frames.rgb_THWC, atol=1e-5)
    with pytest.raises(UserError, match="is steered by actions of 3 numbers"):
        worlds.imagine(MODEL, params, state, frames.camera, KEY)


def test_many_are_imagined_as_each_alone(params, state):
    plans = np.stack([MOVES, 0.5 * MOVES])
    keys = jax.random.split(KEY, 2)
    after, frames = many(MODEL, params, state, plans, keys, last=True)
    assert frames.rgb_THWC.shape == (2, 1, 16, 16, 3)
    for k in range(2):
        _, alone = imagine(MODEL, params, state, plans[k], keys[k])
        np.testing.assert_allclose(frames.rgb_THWC[k, 0], alone.rgb_THWC[-1], atol=2e-3)
    equal(after.map, state.map)


def test_guidance_hides_the_image_and_leaves_the_actions(params):
    frames = jax.tree.map(lambda x: x[None], worlds.start(MODEL, params, seen()).frame)
    camera = jax.tree.map(lambda x: np.repeat(x, 5, 1), frames.camera)
    condition = jax.jit(world_model.condition, static_argnums=0)
    given = condition(MODEL, params, frames, Control(camera, MOVES[None, :4]))
    blind = world_model.without_image(MODEL, given, np.ones((1,), bool)).backbone
    assert np.any(given.backbone.joined_BthwC)
    assert not np.any(blind.joined_BthwC)
    equal(blind.modulation_BtE, given.backbone.modulation_BtE)
    assert np.any(blind.modulation_BtE)


@pytest.mark.slow
def test_the_last_frames_are_kept_as_history(params):
    frames = seen()
    state = worlds.start(LATER, params, frames)
    signal = worlds.start(LATER, params, jax.tree.map(lambda x: x[1:], frames))
    equal(state, signal)
    equal(state.map.camera, jax.tree.map(lambda x: x[1:3], frames.camera))
    one = worlds.start(LATER, params, jax.tree.map(lambda x: x[:1], frames))
    equal(one.map.rgb_THWC[0], one.frame.rgb_THWC[0])
    later = worlds.observe(LATER, params, one, jax.tree.map(lambda x: x[1:], frames))
    equal(later, state)

    after, made = imagine(LATER, params, state, MOVES[:3], KEY)
    equal(after.map, jax.tree.map(lambda x: x[:2], made))
    other = dataclasses.replace(state.map, rgb_THWC=-state.map.rgb_THWC)
    _, changed = imagine(LATER, params, dataclasses.replace(state, map=other), MOVES[:3], KEY)
    assert np.abs(changed.rgb_THWC - made.rgb_THWC).max() > 1e-4
    kept, again = imagine(LATER, params, state, MOVES[:3], KEY, remember=False)
    equal(kept.map, state.map)
    np.testing.assert_allclose(again.rgb_THWC, made.rgb_THWC, atol=1e-5)


def test_it_is_an_environment(params):
    frames, goal = seen(), seen(1, 2)
    env = imagined_env.WorldModelEnv(CONFIG, params, render_mode="rgb_array")
    first, _ = env.reset(seed=0, options={"frames": frames, "goal": goal})
    np.testing.assert_array_equal(first["rgb"], frames.rgb_THWC[-1])
    after, *_ = env.step(1)
    assert after in env.observation_space
    assert not np.array_equal(after["rgb"], first["rgb"])


def test_its_settings_travel_and_what_cannot_work_is_refused():
    assert configuration.from_dict(Config, configuration.to_dict(CONFIG)) == CONFIG
    assert worlds.stages(MODEL)[1].rates == ((r"control/.*", 10.0),)
    for changes, says in (
        ({"memory": SurfelConfig()}, "the world egowm has no map"),
        ({"history": 5}, "fewer than clip.frames (5)"),
        ({"codec": PixelConfig(temporal=2), "history": 2}, "use 2k + 1 frames"),
        ({"image_noise": -1.0}, "use 0 or more"),
    ):
        with pytest.raises(ConfigError, match=re.escape(says)):
            dataclasses.replace(MODEL, **changes)
    with pytest.raises(ConfigError, match="cannot be run backwards"):
        EgoWMTrainConfig(chained=0.5)
    with pytest.raises(UserError, match="colours"):
        pewm_jax.start(MODEL, {}, random_frames(np.random.default_rng(0), 2))
