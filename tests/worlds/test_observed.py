"""The observed frame as conditioning of every latent frame: as it is, or warped by its depth."""

import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import config as configuration
from pewm_jax import presets, worlds
from pewm_jax.codecs import rgbd
from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import Config, ConfigError, TrainConfig, UserError
from pewm_jax.memory import rendering
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.readers.render import RenderConfig
from pewm_jax.train import feed
from pewm_jax.types import Camera, Control, Frames, WorldState
from pewm_jax.worlds import objective, world_model
from pewm_jax.worlds.egowm.world import EgoWM, EgoWMTrainConfig
from pewm_jax.worlds.stages import TRAIN
from tests.helpers import TINY, init_world, random_camera, random_frames, random_world, tiny_model
from tests.train.test_prepared import a_batch

EACH = PixelConfig(temporal=1)
MEMORY = SurfelConfig(
    cell_m=(0.3, 0.3, 0.3),
    cells=(24, 24, 8),
    capacity=512,
    tokens=32,
    reader=RenderConfig(picture_width=8),
)
SETTINGS = pytest.mark.parametrize("observed", ["every", "warped"])
CODECS = pytest.mark.parametrize("codec", [EACH, TINY.codec], ids=["frames", "folded"])
condition = jax.jit(world_model.condition, static_argnums=0)
everywhere = jax.jit(world_model.everywhere, static_argnums=0)
KEY = jax.random.key(3)


def model_of(observed, **sections):
    return tiny_model(observed=observed, **{"codec": EACH, "memory": MEMORY, **sections})


@functools.cache
def observed_frame(seed=0):
    """One clip's observed frame, (1, 1), and cameras that turn slowly away, (1, 9)."""
    frame = as_signal(random_frames(np.random.default_rng(seed), 1))
    turn = np.stack([rotated(frame.camera.world_from_camera[0], k / 10) for k in range(9)])
    camera = Camera(np.repeat(frame.camera.intrinsics_4, 9, 0), turn)
    return jax.tree.map(lambda x: jnp.asarray(x)[None], (frame, camera))


def rotated(pose, angle):
    """A pose turned about the vertical axis of the world, in place."""
    turn = np.eye(3, dtype=np.float32)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    out = np.array(pose)
    out[:3, :3] = turn @ out[:3, :3]
    return out


def unmoved(camera):
    return jax.tree.map(lambda x: jnp.repeat(x[:, :1], x.shape[1], 1), camera)


@SETTINGS
@CODECS
def test_the_network_has_input_channels_for_latents_and_a_mask(observed, codec):
    model, plain = model_of(observed, codec=codec), model_of("first", codec=codec)
    assert model.in_channels == plain.in_channels + codec.channels + 1
    frame, camera = observed_frame()
    given = condition(model, {}, frame, Control(camera)).backbone.joined_BthwC
    usual = condition(plain, {}, frame, Control(camera)).backbone.joined_BthwC
    assert model.in_channels == given.shape[-1] + codec.channels
    extra = slice(codec.channels, 2 * codec.channels + 1)
    np.testing.assert_array_equal(np.delete(given, extra, -1), usual)
    found = everywhere(model, {}, frame, camera)
    np.testing.assert_allclose(given[..., extra], found, atol=1e-6)


@pytest.mark.parametrize("observed", ["first", "every", "warped"])
def test_a_change_of_the_observed_frame_reaches_every_latent_frame(observed):
    model = model_of(observed)
    frame, camera = observed_frame()
    brighter = dataclasses.replace(frame, rgb_THWC=frame.rgb_THWC + 0.1)
    a, b = (
        condition(model, {}, x, Control(unmoved(camera))).backbone.joined_BthwC
        for x in (frame, brighter)
    )
    changed = np.abs(a - b).max((0, 2, 3, 4)) > 0.05
    expected = np.full(len(changed), observed != "first")
    expected[0] = True
    np.testing.assert_array_equal(changed, expected)


@SETTINGS
def test_the_prediction_of_every_latent_frame_depends_on_its_own_channels(observed):
    model = model_of(observed)
    params = random_world(model, memory=False)
    frame, camera = observed_frame()
    conditioning = condition(model, params, frame, Control(unmoved(camera)))
    noisy = jnp.ones((1, *model.latent_shape, model.codec.channels))

    def total(joined):
        given = dataclasses.replace(conditioning.backbone, joined_BthwC=joined)
        given = dataclasses.replace(conditioning, backbone=given)
        return (world_model.apply(model, params, noisy, given, jnp.array([500])) ** 2).sum()

    grads = jax.jit(jax.grad(total))(conditioning.backbone.joined_BthwC)
    extra = slice(model.codec.channels, 2 * model.codec.channels + 1)
    assert (np.abs(grads[..., extra]).max((0, 2, 3, 4)) > 0).all()


