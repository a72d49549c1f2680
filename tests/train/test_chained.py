"""Clips that start from the model's own frame, and clips from which the memory is hidden."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import worlds
from pewm_jax.codecs import rgbd
from pewm_jax.codecs.pixel import PixelConfig
from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import ConfigError, TrainConfig, UserError
from pewm_jax.memory import interface as memories
from pewm_jax.readers.render import BothConfig
from pewm_jax.train import flops
from pewm_jax.types import EncodedView, MapTokens, MemoryReadout, View
from pewm_jax.worlds import objective, world_model
from pewm_jax.worlds import objective as chained
from tests.helpers import TINY, random_world, tiny_config
from tests.train import fakes
from tests.train.test_prepared import a_batch

BATCH, SLOTS = 4, 5
KEY = jax.random.key(1)
EACH = PixelConfig(spatial=4, temporal=1)
"""A codec of frames one by one."""


def config_of(codec=EACH, **clip):
    """A tiny experiment of 5 frames whose memory is both attended to and rendered."""
    memory = dataclasses.replace(
        TINY.memory, reader=BothConfig(heads=4, head_dim=8, picture_width=8)
    )
    clip = dataclasses.replace(TINY.clip, frames=5, **clip)
    return tiny_config(clip=clip, codec=codec, memory=memory)


CONFIG = config_of()
JOINT = worlds.stages(CONFIG)[2]


def shows(config, seed=0):
    """What memories might show: random tokens, and pictures that tell the number of the frame."""
    rng, size = np.random.default_rng(seed), config.model.clip
    shape = (BATCH, size.frames, size.height, size.width)
    number = np.broadcast_to(np.arange(size.frames)[:, None, None], shape)
    channels = config.model.memory.rendered_channels
    features = rng.normal(size=(*shape, channels)).astype(np.float32)
    features[..., :3] = number[..., None] / size.frames
    points = rng.normal(size=(BATCH, SLOTS, channels + 3)).astype(np.float32)
    tokens = MapTokens(points[..., 3:], points[..., :3], np.ones((BATCH, SLOTS), bool))
    return MemoryReadout(
        tokens, View(features, 1 + number.astype(np.float32), np.ones(shape, bool))
    )


def ready_batch(config):
    """A batch whose latents and memories are known."""
    clip = jax.tree.map(jnp.asarray, a_batch(config, BATCH))
    frames = as_signal(clip.frames)
    encode = jax.jit(lambda f: rgbd.encode_rgbd(config.model, {}, f.rgb_THWC, f.depth_THW))
    clip = dataclasses.replace(clip, frames=frames)
    return clip.with_extras(latents_thwC=encode(frames), readout=shows(config))


@pytest.fixture(scope="module")
def world():
    return random_world(CONFIG), ready_batch(CONFIG)


@functools.partial(jax.jit, static_argnums=0)
def _loss(settings, params, clip):
    return JOINT.loss(CONFIG.model, TrainConfig(**dict(settings)), params, clip, KEY)[0]


def loss(params, clip, **settings):
    return float(_loss(tuple(settings.items()), params, clip))


@pytest.mark.slow
def test_a_memory_hidden_from_all_clips_is_an_empty_one(world):
    params, ready = world
    empty = jax.tree.map(np.zeros_like, ready.extras["readout"])
    without = loss(params, ready.with_extras(readout=empty))
    assert abs(loss(params, ready) - without) > 1e-4
    assert loss(params, ready, hidden=1.0) == without


@pytest.mark.slow
def test_the_memory_is_hidden_clip_by_clip(world):
    readout = world[1].extras["readout"]
    kept = jnp.array([True, False, True, False])
    partly = objective.hide_readout(readout, kept)
    for row, whole in enumerate(kept):
        tokens, seen = partly.tokens.valid_M[row], partly.view.seen_THW[row]
        assert tokens.all() == tokens.any() == seen.all() == seen.any() == whole


@pytest.mark.slow
def test_chained_clips_are_learnt_from_the_models_own_frame(world):
    """The same loss as that of clips in which the model's frames stand."""
    params, ready = world

    @jax.jit
    def first(params):
        return chained.first_frames(
            CONFIG.model,
            1.0,
            params,
            ready.frames,
            ready.extras["latents_thwC"],
            ready.extras["readout"],
            jax.random.fold_in(KEY, 5),
        )

    rgb, depth = first(params)
    assert all(np.abs(rgb - ready.frames.rgb_THWC[:, :1]).max(axis=(1, 2, 3, 4)) > 0.1)
    replaced = dataclasses.replace(
        ready.frames,
        rgb_THWC=jnp.concatenate([rgb, ready.frames.rgb_THWC[:, 1:]], 1),
        depth_THW=jnp.concatenate([depth, ready.frames.depth_THW[:, 1:]], 1),
    )
    expected = loss(params, dataclasses.replace(ready, frames=replaced))
    found = loss(params, ready, chained=1.0)
    assert found == pytest.approx(expected, rel=1e-5)
    assert found != pytest.approx(loss(params, ready), rel=1e-4)
    gradient = jax.jit(jax.grad(lambda p: sum(x.sum() for x in first(p))))(params)
    assert not any(leaf.any() for leaf in jax.tree.leaves(gradient))


