"""The memory block: Eq. 2 in NumPy, what masks and empty maps do, where positions count from."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax import worlds
from pewm_jax.codecs.signals import as_signal
from pewm_jax.config import TrainConfig
from pewm_jax.geometry.cameras import project
from pewm_jax.memory.none import NoMemoryConfig
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.nn.tokens import TokenLayout
from pewm_jax.readers.geometry import sightings, sinusoid_3d
from pewm_jax.readers.memory_block import MemoryBlock, masked_attention
from pewm_jax.types import Camera, Clip, Control, Frames, MapTokens, MemoryReadout
from pewm_jax.worlds import objective, rollouts, world_model
from tests.helpers import (
    TINY,
    random_camera,
    random_frames,
    random_world,
    randomise,
    rigid,
    with_reader,
)
from tests.properties import examples

BOTH = pytest.mark.parametrize("positions", ["projective", "sinusoid"])
VALID = 15
"""Of 20 map tokens; the others are masked."""
apply = jax.jit(world_model.apply, static_argnums=0)
condition = jax.jit(world_model.condition, static_argnums=0)


def model_of(depth=True, kind=VoxelConfig, **changes):
    """The tiny model with another reader; perhaps without depth, or with another memory."""
    model = with_reader(TINY, **changes)
    values = {field.name: getattr(model.memory, field.name) for field in dataclasses.fields(kind)}
    clip = dataclasses.replace(model.clip, depth=depth)
    return dataclasses.replace(model, clip=clip, memory=kind(**values))


@functools.cache
def inputs(seed=0):
    """Conditioning, tokens, noisy latents and times of two clips, and a model's parameters."""
    rng = np.random.default_rng(seed)
    camera = jax.tree.map(lambda x: jnp.asarray(np.stack([x, x[::-1]])), random_camera(rng, 9))
    rgb = jnp.asarray(rng.uniform(-1, 1, (2, 1, 16, 24, 3)), jnp.float32)
    depth = jnp.asarray(rng.uniform(0.5, 4, (2, 1, 16, 24)), jnp.float32)
    observed = Frames(rgb, depth, jax.tree.map(lambda x: x[:, :1], camera))
    conditioning = condition(TINY, {}, observed, Control(camera))
    tokens = MapTokens(
        jnp.asarray(rng.normal(size=(2, 20, 6)), jnp.float32),
        jnp.asarray(rng.uniform(-3, 3, (2, 20, 3)), jnp.float32),
        jnp.asarray(np.arange(20) < VALID)[None].repeat(2, 0),
    )
    shape = (2, *TINY.latent_shape, TINY.codec.channels)
    return conditioning, tokens, jnp.asarray(rng.normal(size=shape), jnp.float32)


TIMES = jnp.array([5, 700])


@functools.cache
def weights(positions):
    return random_world(model_of(positions=positions))


def predict(positions, tokens, conditioning=None, **changes):
    first, _, noisy = inputs()
    model = model_of(positions=positions, **changes)
    conditioning = first if conditioning is None else conditioning
    return apply(model, weights(positions), noisy, conditioning, TIMES, MemoryReadout(tokens))


def dense(p, x):
    return x @ p["kernel"] + p["bias"]


def norm(p, x, eps=1e-5):
    x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + eps)
    return x * p["scale"] + p["bias"]


def heads(x, count):
    return x.reshape(*x.shape[:-1], count, -1).transpose(0, 2, 1, 3)


