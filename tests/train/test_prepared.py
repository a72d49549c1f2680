"""Clips that are prepared once give the same loss as those of every step, and are all drawn."""

import dataclasses
import itertools

import jax
import numpy as np
import pytest

from pewm_jax import worlds
from pewm_jax.train import feed
from pewm_jax.types import Clip
from tests.helpers import random_frames, random_world, tiny_config


def a_batch(config, rows):
    """Clips at random, with a context."""
    size, slots = config.model.clip, 3

    def one(seed):
        rng = np.random.default_rng(seed)
        frames = random_frames(rng, size.frames, size.height, size.width)
        context = random_frames(rng, slots, size.height, size.width)
        return Clip(frames, context, np.ones(slots, bool))

    return jax.tree.map(lambda *x: np.stack(x), *(one(seed) for seed in range(rows)))


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1])
def test_a_prepared_batch_has_the_same_loss_without_its_context(number):
    config = tiny_config()
    params = random_world(config.model)
    clip = a_batch(config, 3)
    stage = worlds.stages(config)[number]
    ready = jax.device_get(jax.jit(lambda p, c: stage.prepare(config.model, p, c))(params, clip))
    assert ready.context.depth_THW.size == 0
    key = jax.random.key(1)
    loss = jax.jit(lambda p, c: stage.loss(config.model, config.train, p, c, key)[0])
    np.testing.assert_allclose(loss(params, ready), loss(params, clip), rtol=1e-5)


def test_every_clip_comes_once_before_any_comes_again():
    clips = [{"x": np.arange(8)}, {"x": np.arange(8, 12)}]
    batches = [b["x"] for b in itertools.islice(feed.draw_prepared(clips, 4, seed=3), 6)]
    for epoch in (batches[:3], batches[3:]):
        assert sorted(np.concatenate(epoch)) == list(range(12))
    assert not np.array_equal(batches[0], batches[3])


def test_batches_go_on_where_they_stopped():
    clips = [{"x": np.arange(5)}, {"x": np.arange(5, 10)}]
    whole = [b["x"] for b in itertools.islice(feed.draw_prepared(clips, 4, seed=3), 7)]
    after = [b["x"] for b in itertools.islice(feed.draw_prepared(clips, 4, seed=3, start=5), 2)]
    np.testing.assert_array_equal(whole[5:], after)


def test_the_rows_of_a_batch_can_be_named():
    config = tiny_config()
    config = dataclasses.replace(config, data=dataclasses.replace(config.data, prepared=9))
    stage = worlds.stages(config)[0]
    batch = stage.settings(config).batch
    count = -(-9 // batch) * batch
    drawn = feed.draw_prepared([{"x": np.arange(count)}], batch, stage.data_seed(config))
    third = next(itertools.islice(drawn, 2, None))["x"]
    assert feed.prepared_rows(config, stage, 2) == list(third)