def looking_back(monkeypatch, config, share):
    """Chain clips with a model that knows the answer: the batch, what is made, what it got."""
    model, ready = config.model, ready_batch(config)
    got = {}

    def apply(model, params, noisy, conditioning, time, readout):
        got.update(conditioning=conditioning, readout=readout, time=time)
        back = jax.tree.map(lambda x: x[: len(noisy), ::-1], ready.frames)
        return rgbd.encode_rgbd(model, {}, back.rgb_THWC, back.depth_THW)

    @jax.jit
    def made():
        readout, latents = ready.extras["readout"], ready.extras["latents_thwC"]
        out = chained.first_frames(model, share, {}, ready.frames, latents, readout, KEY)
        return out, dict(got)

    monkeypatch.setattr(world_model, "apply", apply)
    return ready, *made()


def test_the_clip_before_leads_back_to_the_first_frame(monkeypatch):
    """Its depth is decoded, and its colours are mixed with what the memory shows there."""
    monkeypatch.setattr(memories, "gated", lambda model: True)
    monkeypatch.setattr(
        rgbd, "mix", lambda m, p, rgb, depth, view: (view.features_THWF[..., :3], depth)
    )
    ready, (rgb, depth), got = looking_back(monkeypatch, CONFIG, 1.0)
    frames, model = ready.frames, CONFIG.model
    np.testing.assert_allclose(depth, frames.depth_THW[:, :1], rtol=1e-4)
    np.testing.assert_array_equal(rgb, 0)
    poses = frames.camera.world_from_camera[:, ::-1]
    np.testing.assert_array_equal(got["conditioning"].camera.world_from_camera, poses)
    observed = got["conditioning"].backbone.joined_BthwC[:, 0, ..., : model.codec.channels]
    np.testing.assert_allclose(observed, ready.extras["latents_thwC"][:, -1], atol=1e-5)
    np.testing.assert_array_equal(got["readout"].view.depth_THW[0, :, 0, 0], [5, 4, 3, 2, 1])
    np.testing.assert_array_equal(
        got["readout"].tokens.features_MF, ready.extras["readout"].tokens.features_MF
    )


def test_only_a_share_goes_through_the_model_and_frames_may_be_folded(monkeypatch):
    config = config_of(PixelConfig(spatial=4, temporal=4), depth=False)
    ready, (rgb, depth), got = looking_back(monkeypatch, config, 0.5)
    assert len(got["time"]) == 2
    np.testing.assert_allclose(rgb, ready.frames.rgb_THWC[:, :1], atol=1e-5)
    np.testing.assert_array_equal(rgb[2:], ready.frames.rgb_THWC[2:, :1])
    np.testing.assert_array_equal(depth[:2], 0)  # a model without depth imagines none
    np.testing.assert_array_equal(depth[2:], ready.frames.depth_THW[2:, :1])


def test_the_share_is_that_of_clips_on_average(monkeypatch, world):
    frames = world[1].frames

    def black(model, params, frames, *_):
        return 0 * frames.rgb_THWC[:, :1], 0 * frames.depth_THW[:, :1]

    monkeypatch.setattr(chained, "_predict_backwards", black)

    @jax.jit
    @jax.vmap
    def depths(key):
        return chained.first_frames(CONFIG.model, 0.1, {}, frames, None, None, key)[1]

    chosen = (np.asarray(depths(jax.random.split(KEY, 500))) == 0).all((2, 3, 4))
    assert abs(chosen.mean() - 0.1) < 0.025


def test_a_control_by_actions_cannot_run_backwards(monkeypatch):
    monkeypatch.setattr(type(CONFIG.model.control), "actions", 3)
    with pytest.raises(UserError, match=r"train\.chained is above 0, .* use a control by cameras"):
        chained.first_frames(CONFIG.model, 0.5, {}, None, None, None, KEY)


@pytest.mark.parametrize("setting", ["hidden", "chained"])
@pytest.mark.parametrize("value", [-0.1, 1.1])
def test_shares_that_are_none_are_refused(setting, value):
    with pytest.raises(ConfigError, match=rf"train\.{setting} is {value}: use a share"):
        TrainConfig(**{setting: value})


@pytest.mark.slow
def test_the_forward_pass_of_chained_clips_is_counted():
    """A pass without gradients costs less than half of one with them."""
    clip = fakes.clip(CONFIG, 4, 0)
    none, half, whole = (
        flops.of_stage(fakes.with_train(CONFIG, chained=share), JOINT, clip).total
        for share in (0.0, 0.5, 1.0)
    )
    assert none < half < whole < 1.5 * none
    assert whole - none == pytest.approx(2 * (half - none), rel=0.05)


@pytest.mark.parametrize(
    "field", [f.name for f in dataclasses.fields(MemoryReadout) if f.name != "tokens"]
)
def test_a_clip_that_is_run_backwards_is_shown_the_memory_backwards(field):
    """Every part of what the memory shows, also one that is added later."""
    readout = shows(CONFIG)
    latents = np.random.default_rng(1).normal(size=(BATCH, 5, 4, 4, 3)).astype(np.float32)
    readout = dataclasses.replace(readout, encoded=EncodedView(latents, readout.view.seen_THW))
    back = chained.backwards(CONFIG.model, readout)
    assert back.tokens is readout.tokens
    forward, there = (jax.tree.leaves(getattr(each, field)) for each in (readout, back))
    assert forward
    for a, b in zip(forward, there, strict=True):
        np.testing.assert_array_equal(b, a[:, ::-1])


def test_encoded_pictures_of_folded_frames_cannot_be_run_backwards():
    folded = config_of(PixelConfig(spatial=4, temporal=4)).model
    readout = shows(CONFIG)
    seen = readout.view.seen_THW
    readout = MemoryReadout(readout.tokens, None, EncodedView(np.zeros((BATCH, 2, 4, 4, 3)), seen))
    with pytest.raises(UserError, match="folds several frames into one latent: use a codec of"):
        chained.backwards(folded, readout)
