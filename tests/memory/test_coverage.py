"""What of the pixels seen before is remembered, chosen and looked at; which depths are trusted."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.geometry import zbuffer
from pewm_jax.memory import coverage
from pewm_jax.memory import interface as memories
from pewm_jax.readers.render import RenderConfig
from tests.helpers import random_camera
from tests.memory.test_memories import ALL, KINDS, encoded, model_of, scene, seen


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_looked_at_is_chosen_and_what_is_chosen_is_held(kind):
    model = model_of(kind)
    frames = scene()
    memory, _ = seen(model, frames, ALL)
    first = jax.tree.map(lambda x: jnp.concatenate([x, x, x[:1]]), frames)
    tokens = model.memory.read(model, memory, first.camera)
    mask = np.ones(first.depth_THW.shape, bool)
    count = jax.jit(coverage.coverage, static_argnums=0)
    found = {k: int(v) for k, v in count(model, memory, tokens, first, mask).items()}
    assert found["seen"] == int((np.asarray(first.depth_THW) > 0).sum())
    assert found["attended"] <= found["chosen"] <= found["held"] <= found["seen"]
    assert found["looked_at"] == found["attended"]
    drawn = dataclasses.replace(model.memory, reader=RenderConfig(picture_width=8))
    again = count(dataclasses.replace(model, memory=drawn), memory, tokens, first, mask)
    assert int(again["looked_at"]) == int(again["rendered"])
    assert (found["held"] > 0) == (kind != "none")
    assert (found["chosen"] > 0) == (kind != "none")


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_no_measurement_is_no_surface(kind):
    model = model_of(kind)
    frames = scene()
    blank = dataclasses.replace(frames, depth_THW=jnp.zeros_like(frames.depth_THW))
    start = model.memory.empty(model, jnp.zeros(3))
    for observed in (True, False):
        memory = memories.insert(model, {}, start, blank, encoded(frames), observed=observed)
        assert not np.asarray(model.memory.to_points(model, memory)[2]).any()


def test_far_near_and_edges_of_imagined_frames_are_not_trusted():
    model = model_of("voxel", imagined_edge=0.2)
    frames = scene(count=1)
    depth = np.full(frames.depth_THW.shape, 2.0, np.float32)
    depth[:, :, 10:] = 3.0
    depth[:, 0, 0], depth[:, 5, 3], depth[:, 5, 5] = 0.0, 11.9, 0.1
    kept = memories.trusted(model, dataclasses.replace(frames, depth_THW=depth)).depth_THW
    expected = depth.copy()
    expected[:, :, 9:11] = 0
    for row, column in ((5, 3), (4, 3), (6, 3), (5, 2), (5, 4), (5, 5)):
        expected[:, row, column] = 0
    np.testing.assert_array_equal(kept, expected)


def test_what_hides_is_chosen_before_what_is_hidden():
    camera = jax.tree.map(jnp.asarray, random_camera(np.random.default_rng(0), 1, upright=True))
    pose = np.asarray(camera.world_from_camera)[0]
    near = pose[:3, 3] + pose[:3, 2] * 1.0
    far = pose[:3, 3] + pose[:3, 2] * 4.0
    aside = pose[:3, 3] - pose[:3, 2] * 1.0
    points = jnp.asarray(np.stack([far, aside, near, near]), jnp.float32)
    valid = jnp.array([True, True, True, False])
    size = jnp.float32(0.5)
    order = zbuffer.visible_first(points, size, size, valid, camera, (16, 24), 4)
    np.testing.assert_array_equal(order, [2, 0, 1, 3])


@pytest.mark.parametrize("shape", [(8, 8), (21, 32), (1, 5)])
def test_each_pixel_has_one_turn(shape):
    turns = zbuffer.pixel_order(*shape)
    np.testing.assert_array_equal(np.sort(turns), np.arange(np.prod(shape)))
