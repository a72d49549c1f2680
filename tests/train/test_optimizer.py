"""The learning rate, the clipping, the decay, and who pays for moments."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from pewm_jax.config import ConfigError, StageConfig
from pewm_jax.nn import target
from pewm_jax.train import optimizer, runs
from pewm_jax.worlds.pewm import world as pewm
from tests.train import fakes

PARAMS = {"backbone": {"dense": {"kernel": jnp.full((4, 4), 2.0), "bias": jnp.full((4,), 2.0)}}}


def test_warmup_starts_above_zero_rises_to_the_peak_and_the_cosine_falls_to_zero():
    rate = optimizer.schedule(StageConfig(steps=100, warmup=10, learning_rate=1.0))
    values = np.array([float(rate(step)) for step in range(101)])
    assert 0 < values[0] < 0.2
    assert np.all(np.diff(values[:11]) > 0)
    assert values[10] == pytest.approx(1.0)
    assert np.all(np.diff(values[10:]) < 0)
    assert values[100] == pytest.approx(0.0, abs=1e-6)
    assert values[55] == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize("decay", ["constant", "cosine"])
@pytest.mark.parametrize(("steps", "warmup"), [(1, 0), (1, 50), (5, 5), (50, 0)])
def test_short_stages_have_a_usable_rate_at_every_step(decay, steps, warmup):
    settings = StageConfig(steps=steps, warmup=warmup, decay=decay, learning_rate=1e-3)
    values = [float(optimizer.schedule(settings)(step)) for step in range(steps)]
    assert all(0 < value <= 1e-3 * (1 + 1e-6) for value in values)


def test_only_matrices_decay():
    config = fakes.with_train(fakes.config(), weight_decay=0.1)
    adam = optimizer.make(config, pewm.STAGES[0])
    still = jax.tree.map(jnp.zeros_like, PARAMS)
    updates, _ = adam.update(still, adam.init(PARAMS), PARAMS)
    dense = updates["backbone"]["dense"]
    assert np.all(np.asarray(dense["kernel"]) < 0)
    np.testing.assert_array_equal(dense["bias"], 0)


def test_gradients_beyond_the_norm_are_scaled_down_together():
    config = fakes.config(clip_norm=1.0)
    adam = optimizer.make(config, pewm.STAGES[0])
    rng = np.random.default_rng(0)
    small = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), PARAMS)
    norm = np.sqrt(sum(np.sum(np.square(leaf)) for leaf in jax.tree.leaves(small)))
    unit = jax.tree.map(lambda leaf: leaf / norm, small)
    huge = jax.tree.map(lambda leaf: leaf * 1e4, unit)
    moments = [adam.update(g, adam.init(PARAMS), PARAMS)[1] for g in (unit, huge)]
    for left, right in zip(*map(jax.tree.leaves, moments), strict=True):
        np.testing.assert_allclose(left, right, rtol=1e-4)


def test_frozen_leaves_have_no_moments_no_update_and_no_say_in_the_clipping():
    params = {"backbone": {"kernel": jnp.ones((2, 2))}, "memory": {"kernel": jnp.ones((3, 3))}}
    adam = optimizer.make(fakes.config(clip_norm=1.0), pewm.STAGES[1])
    state = adam.init(params)
    assert {leaf.shape for leaf in jax.tree.leaves(state)} == {(), (3, 3)}
    quiet = jax.tree.map(lambda leaf: 0.1 * leaf, params)
    loud = {**quiet, "backbone": {"kernel": jnp.full((2, 2), 1e6)}}
    for gradients in (quiet, loud):
        updates, after = adam.update(gradients, state, params)
        np.testing.assert_array_equal(updates["backbone"]["kernel"], 0)
        moments = sorted(float(leaf.max()) for leaf in jax.tree.leaves(after) if leaf.ndim)
        np.testing.assert_allclose(moments, [0.001 * 0.01, 0.1 * 0.1], rtol=1e-5)


def test_a_stage_may_learn_faster_at_some_paths():
    stage = dataclasses.replace(pewm.STAGES[0], rates=((r".*/bias", 10.0),))
    config = fakes.config()
    gradients = jax.tree.map(lambda leaf: 0.1 * leaf, PARAMS)
    plain, fast = (optimizer.make(config, s) for s in (pewm.STAGES[0], stage))
    one, ten = (
        adam.update(gradients, adam.init(PARAMS), PARAMS)[0]["backbone"]["dense"]
        for adam in (plain, fast)
    )
    np.testing.assert_allclose(ten["bias"], 10 * one["bias"], rtol=1e-6)
    np.testing.assert_array_equal(ten["kernel"], one["kernel"])


def test_nothing_to_train_is_refused_and_empty_stages_are_skipped():
    with pytest.raises(ConfigError, match="both 0"):
        runs.planned(fakes.config(stage1=0, stage2=0))
    assert [s.number for s in runs.planned(fakes.config(stage2=0))] == [1]
    assert [s.number for s in runs.planned(fakes.config())] == [1, 2]


def test_fewer_products_on_a_cpu_give_the_updates_of_optax():
    rng = np.random.default_rng(0)
    shapes = {
        "blocks": {name: {"kernel": (2, *shape)} for name, shape in
                   (("wide", (16, 64)), ("long", (64, 16)), ("square", (24, 24)))},
        "convolution": {"kernel": (3, 3, 8, 16)},
    }  # fmt: skip
    gradients = jax.tree.map(
        lambda shape: jnp.asarray(rng.normal(size=shape), jnp.float32),
        shapes,
        is_leaf=lambda x: isinstance(x, tuple),
    )
    found = []
    for platform in ("cuda", "cpu"):
        with target.use(target.Target(platform)):
            muon = optimizer.muon(optax.scale_by_adam())
            state = muon.init(gradients)
            found.append(jax.jit(muon.update)(gradients, state, gradients))
    (expected, expected_state), (updates, state) = found
    assert jax.tree.structure(state) == jax.tree.structure(expected_state)
    for left, right in zip(*map(jax.tree.leaves, (updates, expected)), strict=True):
        largest = float(np.abs(right).max())
        np.testing.assert_allclose(left, right, atol=1e-4 * largest)
