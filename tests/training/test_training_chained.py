"""Clips that start from the model's own frame, and clips from which the memory is hidden."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import training_fakes as fakes
from test_training_prepared import a_batch

from pewm_jax import worlds
from pewm_jax.config import (
    BothConfig,
    ConfigError,
    ControlSettings,
    PixelConfig,
    SurfelConfig,
    TrainConfig,
    UserError,
)
from pewm_jax.memory import memories
from pewm_jax.models import codecs, world_model
from pewm_jax.models.signals import as_signal
from pewm_jax.types import MapTokens, Sight, View
from pewm_jax.worlds import chained, objective
from pewm_jax.worlds import costs as world_costs
from tests.helpers import init_world, randomise, tiny_config, tiny_model

BATCH = 4
KEY = jax.random.key(1)


def reading():
    """A memory of colours that is both attended to and rendered."""
    reader = BothConfig(heads=4, head_dim=8, picture_width=8)
    return SurfelConfig(capacity=1024, cell_m=(0.1, 0.1, 0.1), tokens=16, reader=reader)


CONFIG = tiny_config(codec=PixelConfig(spatial=4, temporal=1), memory=reading())
JOINT = worlds.stages(CONFIG)[2]


@pytest.fixture(scope="module")
def world():
    """Random weights, and a prepared batch: as it is, and with an empty memory."""
    params = randomise(init_world(CONFIG))
    clip = a_batch(CONFIG, BATCH)
    # What is remembered lies before the clips' cameras.
    camera = jax.tree.map(lambda x: np.repeat(x[:, :1], 3, 1), clip.frames.camera)
    clip = dataclasses.replace(clip, context=dataclasses.replace(clip.context, camera=camera))
    prepare = jax.jit(functools.partial(JOINT.prepare, CONFIG.model))
    ready = prepare(params, clip)
    nothing = dataclasses.replace(clip, context_valid_S=np.zeros_like(clip.context_valid_S))
    return params, ready, prepare(params, nothing)


@functools.partial(jax.jit, static_argnums=0)
def _loss_and_gradient(settings, params, clip):
    return jax.value_and_grad(
        lambda p: JOINT.loss(CONFIG.model, TrainConfig(**dict(settings)), p, clip, KEY)[0]
    )(params)


def loss_and_gradient(world, clip, **settings):
    return _loss_and_gradient(tuple(settings.items()), world[0], clip)


def test_a_memory_hidden_from_all_clips_is_an_empty_one(world):
    _, ready, empty = world
    assert ready.sight.tokens.valid_M.any(1).all()
    assert ready.sight.view.seen_THW.any((1, 2, 3)).all()
    assert not empty.sight.view.seen_THW.any()
    plain = loss_and_gradient(world, ready)[0]
    without, gradient = loss_and_gradient(world, empty)
    hidden, same = loss_and_gradient(world, ready, hidden=1.0)
    assert hidden == without
    assert abs(hidden - plain) > 1e-4
    for one, two in zip(*map(jax.tree.leaves, (gradient, same)), strict=True):
        np.testing.assert_array_equal(one, two)


def test_the_memory_is_hidden_clip_by_clip(world):
    sight = world[1].sight
    kept = jnp.array([True, False, True, False])
    partly = objective.shown(sight, kept)
    for row in range(BATCH):
        tokens, seen = partly.tokens.valid_M[row], partly.view.seen_THW[row]
        assert bool(tokens.any()) == bool(seen.any()) == bool(kept[row])
    np.testing.assert_array_equal(partly.tokens.valid_M[::2], sight.tokens.valid_M[::2])
    np.testing.assert_array_equal(partly.view.seen_THW[::2], sight.view.seen_THW[::2])


def test_chained_clips_are_learnt_from_the_models_own_frame_without_gradient(world):
    params, ready, _ = world
    first = jax.jit(
        lambda p, clip: chained.first_frames(
            CONFIG.model,
            1.0,
            p,
            as_signal(clip.frames),
            clip.latents_thwC,
            clip.sight,
            jax.random.fold_in(KEY, 5),
        )
    )
    rgb, depth = first(params, ready)
    true = as_signal(ready.frames)
    assert np.abs(rgb - true.rgb_THWC[:, :1]).min(axis=(1, 2, 3, 4)).max() < 1
    assert all(np.abs(rgb - true.rgb_THWC[:, :1]).max(axis=(1, 2, 3, 4)) > 0.1)
    replaced = dataclasses.replace(
        true,
        rgb_THWC=jnp.concatenate([rgb, true.rgb_THWC[:, 1:]], 1),
        depth_THW=jnp.concatenate([depth, true.depth_THW[:, 1:]], 1),
    )
    given = dataclasses.replace(ready, frames=replaced)
    wanted, gradient = loss_and_gradient(world, given)
    found, same = loss_and_gradient(world, ready, chained=1.0)
    np.testing.assert_allclose(found, wanted, rtol=1e-5)
    assert abs(found - loss_and_gradient(world, ready)[0]) > 1e-5
    for one, two in zip(*map(jax.tree.leaves, (gradient, same)), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-3, atol=1e-5)


def looking_back(monkeypatch, model, share, *, rows=BATCH):
    """Chain clips with a model that knows the answer; returns frames, what is made, what it got."""
    config = dataclasses.replace(CONFIG, model=model)
    frames = as_signal(jax.tree.map(jnp.asarray, a_batch(config, rows).frames))
    latents = codecs.encode_rgbd(model, {}, frames.rgb_THWC, frames.depth_THW)
    back = jax.tree.map(lambda x: x[:, ::-1], frames)
    answer = codecs.encode_rgbd(model, {}, back.rgb_THWC, back.depth_THW)
    times = jnp.arange(frames.depth_THW.shape[1], dtype=jnp.float32)
    shape = frames.depth_THW.shape
    ramp = jnp.broadcast_to(times[:, None, None], shape)
    view = View(jnp.stack([ramp] * 3, -1), 1 + ramp, jnp.ones(shape, bool))
    tokens = MapTokens(jnp.ones((rows, 5, 3)), jnp.ones((rows, 5, 3)), jnp.ones((rows, 5), bool))
    got = {}

    def apply(model, params, noisy, conditioning, time, sight):
        got.update(conditioning=conditioning, sight=sight, time=time)
        return answer[: len(noisy)]

    monkeypatch.setattr(world_model, "apply", apply)
    made = chained.first_frames(model, share, {}, frames, latents, Sight(tokens, view), KEY)
    return frames, made, got


@pytest.mark.parametrize("temporal", [1, 4])
def test_the_clip_before_leads_back_to_the_first_frame(monkeypatch, temporal):
    model = tiny_model(codec=PixelConfig(spatial=4, temporal=temporal))
    frames, (rgb, depth), got = looking_back(monkeypatch, model, 1.0)
    np.testing.assert_allclose(rgb, frames.rgb_THWC[:, :1], atol=1e-5)
    np.testing.assert_allclose(depth, frames.depth_THW[:, :1], rtol=1e-4)
    poses = frames.camera.world_from_camera[:, ::-1]
    np.testing.assert_array_equal(got["conditioning"].camera.world_from_camera, poses)
    joined = got["conditioning"].given.joined_BthwC
    observed = joined[:, 0, ..., : model.codec.channels]
    last = codecs.encode_rgbd(
        model, {}, frames.rgb_THWC[:, -1:], frames.depth_THW[:, -1:], condition=True
    )
    np.testing.assert_array_equal(observed, last[:, 0])
    np.testing.assert_array_equal(got["sight"].view.depth_THW[0, :, 0, 0], np.arange(9, 0, -1))
    assert len(got["time"]) == BATCH


def test_only_a_share_of_the_clips_is_chained_and_the_others_stay_as_they_are(monkeypatch):
    model = tiny_model(codec=PixelConfig(spatial=4, temporal=1))
    model = dataclasses.replace(model, clip=dataclasses.replace(model.clip, depth=False))
    frames, (_, depth), got = looking_back(monkeypatch, model, 0.5)
    assert len(got["time"]) == 2  # others do not go through the model
    np.testing.assert_array_equal(depth[:2], 0)  # a model without depth imagines none
    np.testing.assert_array_equal(depth[2:], frames.depth_THW[2:, :1])
    some = [
        chained.first_frames(
            model, 0.1, {}, frames, jnp.zeros((4, 9, 4, 6, 64)), None, jax.random.key(seed)
        )[1]
        for seed in range(20)
    ]
    share = np.mean([(np.asarray(one) == 0).all((1, 2, 3)) for one in some])
    assert 0 < share < 0.25


def test_a_gate_mixes_the_memory_in_where_the_clip_before_arrives(monkeypatch):
    monkeypatch.setattr(memories, "gated", lambda model: True)
    monkeypatch.setattr(
        codecs, "mix", lambda m, p, rgb, depth, view: (view.features_THWF, view.depth_THW)
    )
    model = tiny_model(codec=PixelConfig(spatial=4, temporal=1))
    _, (rgb, depth), _ = looking_back(monkeypatch, model, 1.0)
    np.testing.assert_array_equal(rgb, 0)
    np.testing.assert_array_equal(depth, 1)


def test_a_control_by_actions_cannot_run_backwards():
    class Steered(ControlSettings):
        actions = 3

    model = dataclasses.replace(CONFIG.model, control=Steered())
    with pytest.raises(UserError, match=r"train\.chained is above 0, .* use a control by cameras"):
        chained.first_frames(model, 0.5, {}, None, None, None, KEY)


@pytest.mark.parametrize("setting", ["hidden", "chained"])
@pytest.mark.parametrize("value", [-0.1, 1.1])
def test_shares_that_are_none_are_refused(setting, value):
    with pytest.raises(ConfigError, match=rf"train\.{setting} is {value}: use a share"):
        TrainConfig(**{setting: value})


def test_the_forward_pass_of_chained_clips_is_counted():
    once = world_costs.of_stage(CONFIG, JOINT)
    more = world_costs.of_stage(fakes.with_train(CONFIG, chained=0.25), JOINT)
    for part, costs in once.items():
        flops, all_of_it = (sum(p.model for p in c.products) for c in (costs, more[part]))
        forward = sum(2 * p.macs for p in costs.products)
        expected = flops + (0.25 * forward if part in ("backbone", "memory") else 0)
        assert all_of_it == pytest.approx(expected), part