@CODECS
def test_a_camera_that_does_not_move_sees_the_observed_frame(codec):
    model = model_of("warped", codec=codec)
    frame, camera = observed_frame()
    found = everywhere(model, {}, frame, unmoved(camera))
    still = jax.tree.map(lambda x: jnp.repeat(x, 9, 1), (frame.rgb_THWC, frame.depth_THW))
    np.testing.assert_array_equal(found[..., -1], 1)
    np.testing.assert_allclose(found[..., :-1], rgbd.encode_rgbd(model, {}, *still), atol=2e-3)


def test_holes_are_masked():
    model = model_of("warped")
    frame, camera = observed_frame()
    depth = frame.depth_THW.at[..., 12:].set(0)
    found = everywhere(model, {}, dataclasses.replace(frame, depth_THW=depth), unmoved(camera))
    np.testing.assert_array_equal(found[..., :3, -1], 1)
    np.testing.assert_array_equal(found[..., 4:, :], 0)
    turned = camera.world_from_camera.at[:, 1:].set(rotated(camera.world_from_camera[0, 0], np.pi))
    away = everywhere(model, {}, frame, Camera(camera.intrinsics_4, turned))
    assert (np.asarray(away[:, 0, ..., -1]) == 1).all()
    np.testing.assert_array_equal(away[:, 1:], 0)


def test_the_agents_own_body_is_not_warped():
    clip = model_of("warped").clip
    model = dataclasses.replace(EgoWM(), clip=clip, codec=EACH, observed="warped", own_m=1.0)
    frame, camera = observed_frame()
    depth = jnp.full_like(frame.depth_THW, 3.0).at[..., 12:].set(0.9)
    near = dataclasses.replace(frame, depth_THW=depth)
    found = everywhere(model, {}, near, unmoved(camera))
    np.testing.assert_array_equal(found[..., :3, -1], 1)
    np.testing.assert_array_equal(found[..., 3:, :], 0)
    whole = everywhere(dataclasses.replace(model, own_m=0.0), {}, near, unmoved(camera))
    np.testing.assert_array_equal(whole[..., 3:, -1], 1)


def test_warped_frames_are_where_the_camera_sees_them():
    """A camera that moves forward by z sees the middle of the frame at a depth z less."""
    model = model_of("warped")
    frame, camera = observed_frame()
    frame = dataclasses.replace(frame, depth_THW=jnp.full_like(frame.depth_THW, 3.0))
    pose = camera.world_from_camera[:, :1]
    ahead = pose.at[..., :3, 3].add(pose[..., :3, 2])
    poses = jnp.concatenate([pose, jnp.repeat(ahead, 8, 1)], 1)
    found = everywhere(model, {}, frame, Camera(camera.intrinsics_4, poses))
    _, depth = rgbd.decode_rgbd(model, {}, found[..., :-1])
    np.testing.assert_allclose(depth[:, 0], 3, rtol=1e-3)
    np.testing.assert_allclose(depth[:, 1:], 2, rtol=1e-3)


def config_of(observed, **train):
    return Config(model=model_of(observed), train=TrainConfig(**train))