def equation_2(p, video, time, camera, memory, valid, count):
    """Eq. 2 of the paper, step by step, with one more logit of nothing per head."""
    width, inner = video.shape[-1], memory.shape[-1]
    alphas = dense(p["linear"], time / (1 + np.exp(-time)))[:, None]
    cuts = np.cumsum([width, width, inner, inner, width])
    beta_h, gamma_h, beta_m, gamma_m, alpha_m, alpha_h = np.split(alphas, cuts, -1)
    h = norm(p["norm_video"], dense(p["with_camera"], np.concatenate([video, camera], -1)))
    h = h * (1 + gamma_h) + beta_h
    m = norm(p["norm_memory"], memory) * (1 + gamma_m) + beta_m
    attention = p["attention"]
    q = norm(attention["norm_q"], heads(dense(attention["to_q"], h), count), 1e-6)
    k = norm(attention["norm_k"], heads(dense(attention["to_k"], m), count), 1e-6)
    v = heads(dense(attention["to_v"], m), count)
    logits = q @ k.swapaxes(-1, -2) / np.sqrt(q.shape[-1])
    weight = np.exp(logits) * valid[:, None, None]
    weight /= weight.sum(-1, keepdims=True) + np.exp(attention["sink"])[:, None, None]
    mixed = (weight @ v).transpose(0, 2, 1, 3).reshape(*video.shape[:2], -1)
    video = video + alpha_m * dense(p["to_out"], mixed)
    up = dense(p["ff"]["up"], norm(p["norm2"], video))
    gelu = 0.5 * up * (1 + np.tanh(np.sqrt(2 / np.pi) * (up + 0.044715 * up**3)))
    return video + alpha_h * dense(p["ff"]["down"], gelu)


def test_the_block_is_equation_2():
    model = model_of(positions="sinusoid")
    reader, width = model.memory.reader, model.backbone.width
    rng = np.random.default_rng(0)
    count, inner = reader.heads, reader.width
    video, time = rng.normal(size=(2, 6, width)), rng.normal(size=(2, 16))
    camera, memory = rng.normal(size=(2, 6, 9)), rng.normal(size=(2, 7, inner))
    valid = np.arange(7) < np.array([[4], [7]])
    arrays = [jnp.asarray(x, jnp.float32) for x in (video, time, camera, memory)]
    block = MemoryBlock(reader, 3, TokenLayout(1, 3, 1, 6))
    fresh = jax.jit(block.init, static_argnums=6)(jax.random.key(0), *arrays, valid, None)
    run = jax.jit(block.apply, static_argnums=6)
    np.testing.assert_array_equal(run(fresh, *arrays, valid, None), arrays[0])
    params = randomise(fresh)
    found = run(params, *arrays, valid, None)
    in_double = jax.tree.map(lambda x: np.asarray(x, np.float64), params["params"])
    expected = equation_2(in_double, video, time, camera, memory, valid, count)
    np.testing.assert_allclose(found, expected, atol=2e-5 * np.abs(expected).max())
    assert np.abs(expected - video).max() > 0.1


def test_attention_to_nothing_is_nothing_and_so_is_its_gradient():
    rng = np.random.default_rng(0)
    logits, values = (jnp.asarray(rng.normal(size=s)) for s in ((1, 2, 3, 4), (1, 2, 4, 5)))

    def total(logits, sink, values, mask):
        return masked_attention(logits, mask, sink, values).sum()

    none, sink = jnp.zeros((4,), bool), jnp.zeros(2)
    assert total(logits, sink, values, none) == 0
    for gradient in jax.grad(total, (0, 1, 2))(logits, sink, values, none):
        np.testing.assert_array_equal(gradient, 0)
    some = jnp.array([True, False, True, False])
    by_logits, _, by_values = jax.grad(total, (0, 1, 2))(logits, sink, values, some)
    np.testing.assert_array_equal(by_logits[..., ~some], 0)
    np.testing.assert_array_equal(by_values[..., ~some, :], 0)
    assert np.abs(by_logits[..., some]).min() > 0


@pytest.mark.slow
@BOTH
def test_masked_tokens_may_hold_anything(positions):
    _, tokens, _ = inputs()
    base = predict(positions, tokens)
    for junk in (np.nan, np.inf, -1e9):
        other = dataclasses.replace(
            tokens,
            features_MF=tokens.features_MF.at[:, VALID:].set(junk),
            points_world_M3=tokens.points_world_M3.at[:, VALID:].set(junk),
        )
        np.testing.assert_array_equal(predict(positions, other), base)


