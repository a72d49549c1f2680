"""The two stages on the real model: what is trained, what is kept, what freezing saves."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from pewm_jax import presets as configs
from pewm_jax.io import tree
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.readers.render import RenderConfig
from pewm_jax.train import sharding, step
from pewm_jax.types import Clip
from pewm_jax.worlds import world_model
from pewm_jax.worlds.pewm.world import STAGES
from pewm_jax.worlds.stages import TRAIN
from tests.helpers import random_frames, random_world, with_reader

TWO = STAGES[1]
EVERYTHING = dataclasses.replace(TWO, rules=((r".*", TRAIN),))


def small():
    """A backbone that is large beside its memory blocks, as CogVideoX beside the paper's."""
    config = configs.load("tiny")
    wide = DiTBackbone(layers=1, heads=16, head_dim=32, text_length=1, text_dim=8, time_dim=16)
    return config.with_model(backbone=wide, memory=with_reader(config.model, mlp_ratio=1).memory)


CONFIG = small()
CLIP = jax.tree.map(
    lambda x: np.stack([x, x]),
    Clip(
        random_frames(np.random.default_rng(0), CONFIG.model.clip.frames, 16, 16),
        random_frames(np.random.default_rng(1), CONFIG.data.context, 16, 16),
        np.ones(CONFIG.data.context, bool),
    ),
)


def one_device():
    return sharding.make_mesh(jax.devices()[:1])


def parameters(config):
    return jax.eval_shape(functools.partial(world_model.init, config.model), jax.random.key(0))


def compiled(stage):
    lowered = step.trace_step(CONFIG, stage, one_device(), CLIP).lower()
    return lowered.compile()


@pytest.fixture(scope="module")
def stage_2():
    return compiled(TWO)


@pytest.mark.slow
def test_a_step_of_stage_2_costs_at_most_three_quarters_of_training_everything(stage_2):
    """The same shape, and both compiled; a scanned body counts once in both."""
    everything = compiled(EVERYTHING)
    assert stage_2.cost_analysis()["flops"] <= 0.75 * everything.cost_analysis()["flops"]


def test_frozen_leaves_stay_bit_identical_and_only_trained_ones_have_moments(stage_2):
    start = random_world(CONFIG, memory=False)
    now = step.initial_state(CONFIG, TWO, one_device(), start)
    before = jax.tree.map(np.array, now)
    clip = jax.device_put(CLIP, sharding.of_batch(one_device()))
    key = step.noise_key(CONFIG, TWO)
    for _ in range(3):
        now, _ = stage_2(now, clip, key)
    after, start = tree.flatten(now.params), tree.flatten(before.params)
    moved = {path for path in after if np.asarray(after[path]).tobytes() != start[path].tobytes()}
    assert moved
    assert all(path.startswith("memory/") for path in moved)
    assert any("/attention/to_v/" in path for path in moved)
    trained = tree.flatten(tree.select(before.params, TWO.trained))
    moments = tree.flatten(now.opt_state)
    for name in ("mu", "nu"):
        assert {path.split(f"/{name}/")[1] for path in moments if f"/{name}/" in path} == set(
            trained
        )
    assert all("backbone/" not in path for path in moments)


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_every_leaf_has_a_rule_and_one_without_fails(stage):
    params = parameters(CONFIG)
    if not stage.memory:
        params = tree.exclude(params, (r"memory/.*",))
    if stage.name == "gate":
        params["codec"] = {"gate": {"kernel": 0}, "decoder": {"kernel": 0}}
    labels = tree.flatten(stage.labels(params))
    trained, frozen = tree.split(params, stage.trained)
    train = {path for path, label in labels.items() if label == TRAIN}
    assert tree.flatten(trained).keys() == train
    assert tree.flatten(frozen).keys() == labels.keys() - train
    with pytest.raises(tree.TreeError, match="matches memroy/gate"):
        stage.labels({**params, "memroy": {"gate": 0}})
    fewer = dataclasses.replace(stage, rules=stage.rules[:1])
    if frozen:
        with pytest.raises(tree.TreeError, match="matches backbone/"):
            fewer.labels(params)


@pytest.mark.slow
def test_stage_2_learns_from_pictures_and_changes_nothing_but_the_reader():
    """The clips are what was seen before, so that the pictures show the answer."""
    tiny = configs.load("tiny")
    seen = SurfelConfig(reader=RenderConfig(), capacity=4096, tokens=16, footprint=2)
    stage = dataclasses.replace(tiny.train.stage2, steps=12, learning_rate=1e-2, warmup=0, batch=2)
    config = dataclasses.replace(
        tiny.with_model(memory=seen), train=dataclasses.replace(tiny.train, stage2=stage)
    )
    frames = CLIP.frames
    valid = np.ones(frames.depth_THW.shape[:2], bool)
    clip = dataclasses.replace(CLIP, context=frames, context_valid_S=valid)
    mesh = one_device()
    start = {"backbone": random_world(config, memory=False, scale=0.05)["backbone"]}
    state = step.initial_state(config, TWO, mesh, start)
    before = jax.tree.map(np.array, state.params)  # copies: the step takes the buffers
    run = step.compile_step(config, TWO, mesh, clip)
    key, losses = step.noise_key(config, TWO), []
    for _ in range(12):  # the same noise at every step
        same = dataclasses.replace(state, step=jax.numpy.zeros_like(state.step))
        state, metrics = run(same, clip, key)
        losses.append(float(metrics["loss"]))
    assert losses[-1] < 0.96 * losses[0]
    old, new = tree.flatten(before), tree.flatten(jax.tree.map(np.asarray, state.params))
    for path, leaf in new.items():
        if path.startswith("memory/"):
            assert not np.array_equal(leaf, old[path]), path
        else:
            np.testing.assert_array_equal(leaf, old[path], err_msg=path)
