"""Muon: which leaves it changes and how, what stays still, and that a stopped run goes on."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import presets as configs
from pewm_jax.io import tree
from pewm_jax.train import optimizer
from pewm_jax.train.signals import Interrupted
from pewm_jax.worlds.pewm.world import STAGES
from pewm_jax.worlds.stages import TRAIN
from tests.train import fakes
from tests.train.test_loop import StopAt, file_bytes, losses, train
from tests.train.test_step import run

FIRST_AND_LAST = ("patch_embed", "text_embed", "proj_out", "modulate_out", "embed_1", "tokens")
"""Of the matrices, those that read the inputs or make the outputs."""


@functools.cache
def shapes(name, stage):
    return jax.eval_shape(
        functools.partial(stage.init, configs.load(name).model), jax.random.key(0)
    )


def moments(state):
    """Return the paths of the leaves that have moments, of Muon and of Adam."""
    paths = tree.flatten(state)
    return {
        name: {p.rpartition("/mu/")[2] for p in paths if f"/{name}/" in p and "/mu/" in p}
        for name in ("muon", "adam")
    }


@pytest.mark.parametrize("name", ["tiny", "demo", "pewm_2b"])
@pytest.mark.parametrize("stage", STAGES[:3], ids=lambda stage: stage.name)
def test_every_trained_leaf_has_exactly_one_of_the_two(name, stage):
    config = fakes.with_train(configs.load(name), optimizer="muon")
    params = shapes(name, stage)
    of = moments(jax.eval_shape(optimizer.make(config, stage).init, params))
    labels = tree.flatten(stage.labels(params))
    trained = {path for path, label in labels.items() if label == TRAIN}
    assert of["muon"].isdisjoint(of["adam"])
    assert of["muon"] | of["adam"] == trained
    for path in of["muon"]:
        leaf = tree.flatten(params)[path]
        assert path.endswith("/kernel"), path
        assert leaf.ndim == 2 + ("blocks" in path.split("/")), path
        assert not set(path.split("/")) & set(FIRST_AND_LAST), path
    wide = {p for p in trained if p.endswith(("to_q/kernel", "up/kernel", "linear/kernel"))}
    assert wide
    assert wide <= of["muon"]


def test_an_update_is_orthogonal_layer_by_layer_and_as_large_as_adams():
    rng = np.random.default_rng(0)
    like = {
        "blocks": {"to_q": {"kernel": (3, 16, 40), "bias": (3, 40)}},
        "convolution": {"kernel": (3, 3, 4, 8)},
        "proj_out": {"kernel": (8, 8)},
    }
    params = {"backbone": jax.tree.map(jnp.zeros, like, is_leaf=lambda x: isinstance(x, tuple))}
    gradients = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype), params)
    louder = jax.tree.map(jnp.copy, gradients)
    kernel = louder["backbone"]["blocks"]["to_q"]["kernel"]
    louder["backbone"]["blocks"]["to_q"]["kernel"] = kernel.at[1].multiply(100.0)
    config = fakes.config(optimizer="muon", clip_norm=1e9)
    rate = float(optimizer.schedule(config.train.stage1)(0))

    @jax.jit
    def first(gradients):
        muon = optimizer.make(config, STAGES[0])
        return muon.update(gradients, muon.init(params), params)[0]["backbone"]

    one, two = first(gradients), first(louder)
    stacked = np.asarray(one["blocks"]["to_q"]["kernel"])
    np.testing.assert_allclose(two["blocks"]["to_q"]["kernel"], stacked, rtol=1e-3, atol=1e-6)
    matrices = [*stacked, np.asarray(one["convolution"]["kernel"]).reshape(36, 8)]
    for update in matrices:
        values = np.linalg.svd(update / rate, compute_uv=False) / np.sqrt(max(update.shape))
        assert np.all((values > 0.6 * optimizer.MUON_RMS) & (values < 1.3 * optimizer.MUON_RMS))
    for update in (one["blocks"]["to_q"]["bias"], one["proj_out"]["kernel"]):  # Adam's first step
        np.testing.assert_allclose(np.abs(update), rate, rtol=1e-4)


def test_frozen_leaves_stay_bit_identical_and_all_others_move(fake_model):
    config = fakes.config(optimizer="muon", weight_decay=0.1)
    start = fakes.init(config, jax.random.key(9), memory=False)
    before, history, _ = run(config, fakes.STAGES[1], 3, start)
    old, new = (tree.flatten(state.params) for state in (before, history[-1]))
    for path, leaf in new.items():
        assert (leaf.tobytes() == old[path].tobytes()) == path.startswith("backbone/"), path
    of = moments(history[-1].opt_state)
    assert of == {"muon": {"memory/kernel"}, "adam": {"memory/gate"}}


def two_stages(folder, **train):
    config = fakes.config(folder, stage1=4, stage2=0, optimizer="muon", **train)
    return fakes.with_stage(config, "joint", steps=4, batch=8, warmup=1, learning_rate=1e-2)


@pytest.mark.slow
def test_a_run_stopped_twice_goes_on_bit_identically(fake_model, tmp_path):
    train(two_stages(tmp_path / "undisturbed"))
    config = two_stages(tmp_path / "stopped", preview_every=1)
    for stage, step in ((1, 2), (3, 3)):
        with pytest.raises(Interrupted):
            train(config, preview=StopAt(stage, step))
    train(config)
    assert losses(tmp_path / "stopped") == losses(tmp_path / "undisturbed")
    assert file_bytes(tmp_path / "stopped") == file_bytes(tmp_path / "undisturbed")