@functools.cache
def lone_block(positions, kind=VoxelConfig):
    """One block and what goes into it; returns the gradient of its output's squares."""
    model = model_of(positions=positions, kind=kind)
    reader, width = model.memory.reader, model.backbone.width
    conditioning, tokens, _ = inputs()
    rng = np.random.default_rng(1)
    count, inner = 3 * 2 * 3, reader.width
    video, time = rng.normal(size=(2, count, width)), rng.normal(size=(2, 16))
    video, time = jnp.asarray(video, jnp.float32), jnp.asarray(time, jnp.float32)
    camera = jnp.zeros((2, count, 16))
    mix = jnp.asarray(rng.normal(size=(60 + 6, inner)), jnp.float32)
    params = jax.tree.map(lambda x: x[0], weights(positions)["memory"]["blocks"])

    def total(params, features, points, valid):
        seen, place = None, sinusoid_3d(model, reader, conditioning.camera, points)
        if positions == "projective":
            seen = sightings(model, reader, conditioning.camera, points, valid)
        memory = jnp.concatenate([features, place], -1) @ mix
        block = MemoryBlock(reader, 3, TokenLayout(1, 3, 3, 6), kind is NoMemoryConfig)
        out = block.apply({"params": params}, video, time, camera, memory, valid, seen)
        return (out**2).sum()

    gradient = jax.jit(jax.grad(total, (0, 1, 2)))
    parts = params, tokens.features_MF, tokens.points_world_M3
    return lambda valid: gradient(*parts, valid)


@pytest.mark.slow(but="sinusoid")
@BOTH
def test_masked_tokens_have_no_gradient_and_an_empty_map_a_finite_one(positions):
    gradient, valid = lone_block(positions), inputs()[1].valid_M
    for by_token in gradient(valid)[1:]:
        np.testing.assert_array_equal(by_token[:, VALID:], 0)
        assert np.isfinite(by_token).all()
        assert np.abs(by_token[:, :VALID]).max() > 0
    for leaf in jax.tree.leaves(gradient(jnp.zeros_like(valid))):
        np.testing.assert_array_equal(leaf, 0)


@pytest.mark.slow
@BOTH
def test_without_a_memory_the_block_still_learns_its_feed_forward(positions):
    valid = inputs()[1].valid_M
    by_params, *by_tokens = lone_block(positions, NoMemoryConfig)(jnp.zeros_like(valid))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(by_params))
    assert np.abs(by_params["ff"]["up"]["kernel"]).max() > 0
    for leaf in (by_params["attention"]["to_k"]["kernel"], *by_tokens):
        np.testing.assert_array_equal(leaf, 0)


@BOTH
def test_one_clips_empty_map_leaves_the_other_clip_alone(positions):
    _, tokens, _ = inputs()
    none = jnp.zeros_like(tokens.valid_M)
    mixed = dataclasses.replace(tokens, valid_M=none.at[1].set(tokens.valid_M[1]))
    both, empty = predict(positions, tokens), dataclasses.replace(tokens, valid_M=none)
    out = predict(positions, mixed)
    np.testing.assert_allclose(out[1], both[1], atol=1e-5 * np.abs(both).max())
    np.testing.assert_allclose(out[0], predict(positions, empty)[0], atol=1e-5)
    assert np.abs(out[0] - both[0]).max() > 1e-3


def away_from_edges(points_world, camera):
    """Whether no token lies within rounding of where a mask flips."""
    uv, z = (np.asarray(x) for x in project(points_world[:, None], camera))
    size, margin = np.array([24, 16]), 0.25 * np.array([24, 16])
    edge = np.minimum(np.abs(uv + margin), np.abs(uv - size - margin)).min(-1)
    return (edge[z > 0.01] > 1e-2).all() and (np.abs(z - 0.05) > 1e-3).all()


