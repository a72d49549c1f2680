"""The optional third stage: backbone and memory learn on together, from where stage 2 ended."""

import dataclasses

import jax
import numpy as np

from pewm_jax import presets as configs
from pewm_jax.io import tree, weights
from pewm_jax.train import loop, runs, sharding
from pewm_jax.worlds.pewm import world as pewm
from pewm_jax.worlds.stages import TRAIN
from tests.train import fakes

JOINT = pewm.STAGES[2]


def with_codec(stage):
    """The fake stage, with a codec that none of them trains."""

    def init(model, key):
        return {**stage.init(model, key), "codec": {"kernel": jax.random.normal(key, (2, 2))}}

    return dataclasses.replace(stage, init=init)


def test_joint_starts_from_the_weights_of_stage_2_and_leaves_the_codec(
    fake_model, tmp_path, monkeypatch
):
    monkeypatch.setattr(pewm, "STAGES", tuple(map(with_codec, pewm.STAGES)))
    known = pewm.PEWM.sharding
    rules = ((r"codec/kernel", sharding.WHOLE),)
    monkeypatch.setattr(pewm.PEWM, "sharding", lambda model: (*rules, *known(model)))
    starts, make = {}, loop.initial_state

    def noting(config, stage, mesh, start):
        state = make(config, stage, mesh, start)
        starts[stage.name] = jax.tree.map(np.array, state.params)
        return state

    monkeypatch.setattr(loop, "initial_state", noting)
    config = fakes.config(tmp_path / "two", stage1=3, stage2=3)
    loop.train(config, log=lambda _: None)
    assert set(starts) == {"stage1", "stage2"}
    two = tree.flatten(weights.load(tmp_path / "two" / "weights.safetensors"))
    config = fakes.config(tmp_path / "three", stage1=3, stage2=3)
    config = fakes.with_stage(config, "joint", steps=3, batch=8, warmup=1, learning_rate=1e-2)
    loop.train(config, log=lambda _: None)
    begun = tree.flatten(starts["joint"])
    ended = tree.flatten(weights.load(tmp_path / "three" / "weights.safetensors"))
    assert begun.keys() == two.keys() == ended.keys()
    for path, leaf in begun.items():
        assert leaf.tobytes() == two[path].tobytes(), path
        assert (ended[path].tobytes() == leaf.tobytes()) == path.startswith("codec/"), path
    told = weights.metadata(tmp_path / "three" / "weights.safetensors")
    assert told == {"stage": "3", "step": "3"}


def test_joint_trains_backbone_and_memory_and_not_the_codec_with_its_gate():
    params = jax.eval_shape(
        lambda key: JOINT.init(configs.load("demo").model, key), jax.random.key(0)
    )
    labels = tree.flatten(JOINT.labels(params))
    assert any(path.startswith("codec/gate/") for path in labels)
    for path, label in labels.items():
        assert (label == TRAIN) == path.startswith(("backbone/", "memory/")), path


def test_optional_stages_are_left_out_without_steps():
    config = configs.load("demo")
    assert [stage.name for stage in runs.planned(config)] == ["stage1", "stage2"]
    config = fakes.with_stage(config, "joint", steps=1)
    assert [stage.name for stage in runs.planned(config)] == ["stage1", "stage2", "joint"]
    config = fakes.with_stage(config, "stage2", steps=0)
    assert [stage.name for stage in runs.planned(config)] == ["stage1", "joint"]
