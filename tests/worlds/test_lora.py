"""Adapters and 8-bit weights on every network: deferred weights give what whole ones give."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import presets, worlds
from pewm_jax.config import Config, DataConfig, LoRAConfig, UserError
from pewm_jax.data import abstract
from pewm_jax.io import tree
from pewm_jax.nn.deferred import Deferred, LowRank, Quantized
from pewm_jax.train import runs
from pewm_jax.worlds import lora, quantized
from pewm_jax.worlds.egowm.world import EgoWMTrainConfig
from pewm_jax.worlds.persist.config import PersistTrainConfig
from tests.examples import parts
from tests.helpers import random_camera, randomise
from tests.train import test_cosmos, test_egowm
from tests.worlds.persist import tiny_persist

ADAPT = LoRAConfig(rank=2, alpha=4.0, target=r".*kernel")
EGO = EgoWMTrainConfig(lora=ADAPT)
KEY = jax.random.key(0)


def experiments():
    tiny = presets.load("tiny")
    train = dataclasses.replace(tiny.train, lora=ADAPT)
    every = dataclasses.replace(ADAPT, target=r".*")
    plugin = parts.experiment()
    return {
        "cogvideox": dataclasses.replace(tiny, train=train),
        "svd": Config(model=test_egowm.SVD, data=DataConfig(context=1), train=EGO),
        "cosmos": Config(model=test_cosmos.MODEL, data=DataConfig(context=1), train=EGO),
        "persist": Config(
            model=tiny_persist.MODEL,
            data=DataConfig(context=1),
            train=PersistTrainConfig(lora=ADAPT),
        ),
        "plugin": dataclasses.replace(plugin, train=dataclasses.replace(plugin.train, lora=every)),
    }


def clip(config, batch=1, seed=0):
    """Return a batch of random numbers with rigid poses."""
    rng = np.random.default_rng(seed)
    like = abstract.clip(config, batch)

    def fill(leaf):
        if leaf.dtype == np.bool_:
            return np.ones(leaf.shape, bool)
        if np.issubdtype(leaf.dtype, np.integer):
            return rng.integers(0, 3, leaf.shape).astype(leaf.dtype)
        return rng.uniform(0.5, 1.5, leaf.shape).astype(leaf.dtype)

    def posed(frames):
        *lead, height, width = frames.depth_THW.shape
        if not np.prod(lead):
            return frames
        cameras = random_camera(rng, int(np.prod(lead)), height, width, upright=True)
        cameras = jax.tree.map(
            lambda x: np.asarray(x, np.float32).reshape(*lead, *x.shape[1:]), cameras
        )
        return dataclasses.replace(frames, camera=cameras)

    made = jax.tree.map(fill, like)
    return dataclasses.replace(made, frames=posed(made.frames), context=posed(made.context))


CASES = [
    ("cogvideox", "stage1"),
    ("cogvideox", "stage2"),
    pytest.param("cogvideox", "joint", marks=pytest.mark.slow),
    pytest.param("svd", "adapt", marks=pytest.mark.slow),
    pytest.param("cosmos", "adapt", marks=pytest.mark.slow),
    pytest.param("plugin", "stage1", marks=pytest.mark.slow),
    pytest.param("plugin", "stage2", marks=pytest.mark.slow),
]


def both(name, stage_name):
    config = experiments()[name]
    known = worlds.stages(config.model)
    number = [stage.name for stage in known].index(stage_name)
    return config, known[number], lora.adapt(config, known)[number]


@pytest.mark.slow(only="stage2")
@pytest.mark.parametrize(("name", "stage_name"), CASES)
def test_loss_and_gradient_are_those_of_the_sums(name, stage_name):
    config, plain, adapted = both(name, stage_name)
    init = jax.jit(functools.partial(adapted.init, config.model))
    params = randomise(init(KEY), scale=0.1)
    trained, frozen = tree.split(params, adapted.trained)
    assert {path.split("/")[0] for path in tree.flatten(trained)} == {lora.ROOT}
    batch = jax.tree.map(jnp.asarray, clip(config))

    def deferred(trained):
        return adapted.loss(config.model, config.train, tree.merge(trained, frozen), batch, KEY)[0]

    def whole(trained):
        params = tree.merge(trained, frozen)
        leaves = tree.flatten({name: x for name, x in params.items() if name != lora.ROOT})
        for path, a, b in lora.adapters_of(params):
            leaves[path] = LowRank(leaves[path], a, b, ADAPT.scale).unbox()
        return plain.loss(config.model, config.train, tree.unflatten(leaves), batch, KEY)[0]

    mine, theirs = (jax.jit(jax.value_and_grad(f))(trained) for f in (deferred, whole))
    assert np.isfinite(mine[0])
    np.testing.assert_allclose(mine[0], theirs[0], rtol=1e-5)
    for path, found in tree.flatten(mine[1]).items():
        wanted = tree.flatten(theirs[1])[path]
        size = np.abs(wanted).max()
        np.testing.assert_allclose(found, wanted, atol=1e-4 * size + 1e-9, err_msg=path)
    assert any(np.abs(x).max() > 0 for x in jax.tree.leaves(mine[1]))


def test_every_stage_of_persist_takes_adapters():
    config = experiments()["persist"]
    for stage in runs.all_stages(config):
        params = jax.eval_shape(functools.partial(stage.init, config.model), KEY)
        batch = abstract.clip(config, 1)
        if stage.prepare is not None:
            prepare = functools.partial(stage.prepare, config.model)
            batch = jax.eval_shape(prepare, params, batch)
        run = functools.partial(stage.loss, config.model, config.train)
        assert jax.eval_shape(run, params, batch, KEY)[0].shape == ()
        bound = lora.bind(config.model, ADAPT, params)
        nodes = jax.tree.leaves(bound, is_leaf=lambda x: isinstance(x, Deferred))
        assert any(isinstance(node, Deferred) for node in nodes)


def test_networks_of_other_packages_get_whole_weights():
    config, _, stage = both("plugin", "stage2")
    params = jax.eval_shape(functools.partial(stage.init, config.model), KEY)
    bound = jax.eval_shape(functools.partial(lora.bind, config.model, ADAPT), params)
    nodes = jax.tree.leaves(bound["backbone"], is_leaf=lambda x: isinstance(x, Deferred))
    assert not any(isinstance(node, Deferred) for node in nodes)


def test_only_what_an_asked_stage_trains_is_adapted():
    config = experiments()["cogvideox"]
    one, two = runs.planned(config)
    first = set(one.stored)
    assert all(path.startswith("lora/backbone/") for path in first)
    assert {path.split("/")[1] for path in two.stored} == {"backbone", "memory"}
    train = dataclasses.replace(
        config.train, stage1=dataclasses.replace(config.train.stage1, steps=0), start="somewhere"
    )
    (alone,) = runs.planned(dataclasses.replace(config, train=train))
    assert {path.split("/")[1] for path in alone.stored} == {"memory"}


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["int8", "fp8"])
def test_quantized_weights_imagine_nearly_the_same(precision):
    config = experiments()["cogvideox"]
    stage = worlds.stages(config.model)[1]
    params = jax.jit(functools.partial(stage.init, config.model))(KEY)
    params = jax.device_get(randomise(params, scale=0.05))
    small = quantized.quantize(config.model, params, precision)
    leaves = jax.tree.leaves(small, is_leaf=lambda x: isinstance(x, Deferred))
    count = sum(isinstance(leaf, Quantized) for leaf in leaves)
    assert count > 10
    assert quantized.bytes_of(small) < 0.5 * quantized.bytes_of(params)
    batch = clip(config)
    frames = jax.tree.map(lambda x: x[0], batch.context)
    actions = np.zeros(4, np.int32)
    seen = []
    for weights in (params, small):
        state = worlds.start(config, weights, frames)
        seen.append(worlds.imagine(config, weights, state, actions, KEY)[1])
    away = np.abs(np.asarray(seen[0].rgb_THWC) - np.asarray(seen[1].rgb_THWC))
    assert 0 < away.mean() < 0.02


def test_precisions_without_effect_are_refused():
    plugin = experiments()["plugin"]
    params = {"backbone": {"kernel": np.zeros((4, 4), np.float32)}}
    with pytest.raises(UserError, match="none of the weights can be kept in 8 bits"):
        quantized.quantize(plugin.model, params, "int8")
    with pytest.raises(UserError, match="choose one of 'int8', 'fp8'"):
        quantized.quantize(plugin.model, params, "int4")
    assert quantized.quantize(plugin.model, params, "") is params