@given(seed=st.integers(0, 100_000))
@examples(15)
def test_a_rigid_motion_of_world_cameras_and_map_changes_nothing(seed):
    conditioning, tokens, _ = inputs()
    rng = np.random.default_rng(seed)
    points = jnp.asarray(rng.uniform(-3, 3, (2, 20, 3)), jnp.float32)
    if not away_from_edges(points, conditioning.camera):
        return
    here = dataclasses.replace(tokens, points_world_M3=points)
    motion = rigid(rng)
    camera = conditioning.camera
    moved = Camera(camera.intrinsics_4, motion @ camera.world_from_camera)
    there = dataclasses.replace(tokens, points_world_M3=points @ motion[:3, :3].T + motion[:3, 3])
    base = predict("projective", here)
    again = predict("projective", there, dataclasses.replace(conditioning, camera=moved))
    np.testing.assert_allclose(again, base, atol=5e-3 * float(np.abs(base).max()))


def test_sinusoids_count_from_the_first_camera_or_from_the_world():
    conditioning, tokens, _ = inputs()
    camera, points = conditioning.camera, tokens.points_world_M3
    motion = rigid(np.random.default_rng(1))
    moved = Camera(camera.intrinsics_4, motion @ camera.world_from_camera)
    moved_points = points @ motion[:3, :3].T + motion[:3, 3]
    place = {
        name: functools.partial(sinusoid_3d, TINY, model_of(frame=name).memory.reader)
        for name in ("camera", "world")
    }
    base = {name: place[name](camera, points) for name in place}
    np.testing.assert_allclose(place["camera"](moved, moved_points), base["camera"], atol=1e-3)
    np.testing.assert_array_equal(place["world"](moved, points), base["world"])
    assert np.abs(place["world"](camera, moved_points) - base["world"]).max() > 0.1
    later = camera.world_from_camera.at[:, 1:].set(motion)
    only_first = place["camera"](Camera(camera.intrinsics_4, later), points)
    np.testing.assert_array_equal(only_first, base["camera"])


def test_a_denoiser_without_depth_neither_sees_nor_makes_any():
    conditioning, tokens, noisy = inputs()
    model = model_of(depth=False)
    split = model.codec.rgb_channels
    base = predict("projective", tokens, depth=False)
    np.testing.assert_array_equal(base[..., split:], 0)
    assert np.abs(base[..., :split]).max() > 0.1
    deeper = noisy.at[..., split:].add(1.0)
    out = apply(model, weights("projective"), deeper, conditioning, TIMES, MemoryReadout(tokens))
    np.testing.assert_array_equal(out, base)
    frames = jax.tree.map(jnp.asarray, random_frames(np.random.default_rng(0), 9))
    batch = jax.tree.map(lambda x: x[None], as_signal(frames))
    given = []
    for depth in (batch.depth_THW, batch.depth_THW + 1):
        observed = jax.tree.map(lambda x: x[:, :1], dataclasses.replace(batch, depth_THW=depth))
        given.append(condition(model, {}, observed, Control(batch.camera)).backbone)
    jax.tree.map(np.testing.assert_array_equal, *given)
    assert np.abs(given[0].joined_BthwC[..., :split]).max() > 0.1


@pytest.mark.slow
def test_without_depth_training_weighs_colour_alone_and_rollouts_add_nothing_to_the_map():
    model = model_of(depth=False)
    params = weights("projective")
    frames = random_frames(np.random.default_rng(0), 9)
    batch = jax.tree.map(lambda x: jnp.asarray(x)[None], Clip(frames, frames, np.ones(9, bool)))
    total, parts = jax.jit(
        lambda p: objective.loss(model, TrainConfig(), p, batch, jax.random.key(0), memory=False)
    )(params)
    assert total == parts["loss_rgb"]
    state = jax.jit(worlds.start, static_argnums=0)(model, params, frames)
    roll = jax.jit(rollouts.rollout, static_argnums=0)
    after, made = roll(model, params, state, jnp.zeros(8, jnp.int32), jax.random.key(0))
    np.testing.assert_array_equal(made.depth_THW, 0)
    for a, b in zip(jax.tree.leaves(after.map), jax.tree.leaves(state.map), strict=True):
        np.testing.assert_array_equal(a, b)
    readout = jax.jit(objective.clip_readout, static_argnums=0)(model, params, batch)
    assert np.asarray(readout.tokens.valid_M).any()
