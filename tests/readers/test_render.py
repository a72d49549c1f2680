"""Rendering as a reader: what it adds, where, and that it starts from nothing."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.memory import interface as memories
from pewm_jax.memory.none import NoMemoryConfig
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.nn import modules
from pewm_jax.nn.tokens import TokenLayout
from pewm_jax.readers import render as render_reader
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.readers.geometry import init_stacked
from pewm_jax.readers.render import BothConfig, RenderConfig
from pewm_jax.types import Clip, Control, Frames, MapTokens, MemoryReadout, View
from pewm_jax.worlds import objective, world_model
from pewm_jax.worlds.pewm import world as pewm
from tests import properties
from tests.helpers import (
    TINY,
    init_world,
    random_camera,
    random_frames,
    random_world,
    randomise,
    tiny_model,
)

READERS = {
    "attend": AttentionConfig(heads=4, head_dim=8),
    "render": RenderConfig(picture_width=16),
    "input": RenderConfig(picture_width=16, blocks=False),
    "both": BothConfig(heads=4, head_dim=8, picture_width=16),
}
RENDERS = pytest.mark.parametrize("kind", properties.first(["render", "input", "both"], 1))
ALL = pytest.mark.parametrize("kind", properties.first(READERS, 2))
TIMES = jnp.array([5, 700])
apply = jax.jit(world_model.apply, static_argnums=0)
condition = jax.jit(world_model.condition, static_argnums=0)
look = jax.jit(objective.clip_readout, static_argnums=0)


def model_of(kind, memory=VoxelConfig, **sections):
    """The tiny model with another reader, perhaps of another memory."""
    shape = {name: getattr(TINY.memory, name) for name in ("cell_m", "cells", "capacity", "tokens")}
    return tiny_model(memory=memory(reader=READERS[kind], **shape), **sections)


@functools.cache
def inputs():
    """Conditioning, what a memory of 6 channels shows, and noisy latents, of two clips."""
    rng = np.random.default_rng(0)
    camera = jax.tree.map(lambda x: jnp.asarray(np.stack([x, x[::-1]])), random_camera(rng, 9))

    def draw(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    depth = jnp.asarray(rng.uniform(0.5, 4, (2, 9, 16, 24)), jnp.float32)
    first = jax.tree.map(lambda x: x[:, :1], camera)
    observed = Frames(jnp.tanh(draw(2, 1, 16, 24, 3)), depth[:, :1], first)
    conditioning = condition(TINY, {}, observed, Control(camera))
    readout = MemoryReadout(
        MapTokens(draw(2, 20, 6), draw(2, 20, 3), jnp.ones((2, 20), bool)),
        View(draw(2, 9, 16, 24, 6), depth, jnp.asarray(rng.uniform(size=(2, 9, 16, 24)) < 0.6)),
    )
    return conditioning, readout, draw(2, *TINY.latent_shape, TINY.codec.channels)


def predict(model, params, readout):
    conditioning, _, noisy = inputs()
    return apply(model, params, noisy, conditioning, TIMES, readout)


def hidden(readout):
    """The same, but the memory shows nothing."""
    tokens, view = readout.tokens, readout.view
    tokens = dataclasses.replace(tokens, valid_M=jnp.zeros_like(tokens.valid_M))
    return MemoryReadout(tokens, dataclasses.replace(view, seen_THW=jnp.zeros_like(view.seen_THW)))


@pytest.mark.slow(but="attend")
@ALL
def test_a_fresh_reader_changes_nothing_bit_for_bit(kind):
    model, (_, readout, _) = model_of(kind), inputs()
    params = init_world(model)
    params["backbone"] = randomise(params["backbone"])
    base = predict(TINY, {"backbone": params["backbone"]}, None)
    assert np.abs(base).max() > 0.1
    np.testing.assert_array_equal(predict(model, params, readout), base)


@pytest.mark.slow
@ALL
def test_an_empty_memory_changes_nothing_bit_for_bit_whatever_was_learned(kind):
    model, (_, readout, _) = model_of(kind), inputs()
    params = random_world(model)
    backbone = {"backbone": params["backbone"]}
    base = predict(TINY, backbone, None)
    np.testing.assert_array_equal(predict(model, params, hidden(readout)), base)
    np.testing.assert_array_equal(predict(model, backbone, readout), base)
    assert np.abs(predict(model, params, readout) - base).max() > 1e-3


@RENDERS
def test_what_features_say_where_nothing_is_seen_is_not_read(kind):
    model, (_, readout, _) = model_of(kind), inputs()
    params = random_world(model)
    seen = readout.view.seen_THW
    junk = View(
        jnp.where(seen[..., None], readout.view.features_THWF, jnp.nan),
        readout.view.depth_THW,
        seen,
    )
    base = predict(model, params, readout)
    np.testing.assert_array_equal(predict(model, params, MemoryReadout(readout.tokens, junk)), base)


def test_each_token_gets_the_pixels_that_it_stands_for():
    model, (conditioning, readout, _) = model_of("render"), inputs()
    params = random_world(model)["memory"]
    camera, rays = conditioning.camera, conditioning.rays_BthwC
    added = functools.partial(
        model.memory.reader.prepare, model, params, camera=camera, rays_BthwC=rays
    )
    base = added(readout=readout).added_BND.reshape(2, 3, 2, 3, -1)
    rng = np.random.default_rng(1)
    for frame, row, column in zip(*(rng.integers(n, size=6) for n in (9, 16, 24)), strict=True):
        features = readout.view.features_THWF.at[1, frame, row, column].add(3.0)
        seen = readout.view.seen_THW.at[:, frame, row, column].set(True)
        moved = dataclasses.replace(readout.view, features_THWF=features, seen_THW=seen)
        shown = dataclasses.replace(readout.view, seen_THW=seen)
        other = added(readout=MemoryReadout(None, moved)).added_BND.reshape(base.shape)
        same = added(readout=MemoryReadout(None, shown)).added_BND.reshape(base.shape)
        changed = np.argwhere(np.abs(other - same).max(-1) > 0).tolist()
        assert changed == [[1, (frame + 3) // 4, row // 8, column // 8]]


@pytest.mark.slow
def test_many_channels_are_reduced_and_a_token_in_time_may_hold_two_latent_frames():
    backbone = dataclasses.replace(TINY.backbone, patch_t=2)
    reader = RenderConfig(picture_width=16, reduced=2)
    memory = dataclasses.replace(TINY.memory, reader=reader)
    model, (_, readout, _) = tiny_model(memory=memory, backbone=backbone), inputs()
    assert render_reader.pixel_channels(model) == 4
    params = init_world(model)
    assert params["memory"]["render"]["reduce"]["kernel"].shape == (6, 2)
    params["backbone"] = randomise(params["backbone"])
    fresh = predict(model, params, readout)
    np.testing.assert_array_equal(fresh, predict(model, {"backbone": params["backbone"]}, None))
    assert np.abs(predict(model, randomise(params), readout) - fresh).max() > 1e-3


def test_a_block_takes_a_time_for_each_frame():
    model, (conditioning, readout, _) = model_of("render"), inputs()
    params = random_world(model)["memory"]
    read = model.memory.reader.prepare(
        model, params, readout, conditioning.camera, conditioning.rays_BthwC
    )
    layer = jax.tree.map(lambda x: x[0], read.params)
    rng = np.random.default_rng(0)
    video = jnp.asarray(rng.normal(size=(2, 18, 32)), jnp.float32)
    times = jnp.asarray(rng.normal(size=(2, 3, 16)), jnp.float32)
    one = read.block(layer, video, times[:, 0])
    each = read.block(layer, video, jnp.tile(times[:, :1], (1, 3, 1)))
    np.testing.assert_allclose(each, one, atol=1e-5 * np.abs(one).max())
    other = read.block(layer, video, times.at[:, 1].add(1.0)) - read.block(layer, video, times)
    assert np.flatnonzero(np.abs(other).reshape(2, 3, -1).max((0, 2))).tolist() == [1]


def batch_of(model, count=2):
    """Clips of random frames that stand where their context stood."""
    rng = np.random.default_rng(0)
    made = [random_frames(rng, 9) for _ in range(count)]
    frames = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *made)
    return Clip(frames, frames, jnp.ones((count, 9), bool))


@pytest.mark.slow
@pytest.mark.parametrize("memory", [VoxelConfig, SurfelConfig])
def test_a_rollout_looks_as_training_does(memory):
    model = model_of("both", memory)
    batch = batch_of(model)
    readout = look(model, {}, batch)
    assert readout.view.features_THWF.shape == (2, 9, 16, 24, model.memory.rendered_channels)
    assert readout.view.seen_THW.mean() > 0.1
    start = jax.jit(pewm.PEWM.start, static_argnums=0)
    again = jax.jit(functools.partial(memories.readout, model))
    for i in range(2):
        frames = jax.tree.map(lambda x, i=i: x[i], batch.frames)
        alone = again(start(model, {}, frames).map, frames.camera)
        one = jax.tree.map(lambda x, i=i: x[i], readout)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), alone, one)


def test_readers_get_what_they_ask_for():
    batch = batch_of(None)
    for kind, wanted in {"attend": "tokens", "render": "view", "both": "tokens view"}.items():
        readout = jax.eval_shape(
            functools.partial(objective.clip_readout, model_of(kind), {}), batch
        )
        given = {name for name in ("tokens", "view") if getattr(readout, name) is not None}
        assert given == set(wanted.split())


@pytest.mark.slow
@RENDERS
def test_without_a_memory_there_is_nothing_to_see_but_a_reader_to_train(kind):
    model = model_of(kind, NoMemoryConfig)
    readout = look(model, {}, batch_of(model))
    assert not np.asarray(readout.view.seen_THW).any()
    params = random_world(model)
    base = predict(model, {"backbone": params["backbone"]}, None)
    assert np.abs(predict(model, params, readout) - base).max() > 1e-3


@pytest.mark.parametrize("cells", [0, 12])
def test_initial_weights_do_not_depend_on_whether_cells_are_embedded(cells, monkeypatch):
    """Weights drawn from a seed are those of earlier versions, which had no layers of cells."""
    model, key = model_of("render"), jax.random.key(0)
    places = dataclasses.replace(model.backbone.places, cell_width=cells)
    monkeypatch.setattr(type(model.backbone), "places", places)
    made = model.memory.reader.init(model, key)["render"]
    assert ("cell_1" in made) == (cells > 0)
    monkeypatch.undo()
    before = model.memory.reader.init(model, key)["render"]
    shared = {name: made[name] for name in before}
    jax.tree.map(np.testing.assert_array_equal, shared, before)
    channels = render_reader.token_channels(model)
    layer = modules.dense(16, jnp.float32, "embed_1")
    drawn = layer.init(jax.random.fold_in(key, 1), jnp.zeros((1, channels)))["params"]
    np.testing.assert_array_equal(made["embed_1"]["kernel"], drawn["kernel"])
    block = render_reader.RenderBlock(2, TokenLayout(1, 0, 1, 1))
    shapes = (1, 1, places.width), (1, places.time), (1, 1, 16)
    example = tuple(jnp.zeros(shape) for shape in shapes)
    blocks = init_stacked(block, jax.random.fold_in(key, 4), places.count, example)
    jax.tree.map(np.testing.assert_array_equal, made["blocks"], blocks)