@pytest.mark.slow
@pytest.mark.parametrize("observed", ["first", "every", "warped"])
def test_training_computes_a_loss_and_gradients_of_the_new_channels(observed):
    config = config_of(observed, memory_errors=0.5, chained=0.5, hidden=0.2, depth_noise=0.02)
    params, clip = random_world(config.model), a_batch(config, 2)
    stage = worlds.stages(config)[2]
    loss = jax.jit(
        jax.value_and_grad(
            lambda p: stage.loss(config.model, config.train, {**params, "backbone": p}, clip, KEY)[
                0
            ]
        )
    )
    value, grads = loss(params["backbone"])
    assert np.isfinite(value)
    kernel = grads["patch_embed"]["kernel"]
    rows = np.asarray(jnp.abs(kernel)).reshape(-1, config.model.in_channels, kernel.shape[-1])
    channels = config.model.codec.channels
    extra = rows[:, 2 * channels :][:, : config.model.everywhere_channels]
    assert extra.size == 0 or (extra.max((0, 2)) > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("chained", [0.0, 0.5])
@SETTINGS
def test_a_prepared_batch_has_the_same_loss(observed, chained):
    config = config_of(observed, chained=chained)
    params, clip = random_world(config.model), a_batch(config, 2)
    stage = worlds.stages(config)[1]
    ready = jax.device_get(jax.jit(lambda p, c: stage.prepare(config.model, p, c))(params, clip))
    assert ("everywhere_thwC" in ready.extras) == (observed == "warped")
    loss = jax.jit(lambda p, c: stage.loss(config.model, config.train, p, c, KEY)[0])
    np.testing.assert_allclose(loss(params, ready), loss(params, clip), rtol=1e-5)


@pytest.mark.slow
def test_chained_clips_are_not_shown_the_true_frame(monkeypatch):
    """The frame that is warped is the one the clip starts from, also where clips are prepared."""
    config = config_of("warped", chained=1.0, image_noise_mean=-20.0)
    clip = a_batch(config, 2)
    ready = objective.prepare(config.model, {}, clip, memory=False)
    seen = {}

    def black(model, share, params, frames, latents, readout, key, everywhere=None):
        return jnp.zeros_like(frames.rgb_THWC[:, :1]), frames.depth_THW[:, :1]

    def condition(*args, everywhere_BthwC, **more):
        seen["warped"] = everywhere_BthwC
        return kept(*args, everywhere_BthwC=everywhere_BthwC, **more)

    kept = world_model.condition
    monkeypatch.setattr(objective, "first_frames", black)
    monkeypatch.setattr(world_model, "condition", condition)
    params = random_world(config.model, memory=False)
    objective.without_memory(config.model, config.train, params, ready, KEY)
    colours = seen["warped"][..., : config.model.codec.rgb_channels]
    np.testing.assert_allclose(colours, 0, atol=1e-5)


@pytest.mark.slow
@SETTINGS
@pytest.mark.parametrize("memory", [True, False])
def test_it_imagines_and_candidates_equal_it(observed, memory):
    model = model_of(observed)
    params = random_world(model)
    state = worlds.start(model, params, random_frames(np.random.default_rng(0), 2))
    moves = jnp.asarray([[0, 1, 0], [2, 0, 0]])
    keys = jax.random.split(KEY, 2)
    _, many = worlds.imagine_many(model, params, state, moves, keys, memory=memory)
    one, frames = worlds.imagine(
        model, params, state, moves[1], keys[1], remember=False, memory=memory
    )
    assert isinstance(one, WorldState)
    np.testing.assert_allclose(many.rgb_THWC[1], frames.rgb_THWC, atol=2e-4)
    still = dataclasses.replace(model, observed="first")
    assert still.in_channels < model.in_channels


@SETTINGS
def test_guidance_hides_the_frame_everywhere(observed):
    model = model_of(observed)
    frame, camera = observed_frame()
    given = condition(model, {}, frame, Control(unmoved(camera)))
    hidden = world_model.without_image(model, given, np.ones((1,), bool)).backbone.joined_BthwC
    shown = 2 * model.codec.channels + 1
    np.testing.assert_array_equal(hidden[..., :shown], 0)
    assert np.abs(hidden[..., shown:]).max() > 0


@pytest.mark.slow
@pytest.mark.parametrize("history", [1, 3])
@SETTINGS
def test_egowm_has_it_too(observed, history):
    model = EgoWM(
        clip=TINY.clip,
        codec=EACH,
        backbone=TINY.backbone,
        noise=TINY.noise,
        observed=observed,
        history=history,
    )
    assert model.batch_spec.poses == (observed == "warped")  # placeholders cannot be warped by
    config = Config(model=model, train=EgoWMTrainConfig())
    params, clip = random_world(model, memory=False), a_batch(config, 2)
    clip = dataclasses.replace(clip, actions_TA=np.zeros((2, 8, 3), np.float32))
    stage = worlds.stages(config)[1]
    ready = stage.prepare(model, params, clip)
    loss = jax.jit(lambda c: stage.loss(model, config.train, params, c, KEY)[0])
    np.testing.assert_allclose(loss(ready), loss(clip), rtol=1e-5)
    state = worlds.start(model, params, random_frames(np.random.default_rng(0), 3))
    _, frames = worlds.imagine(model, params, state, jnp.zeros((2, 3)), KEY)
    assert np.isfinite(frames.rgb_THWC).all()


GATED = EgoWM(
    clip=TINY.clip,
    codec=PixelConfig(spatial=4, temporal=1, gate=8),
    backbone=TINY.backbone,
    noise=TINY.noise,
    observed="warped",
)
STILL = np.zeros((10, 3), np.float32)


def test_the_gate_of_egowm_shows_the_observed_frame_chunk_after_chunk():
    """An agent that stands still sees what it saw if its gate takes all that is rendered."""
    params = random_world(GATED, memory=False)
    out = jax.tree.map(jnp.zeros_like, params["codec"]["gate"]["out"])
    frames = random_frames(np.random.default_rng(0), 1)
    frames = dataclasses.replace(frames, depth_THW=np.full((1, 16, 24), 2.0, np.float32))
    state = worlds.start(GATED, params, frames)

    def imagined(logit):
        bias = jnp.tile(jnp.array([logit, logit, 0.0, 0.0, 0.0, 0.0]), 4)
        gate = {**params["codec"]["gate"], "out": {**out, "bias": bias}}
        return worlds.imagine(GATED, {**params, "codec": {"gate": gate}}, state, STILL, KEY)[1]

    taken = imagined(40.0)
    np.testing.assert_allclose(taken.rgb_THWC, np.repeat(state.frame.rgb_THWC, 10, 0), atol=2e-3)
    np.testing.assert_allclose(taken.depth_THW, 2.0, atol=2e-2)
    plain = dataclasses.replace(GATED, codec=PixelConfig(spatial=4, temporal=1))
    ungated = worlds.imagine(plain, params, state, STILL, KEY)[1]
    np.testing.assert_allclose(imagined(-40.0).rgb_THWC[:8], ungated.rgb_THWC[:8], atol=2e-3)
    assert np.abs(taken.rgb_THWC - ungated.rgb_THWC).max() > 0.1


@pytest.mark.slow
def test_the_gate_of_egowm_learns_on_imagined_clips_and_the_rest_is_frozen():
    config = Config(model=GATED, train=EgoWMTrainConfig())
    stage = worlds.stages(config)[2]
    assert (stage.name, stage.optional) == ("gate", True)
    params, clip = random_world(GATED, memory=False), a_batch(config, 2)
    clip = dataclasses.replace(clip, actions_TA=np.zeros((2, 8, 3), np.float32))
    ready = stage.prepare(GATED, params, clip)
    loss = jax.jit(lambda p, c: stage.loss(GATED, config.train, p, c, KEY)[0])
    np.testing.assert_allclose(loss(params, ready), loss(params, clip), rtol=1e-4)
    gradient = jax.grad(loss)(params, ready)["codec"]["gate"]
    better = {
        **params,
        "codec": {
            "gate": jax.tree.map(lambda x, g: x - 1e-2 * g, params["codec"]["gate"], gradient)
        },
    }
    assert float(loss(better, ready)) < float(loss(params, ready))
    assert [pattern for pattern, role in stage.rules if role == TRAIN] == [r"codec/gate/.*"]
    for model in (
        dataclasses.replace(GATED, observed="every"),
        dataclasses.replace(GATED, codec=PixelConfig(spatial=4, temporal=1)),
    ):
        with pytest.raises(UserError, match="no gate that blends its frames"):
            stage.require(model)


def test_warping_needs_depth_and_other_words_are_refused():
    clip = dataclasses.replace(TINY.clip, depth=False)
    with pytest.raises(ConfigError, match=r"model\.observed is warped, .* use model\.observed ev"):
        model_of("warped", clip=clip)
    model_of("every", clip=clip)
    with pytest.raises(ConfigError, match=r"model\.observed is 'all'; choose one of first"):
        model_of("all")


def test_settings_written_before_are_read():
    config = presets.load("tiny")
    values = json.loads(json.dumps(configuration.to_dict(config)))
    del values["model"]["observed"], values["train"]["memory_errors"]
    assert configuration.from_dict(Config, values, "config.json") == config
    assert config.model.observed == "first"
    assert init_world(config)["backbone"]["patch_embed"]["kernel"].shape[0] == (
        config.model.backbone.patch**2
        * (2 * config.model.codec.channels + config.model.control.channels(config.model))
    )


def test_clips_prepared_before_are_found_again(monkeypatch, tmp_path):
    """The names of their folders do not depend on settings that earlier versions did not have."""
    monkeypatch.setattr(feed, "read_manifest", lambda _: type("Split", (), {"shards": ()}))

    def folder(observed):
        data = dataclasses.replace(presets.load("tiny").data, prepared_path=str(tmp_path))
        config = dataclasses.replace(config_of(observed), data=data)
        return feed._folder(config, worlds.stages(config)[1], "weights")

    now, as_dict = folder("first"), configuration.to_dict

    def earlier(settings):
        return {name: x for name, x in as_dict(settings).items() if name != "observed"}

    assert len({now, folder("every"), folder("warped")}) == 3
    monkeypatch.setattr(configuration, "to_dict", earlier)
    assert folder("first") == now


def test_what_the_camera_saw_is_seen_by_it_again():
    """``splat_frames`` of several frames shows each from its own camera."""
    frames = as_signal(random_frames(np.random.default_rng(5), 1))
    several = jax.tree.map(lambda x: np.repeat(x, 2, 0), frames)
    view = rendering.splat_frames(several, frames.camera, 16, 24)
    assert view.seen_THW.all()
    np.testing.assert_allclose(view.features_THWF, frames.rgb_THWC, atol=1e-3)
    np.testing.assert_allclose(view.depth_THW, frames.depth_THW, rtol=1e-4)
    none = Frames(frames.rgb_THWC, np.zeros_like(frames.depth_THW), frames.camera)
    assert not rendering.splat_frames(
        none, random_camera(np.random.default_rng(1), 2), 8, 8
    ).seen_THW.any()
