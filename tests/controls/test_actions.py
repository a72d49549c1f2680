"""Actions by modulation: published normalisation, no action too early, nothing changed at first."""

import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.bodies.humanoid import HUMANOID
from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import ConfigError, UserError
from pewm_jax.controls import actions as action_control
from pewm_jax.controls import skeleton
from pewm_jax.controls.actions import ModulationConfig
from pewm_jax.data.agent import open_agent
from pewm_jax.data.render import Rendered
from pewm_jax.memory.none import NoMemoryConfig
from pewm_jax.models import interface as backbones
from pewm_jax.readers.render import RenderConfig
from pewm_jax.types import Control
from tests.helpers import TINY, random_camera, random_frames, randomised, tiny_model

E, BATCH = TINY.backbone.time_dim, 2
WIDE = {name: (value,) * 25 for name, value in (("units", 1.0), ("low", -2.0), ("high", 2.0))}


def model_of(temporal=4, **settings):
    return tiny_model(
        codec=PixelConfig(spatial=4, temporal=temporal),
        control=ModulationConfig(**settings),
        memory=NoMemoryConfig(reader=RenderConfig()),
    )


def steered(model, actions, params=None, state=None, observed=1):
    """The control's conditioning of a batch of clips."""
    rng = np.random.default_rng(0)
    params = randomised(model.control.init, model, jax.random.key(0)) if params is None else params
    frames, camera = random_frames(rng, observed), random_camera(rng, model.clip.frames)
    both = jax.tree.map(lambda x: np.repeat(np.asarray(x)[None], BATCH, 0), (frames, camera))
    return model.control.condition(model, params, both[0], Control(both[1], actions, state))


def actions_of(model, seed=0):
    shape = (BATCH, model.clip.frames - 1, model.control.actions)
    return np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)


def test_numbers_are_normalised_as_published():
    config = ModulationConfig(units=(0.5, 0.5, 1.0))
    turn = np.pi
    given = [[-1.25, -2, turn], [2.5, 2, -turn], [0.625, 0, 0.3 + 2 * turn], [0.625, 0, -3 * turn]]
    want = [[-1, -1, turn], [1, 1, turn], [0, 0, 0.3], [0, 0, turn]]
    np.testing.assert_allclose(config.normalise(given), want, atol=1e-5)


@pytest.mark.parametrize(
    ("temporal", "settings"), [(1, {}), (4, {"actions": 25, "angles": (), **WIDE})]
)
@pytest.mark.parametrize("projection", ["sinusoid", "convolution"])
def test_an_embedding_per_latent_frame_that_knows_no_later_action(temporal, settings, projection):
    model = model_of(temporal, projection=projection, **settings)
    frames = model.latent_shape[0]
    made = steered(model, actions_of(model)).modulation_BtE
    assert made.shape == (BATCH, frames, E)
    np.testing.assert_array_equal(made[:, 0], 0)
    assert np.abs(made[:, 1:]).min(-1).max() > 0
    for k in range(model.clip.frames - 1):
        moved = actions_of(model)
        moved[:, k] *= 0.5
        other = steered(model, moved).modulation_BtE
        holds = k // temporal + 1  # the latent frame of frame k + 1
        np.testing.assert_array_equal(other[:, :holds], made[:, :holds])
        assert np.abs(other[:, holds] - made[:, holds]).max() > 1e-4


def test_only_frames_to_be_imagined_have_actions_and_the_state_is_in_all():
    model = model_of(1, state=3)
    state = np.full((BATCH, 3), 0.5, np.float32)
    params = randomised(model.control.init, model, jax.random.key(0))
    made = steered(model, actions_of(model), params, state, observed=3).modulation_BtE
    np.testing.assert_array_equal(made[:, 0], made[:, 2])
    assert np.abs(made[:, 3] - made[:, 2]).max() > 1e-3
    assert np.abs(made[:, 0]).max() > 1e-3
    without = {name: params[name] for name in ("linear_1", "linear_2")}
    plain = dataclasses.replace(model, control=ModulationConfig())
    led = steered(plain, actions_of(model), without, observed=3).modulation_BtE
    np.testing.assert_allclose(made - made[:, :1], led, atol=1e-5)
    with pytest.raises(UserError, match="no state of the agent was given"):
        steered(model, actions_of(model), params)


def test_cameras_without_actions_are_refused():
    with pytest.raises(UserError, match="steered by actions, and got cameras alone"):
        steered(model_of(), None)


def test_before_training_any_action_leaves_the_output_bit_for_bit():
    state = np.ones((BATCH, 3), np.float32)
    for projection in ("sinusoid", "convolution"):
        model = model_of(projection=projection, state=3)
        fresh = model.control.init(model, jax.random.key(1))
        made = steered(model, actions_of(model), fresh, state)
        assert not np.any(made.modulation_BtE)
    x = np.random.default_rng(0).normal(size=(BATCH, *model.latent_shape, 8)).astype(np.float32)
    time = np.array([100.0, 900.0], np.float32)

    @functools.partial(jax.jit, static_argnums=0)
    def run(backbone, params, x, time, given):
        return backbone.apply(params, x, time, given)

    params = randomised(model.backbone.init, jax.random.key(0), 8, 4)
    without = run(model.backbone, params, x, time, backbones.Conditioning())
    np.testing.assert_array_equal(run(model.backbone, params, x, time, made), without)


