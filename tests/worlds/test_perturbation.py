"""Errors planted into what the memory shows: where, how large, and that they depend on a key."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.config import ConfigError, TrainConfig
from pewm_jax.geometry import cameras
from pewm_jax.types import Camera, EncodedView, MapTokens, MemoryReadout, View
from pewm_jax.worlds import perturbation
from pewm_jax.worlds.egowm.world import EgoWMTrainConfig
from pewm_jax.worlds.persist.config import PersistTrainConfig
from tests.helpers import random_camera, tiny_model
from tests.worlds.test_observed import MEMORY

BATCH, FRAMES, HEIGHT, WIDTH = 6, 3, 16, 24
MODEL = tiny_model(memory=MEMORY)
KEY = jax.random.key(7)
plant = jax.jit(perturbation.plant_errors, static_argnums=(0, 1))


@functools.cache
def shown():
    """A readout of every part, and cameras; half of each image shows nothing."""
    rng, size = np.random.default_rng(0), (BATCH, FRAMES, HEIGHT, WIDTH)
    seen = np.broadcast_to(np.arange(WIDTH) < WIDTH // 2, size)
    depth = np.where(seen, rng.uniform(1, 4, size), 0).astype(np.float32)
    colours = np.where(seen[..., None], rng.uniform(-1, 1, (*size, 3)), 0).astype(np.float32)
    points = rng.normal(size=(BATCH, 10, 6)).astype(np.float32)
    tokens = MapTokens(points[..., 3:], points[..., :3], np.ones((BATCH, 10), bool))
    latents = rng.normal(size=(BATCH, FRAMES, 4, 6, 5)).astype(np.float32)
    readout = MemoryReadout(tokens, View(colours, depth, seen), EncodedView(latents, seen))
    camera = [random_camera(rng, FRAMES, HEIGHT, WIDTH) for _ in range(BATCH)]
    whole = readout, jax.tree.map(lambda *x: np.stack(x), *camera)
    return jax.tree.map(jnp.asarray, whole)


def differs(a, b):
    """Which clips of a batch differ in any leaf."""
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return np.any([np.any(np.asarray(x) != y, tuple(range(1, x.ndim))) for x, y in leaves], 0)


@pytest.mark.slow
def test_the_share_of_clips_that_get_errors():
    readout, camera = shown()
    assert not differs(plant(MODEL, 0.0, readout, camera, KEY), readout).any()
    assert differs(plant(MODEL, 1.0, readout, camera, KEY), readout).sum() >= BATCH - 1
    keys = jax.random.split(KEY, 30)
    counts = [differs(plant(MODEL, 0.5, readout, camera, key), readout).sum() for key in keys]
    assert 0.35 < np.mean(counts) / BATCH < 0.6


def test_errors_are_a_function_of_the_key():
    readout, camera = shown()
    first, again = (plant(MODEL, 1.0, readout, camera, KEY) for _ in range(2))
    assert not differs(first, again).any()
    other = plant(MODEL, 1.0, readout, camera, jax.random.key(8))
    assert differs(first, other).all()


def test_views_stay_views():
    readout, camera = shown()
    for key in jax.random.split(KEY, 8):
        view = plant(MODEL, 1.0, readout, camera, key).view
        assert np.abs(view.features_THWF).max() <= 1
        assert (np.asarray(view.features_THWF)[~np.asarray(view.seen_THW)] == 0).all()
        assert (np.asarray(view.depth_THW)[np.asarray(view.seen_THW)] > 0).all()
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(view))


def test_nothing_appears_where_a_hidden_memory_shows_nothing():
    readout, camera = shown()
    view = dataclasses.replace(readout.view, seen_THW=jnp.zeros_like(readout.view.seen_THW))
    hidden = dataclasses.replace(readout, view=view)
    for key in jax.random.split(KEY, 4):
        assert not plant(MODEL, 1.0, hidden, camera, key).view.seen_THW.any()


def test_a_cell_of_the_world_has_the_same_error_in_every_frame():
    points = np.random.default_rng(0).uniform(-3, 3, (1, 4, 5, 3)).astype(np.float32)
    twice = jnp.asarray(np.concatenate([points, points[:, ::-1]]))
    drawn = perturbation._per_cell(KEY, twice, 2)
    np.testing.assert_array_equal(drawn[0], drawn[1][::-1])
    many = np.random.default_rng(1).uniform(-50, 50, (1, 100, 100, 3)).astype(np.float32)
    values = np.asarray(perturbation._per_cell(KEY, jnp.asarray(many), 2)).reshape(-1, 2)
    assert 0 <= values.min() <= values.max() <= 1
    np.testing.assert_allclose(values.mean(0), 0.5, atol=0.02)
    assert abs(np.corrcoef(values.T)[0, 1]) < 0.05


def flat(depth_m, frames=4, size=32):
    """A wall parallel to the image, and its cameras."""
    shape = (frames, size, size)
    colours = jnp.zeros((*shape, 3))
    view = View(colours, jnp.full(shape, depth_m, jnp.float32), jnp.ones(shape, bool))
    intrinsics = np.tile(cameras.intrinsics_from_fov(size, size, 90.0), (frames, 1))
    return view, Camera(jnp.asarray(intrinsics), jnp.tile(jnp.eye(4), (frames, 1, 1)))


def test_the_noise_of_depth_cameras_grows_with_the_square_of_depth():
    def deviation(depth_m):
        view, camera = flat(depth_m)
        return float(jnp.std(perturbation._sensor(view, None, camera, KEY).depth_THW))

    near, far = deviation(1.0), deviation(4.0)
    assert 0 < near <= 1.3 * perturbation.QUADRATIC
    np.testing.assert_allclose(far / near, 16, rtol=0.02)


def test_depth_cameras_miss_pixels_at_edges_alone():
    view, camera = flat(1.0)
    depth = view.depth_THW.at[:, :, 16:].set(3.0)
    view = dataclasses.replace(view, depth_THW=depth)
    found = np.zeros(32, bool)
    for key in jax.random.split(KEY, 6):
        found |= ~np.asarray(perturbation._sensor(view, None, camera, key).seen_THW).all((0, 1))
    assert found[14:18].any()
    assert not found[:12].any()
    assert not found[20:].any()


def test_exposure_differs_from_frame_to_frame():
    view, camera = flat(2.0)
    view = dataclasses.replace(view, features_THWF=view.features_THWF + 0.2)
    colours = np.asarray(perturbation._sensor(view, None, camera, KEY).features_THWF)
    assert (colours.std((1, 2, 3)) < 1e-6).all()
    assert len(np.unique(colours[:, 0, 0, 0])) == len(colours)


@pytest.mark.parametrize("part", ["tokens", "encoded"])
def test_tokens_and_latents_get_errors_too(part):
    readout, camera = shown()
    alone = MemoryReadout(**{part: getattr(readout, part)})
    found = [plant(MODEL, 1.0, alone, camera, key) for key in jax.random.split(KEY, 4)]
    assert any(differs(one, alone).any() for one in found)
    mask = {"tokens": "valid_M", "encoded": "seen_THW"}[part]
    before = np.asarray(getattr(getattr(alone, part), mask))
    after = [np.asarray(getattr(getattr(one, part), mask)) for one in found]
    assert not any((new & ~before).any() for new in after)
    assert any((before & ~new).any() for new in after)


def test_worlds_without_a_memory_refuse_it():
    for kind in (EgoWMTrainConfig, PersistTrainConfig):
        with pytest.raises(ConfigError, match=r"train\.memory_errors is 0\.5"):
            kind(memory_errors=0.5)
    with pytest.raises(ConfigError, match=r"train\.memory_errors"):
        TrainConfig(memory_errors=1.5)
