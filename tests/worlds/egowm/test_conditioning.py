"""Ways of conditioning: the observed frame everywhere, EDM noise, and actions by three paths."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import presets, worlds
from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.config import ClipConfig, Config, ConfigError, UserError
from pewm_jax.controls.actions import ModulationConfig
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.cosmos.backbone import CosmosBackbone
from pewm_jax.types import Clip, Control
from pewm_jax.worlds import world_model
from pewm_jax.worlds.control import control_of, cut_into_clips
from pewm_jax.worlds.egowm.world import EgoWM, EgoWMTrainConfig, gated
from pewm_jax.worlds.pewm import candidates
from tests.helpers import random_camera, random_frames, randomised
from tests.train.test_egowm import SVD

KEY = jax.random.key(1)
SIZE = {"sample_height": 4, "sample_width": 4, "sample_frames": 5}
NOISE = EDMConfig(sigma_data=1.0, log_mean=-0.4, log_std=1.2, sigma_max=20.0, sample_steps=2)
DIT = EgoWM(
    clip=ClipConfig(frames=5, height=16, width=16, depth=False),
    codec=PixelConfig(temporal=1),
    backbone=DiTBackbone(layers=1, heads=1, head_dim=16, text_length=1, text_dim=8, time_dim=16),
    noise=NOISE,
    observed="every",
)
COSMOS = dataclasses.replace(
    DIT,
    backbone=CosmosBackbone(
        layers=1, heads=2, head_dim=16, mlp_ratio=2.0, text_dim=24, text_length=3, lora_dim=8
    ),
    control=ModulationConfig(projection="convolution"),
    noise=dataclasses.replace(NOISE, target="flow"),
)
NETWORKS = {
    "cogvideox": DIT,
    "svd": dataclasses.replace(SVD, noise=dataclasses.replace(NOISE, target="v")),
    "cosmos": COSMOS,
}


def clip_of(model, batch=2, seed=0):
    """A batch of clips with actions."""
    rng, size = np.random.default_rng(seed), model.clip
    frames = [random_frames(rng, size.frames, size.height, size.width) for _ in range(batch)]
    frames = jax.tree.map(lambda *x: np.stack(x), *frames)
    none = jax.tree.map(lambda x: x[:, :0], frames)
    shape = (batch, size.frames - 1, model.control.actions)
    actions = rng.uniform(-0.5, 0.5, shape).astype(np.float32)
    state = rng.uniform(-0.5, 0.5, (batch, model.control.state)).astype(np.float32)
    extras = {"state_A": state} if model.control.state else {}
    return Clip(frames, none, np.zeros((batch, 0), bool), actions, extras)


def random_params(model, seed=0):
    return randomised(EgoWM.init, model, jax.random.key(0), seed=seed)


def conditioned(model, params, actions, state=None, brighter=0.0):
    rng = np.random.default_rng(3)
    size = model.clip
    seen = random_frames(rng, 1, size.height, size.width)
    colours = seen.rgb_THWC.astype(np.float32) / 255 - 0.5 + brighter
    seen = dataclasses.replace(seen, rgb_THWC=colours)
    camera = random_camera(rng, size.frames, size.height, size.width)
    one = jax.tree.map(lambda x: jnp.asarray(x)[None], (seen, camera))
    condition = jax.jit(world_model.condition, static_argnums=0)
    return condition(model, params, one[0], Control(one[1], actions[:1], state)).backbone


@pytest.mark.slow
@pytest.mark.parametrize("name", NETWORKS)
def test_every_network_learns_from_low_noise_with_the_frame_everywhere_and_imagines(name):
    model = NETWORKS[name]
    params, clip = random_params(model), clip_of(model)
    stage = worlds.stages(model)[1]
    train = EgoWMTrainConfig()

    @jax.jit
    def loss(trained):
        return stage.loss(model, train, {**params, **trained}, clip, KEY)[0]

    value, grads = jax.value_and_grad(loss)({k: params[k] for k in ("backbone", "control")})
    assert np.isfinite(value)
    for part in jax.tree.leaves(grads["control"]):
        assert np.abs(part).max() > 0
    state = worlds.start(model, params, jax.tree.map(lambda x: x[0, :1], clip.frames))
    moves = np.concatenate([clip.actions_TA[0], clip.actions_TA[1]])
    _, frames = worlds.imagine(model, params, state, moves, KEY)
    assert frames.rgb_THWC.shape[0] == len(moves)
    assert np.isfinite(frames.rgb_THWC).all()


@pytest.mark.parametrize("name", NETWORKS)
def test_the_observed_frame_reaches_every_latent_frame(name):
    model = NETWORKS[name]
    params = random_params(model)
    actions = clip_of(model).actions_TA
    one, other = (conditioned(model, params, actions, brighter=b) for b in (0.0, 0.1))
    changed = np.abs(one.joined_BthwC - other.joined_BthwC).max((0, 2, 3, 4))
    assert (changed > 0).all()


@pytest.mark.parametrize("inject", ["timestep", "attention", "channels"])
@pytest.mark.parametrize("projection", ["sinusoid", "convolution"])
def test_actions_by_each_path_steer_and_begin_without_effect(inject, projection):
    control = ModulationConfig(inject=inject, projection=projection, state=3)
    model = dataclasses.replace(DIT, control=control)
    shapes = control.layout(model)
    assert ("inject" in shapes) == (inject != "timestep")
    actions, state = clip_of(model).actions_TA, np.full((1, 3), 0.3, np.float32)
    fresh = model.control.init(model, KEY)
    field = {"timestep": "modulation_BtE", "attention": "tokens_BLC", "channels": "joined_BthwC"}

    def made(params, actions, state=state):
        return getattr(conditioned(model, {"control": params}, actions, state), field[inject])

    np.testing.assert_array_equal(made(fresh, actions), made(fresh, 0.5 * actions))
    params = randomised(model.control.init, model, KEY)
    plain = made(params, actions)
    later = actions.copy()
    later[:, 2] *= 0.5
    changed = np.abs(made(params, later) - plain)
    if inject == "attention":
        assert plain.shape == (1, model.backbone.text_length + 5, model.backbone.text_dim)
        changed = changed[:, model.backbone.text_length :]
    assert (changed.reshape(5, -1).max(-1)[:3] == 0).all()  # the first is the observed frame
    assert changed.reshape(5, -1).max(-1)[3] > 0
    assert np.abs(made(params, actions, -state) - plain).max() > 0


@pytest.mark.slow
@pytest.mark.parametrize("inject", ["timestep", "attention", "channels"])
def test_actions_by_each_path_change_what_is_imagined(inject):
    model = dataclasses.replace(DIT, control=ModulationConfig(inject=inject, state=3))
    params, actions = random_params(model), clip_of(model).actions_TA[0]
    seen = jax.tree.map(lambda x: x[0, :1], clip_of(model).frames)
    world = worlds.start(model, params, seen)
    cameras = random_camera(np.random.default_rng(0), 4, 16, 16)

    def made(moves, state):
        control = Control(cameras, moves, np.full(3, state, np.float32))
        return worlds.imagine(model, params, world, control, KEY)[1].rgb_THWC

    plain = made(actions, 0.3)
    assert np.abs(plain - made(0.5 * actions, 0.3)).max() > 1e-4
    assert np.abs(plain - made(actions, -0.3)).max() > 1e-4


def test_a_body_stands_still_where_a_clip_has_no_actions():
    control = presets.load("egowm_humanoid").model.control
    rng = np.random.default_rng(5)
    cameras, actions = random_camera(rng, 3, 16, 16), rng.uniform(-0.2, 0.3, (3, 25))
    asked = Control(cameras, jnp.asarray(actions, jnp.float32), jnp.zeros(25))
    chunks, wanted = cut_into_clips(asked, 2, control.still)
    np.testing.assert_array_equal(wanted, [[True, True], [True, False]])
    held = np.append(actions[2, :-2], [0, 0])
    np.testing.assert_allclose(chunks.actions_TA[1], [actions[2], held], atol=1e-6)
    np.testing.assert_allclose(chunks.state_A[1], actions[1], atol=1e-6)
    many = jax.tree.map(lambda x: jnp.asarray(x)[None], asked)
    last = candidates.clip_control(many, slice(2, 3), 2, control.still)
    np.testing.assert_allclose(last.actions_TA[0], [actions[2], held], atol=1e-6)


def test_a_state_of_another_size_is_refused():
    model = presets.load("egowm_humanoid").model
    cameras, actions = random_camera(np.random.default_rng(5), 3, 16, 16), np.zeros((3, 25))
    present = jax.tree.map(lambda x: x[:1], cameras)
    for state in (np.zeros(3), np.zeros((1, 25))):
        with pytest.raises(UserError, match=r"got a state of shape .* that of the present frame"):
            control_of(model, present, Control(cameras, actions, state))


def test_training_has_the_state_of_the_last_observed_frame(monkeypatch):
    """As rollouts have, whose earlier states are unknown."""
    model = dataclasses.replace(DIT, history=3, control=ModulationConfig(state=3))
    params, clip, found = random_params(model), clip_of(model), []

    def condition(model, params, observed, control, **_):
        found.append((observed.depth_THW.shape[1], control.state_A))
        raise InterruptedError

    monkeypatch.setattr(world_model, "condition", condition)
    with pytest.raises(InterruptedError):
        worlds.stages(model)[1].loss(model, EgoWMTrainConfig(), params, clip, KEY)
    depth = dataclasses.replace(
        model,
        clip=dataclasses.replace(model.clip, depth=True),
        codec=PixelConfig(temporal=1, gate=4),
        observed="warped",
    )
    with pytest.raises(InterruptedError):  # clips on which the gate is trained
        worlds.stages(depth)[2].prepare(depth, random_params(depth), clip)
    assert [count for count, _ in found] == [3, 3]
    for _, state in found:
        np.testing.assert_array_equal(state, clip.actions_TA[:, 1])


@pytest.mark.slow
def test_clips_for_the_gate_are_imagined_with_guidance(monkeypatch):
    warped = dataclasses.replace(
        DIT,
        clip=dataclasses.replace(DIT.clip, depth=True),
        codec=PixelConfig(temporal=1, gate=4),
        observed="warped",
    )
    given, seen = [], []

    def sample(model, _params, _conditioning, readout, noise_BthwC, _key, *, blind):
        given.append((readout, blind))
        return noise_BthwC

    condition = world_model.condition

    def observing(model, params, observed, control, **more):
        seen.append((observed.rgb_THWC, more))
        return condition(model, params, observed, control, **more)

    monkeypatch.setattr(world_model, "sample", sample)
    monkeypatch.setattr(world_model, "condition", observing)
    for guidance, level in ((1.0, 0.0), (2.0, 0.0), (1.0, 0.1)):
        noise = dataclasses.replace(warped.noise, guidance=guidance)
        model = dataclasses.replace(warped, noise=noise, image_noise=level)
        worlds.stages(model)[2].prepare(model, random_params(model), clip_of(model))
    assert [readout for readout, _ in given] == [None] * 3
    assert [blind is None for _, blind in given] == [True, False, True]
    (clean, nothing), _, (noisy, more) = seen
    assert not nothing
    np.testing.assert_allclose(more["noise_B"], 0.1)
    np.testing.assert_array_equal(more["clean_BTHWC"], clean)
    assert 0.05 < float(jnp.std(noisy - clean)) < 0.2


def test_a_network_without_further_tokens_refuses_them():
    with pytest.raises(ConfigError, match="attends to no further tokens"):
        dataclasses.replace(SVD, control=ModulationConfig(inject="attention"))
    table = dataclasses.replace(DIT.backbone, positions="rope_learned", **SIZE)
    with pytest.raises(ConfigError, match="attends to no further tokens"):
        dataclasses.replace(DIT, backbone=table, control=ModulationConfig(inject="attention"))
    dataclasses.replace(COSMOS, control=ModulationConfig(inject="attention"))
    for changes, says in (
        ({"inject": "text"}, "control.inject is 'text'"),
        ({"body": "dog"}, "control.body is 'dog': use humanoid"),
        ({"body": "humanoid"}, "has 25 degrees of freedom"),
    ):
        with pytest.raises(ConfigError, match=re.escape(says)):
            ModulationConfig(**changes)


def test_the_presets_have_the_frame_everywhere_low_noise_and_the_body():
    walks, humanoid = (presets.load(name) for name in ("egowm", "egowm_humanoid"))
    for config in (walks, humanoid):
        assert config.model.observed == "warped"
        assert config.model.clip.depth
        assert gated(config.model)
        noise = config.model.noise
        assert (noise.log_mean, noise.log_std, noise.sigma_data) == (-0.3, 1.3, 0.5)
        assert config.model.control.inject == "timestep"
    assert walks.model.control.actions == 3
    assert humanoid.model.control.actions == humanoid.model.control.state == 25
    assert humanoid.model.control.body == "humanoid"
    assert humanoid.model.batch_spec.names == ("state_A",)
    assert isinstance(walks, Config)