def test_two_convolutions_lead_down_to_the_latent_rate():
    steps = {q: action_control.strides(q) for q in (1, 2, 4, 8)}
    assert steps == {1: (1, 1), 2: (2, 1), 4: (2, 2), 8: (4, 2)}


@pytest.mark.parametrize("projection", ["sinusoid", "convolution"])
def test_actions_before_the_last_observed_frame_change_nothing(projection):
    model = model_of(4, projection=projection)
    assert model.clip.frames == 9
    params = randomised(model.control.init, model, jax.random.key(0))
    made = steered(model, actions_of(model), params, observed=5).modulation_BtE
    assert np.abs(made[:, 2]).max() > 1e-3
    earlier = actions_of(model)
    earlier[:, :4] = 0  # as in rollouts, where they are unknown
    other = steered(model, earlier, params, observed=5).modulation_BtE
    np.testing.assert_array_equal(made, other)


def test_standing_still_keeps_joints_and_stops_walking():
    last = np.arange(1, 26, dtype=np.float32)
    body = ModulationConfig(actions=25, state=25, angles=(), body="humanoid", **WIDE)
    np.testing.assert_array_equal(body.still(last), [*last[:-2], 0, 0])
    states = dataclasses.replace(body, body="")
    np.testing.assert_array_equal(states.still(last), last)
    np.testing.assert_array_equal(ModulationConfig().still(last[:3]), np.zeros(3))


def test_rays_are_joined_where_they_are_asked_for():
    model = model_of(rays=True)
    assert model.in_channels == 2 * model.codec.channels + 24
    made = steered(model, actions_of(model))
    assert made.joined_BthwC.shape == (BATCH, *model.latent_shape, 24)
    assert steered(model_of(), actions_of(model)).joined_BthwC is None


def test_arms_are_drawn_where_they_are_seen():
    """In frames of a body without anything behind: most of the arms, and little beside them."""
    agent = open_agent("humanoid", 1.25)
    rng = np.random.default_rng(6)
    names = [one.name for one in HUMANOID.freedoms]
    states = np.tile(HUMANOID.rest, (8, 1))
    for name, low, high in (("shoulder_pitch", 0.5, 1.2), ("elbow_pitch", 0.3, 1.2)):
        for side in ("left", "right"):
            states[:, names.index(f"{side}_{name}")] = rng.uniform(low, high, 8)
    size, still = 48, np.zeros((8, 3))
    intrinsics = np.array([30, 30, 24, 24], np.float32)
    camera = agent.camera(still, states, np.tile(intrinsics, (8, 1)), 0.0)
    empty = Rendered(
        np.zeros((8, size, size, 3), np.uint8),
        np.full((8, size, size), 50, np.float32),
        np.zeros((8, size, size), np.uint16),
    )
    agent.render_over(empty, still, states, camera, 0.0, 1)
    arms = np.isin(empty.ids_THW, [agent.ids(1)[link] for link in HUMANOID.arms])
    assert 0.05 < arms.mean() < 0.5
    states = jnp.asarray(states, jnp.float32)[None]
    draw = jax.jit(skeleton.draw_bones, static_argnums=(0, 3, 4))
    drawn = np.asarray(draw(HUMANOID, states, intrinsics[None, None].repeat(8, 1), size, size))
    assert drawn.shape == (1, 8, size, size, 2)
    assert 0 <= drawn.min() <= drawn.max() <= 1
    found = drawn[0].max(-1) > 0.4
    assert (found & arms).sum() / (found | arms).sum() > 0.6


def test_drawings_are_joined_and_those_of_observed_frames_have_the_known_state():
    settings = {"actions": 25, "state": 25, "angles": (), "body": "humanoid", **WIDE}
    model = model_of(temporal=1, drawn=True, **settings)
    assert model.in_channels == model_of(temporal=1, **settings).in_channels + 2 * 4 * 4
    actions, state = actions_of(model), actions_of(model, 1)[:, 0]
    made = steered(model, actions, state=state, observed=3)
    assert made.joined_BthwC.shape == (BATCH, *model.latent_shape, 32)
    np.testing.assert_array_equal(made.joined_BthwC[:, 0], made.joined_BthwC[:, 2])
    other = steered(model, 0 * actions, state=state, observed=3)
    np.testing.assert_array_equal(other.joined_BthwC[:, :3], made.joined_BthwC[:, :3])
    assert (np.asarray(other.joined_BthwC[:, 3:]) != np.asarray(made.joined_BthwC[:, 3:])).any()


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"drawn": True, "state": 3}, "set control.body and control.state"),
        ({"actions": 2}, "control.units has 3 values and control.actions is 2"),
        ({"low": (1.0, 4.0, -1.0)}, "each low must be below its high"),
        ({"units": (1.0, 0.0, 1.0)}, "use positive numbers"),
        ({"angles": (3,)}, "from 0 to 2"),
        ({"features": 31}, "use an even number"),
        ({"state": 2}, "use 0 for none, or control.actions (3)"),
    ],
)
def test_settings_that_cannot_work_are_refused(settings, says):
    with pytest.raises(ConfigError, match=re.escape(says)):
        ModulationConfig(**settings)
