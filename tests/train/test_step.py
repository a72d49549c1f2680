"""One step: what moves, what stays bit-identical, what is averaged, what it costs."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import presets as configs
from pewm_jax.config import AXES, ConfigError, UserError
from pewm_jax.io import tree
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.train import optimizer, sharding, step
from pewm_jax.train import step as state
from pewm_jax.worlds import world_model
from pewm_jax.worlds.pewm import world as pewm
from pewm_jax.worlds.stages import TRAIN
from tests.train import fakes

ONE, TWO = fakes.STAGES[:2]
REAL = pewm.STAGES[1]


def run(config, stage, steps, start=None):
    """Run the compiled step; returns the state before, the state after and the losses."""
    mesh = sharding.make_mesh(jax.devices()[:1])
    batch = stage.settings(config).batch
    now = step.initial_state(config, stage, mesh, start)
    before = jax.tree.map(np.array, now)
    step_fn = step.compile_step(config, stage, mesh, fakes.clip(config, batch, 0))
    key = step.noise_key(config, stage)
    history, losses = [], []
    for number in range(steps):
        placed = jax.device_put(fakes.clip(config, batch, number), sharding.of_batch(mesh))
        now, metrics = step_fn(now, placed, key)
        history.append(jax.tree.map(np.array, now))
        losses.append(float(metrics["loss"]))
    return before, history, losses


def test_stage_1_has_no_memory_and_moves_everything(fake_model):
    before, history, losses = run(fakes.config(), ONE, 6)
    assert set(before.params) == {"backbone"}
    for path, leaf in tree.flatten(before.params).items():
        assert not np.array_equal(leaf, tree.flatten(history[-1].params)[path]), path
    assert losses[-1] < losses[0]
    assert history[-1].step == 6


def test_stage_2_moves_the_memory_and_leaves_all_else_bit_identical(fake_model):
    start = fakes.init(fakes.config(), jax.random.key(9), memory=False)
    before, history, _ = run(fakes.config(weight_decay=0.1), TWO, 4, start)
    after = history[-1]
    for path, leaf in tree.flatten(after.params).items():
        same = leaf.tobytes() == tree.flatten(before.params)[path].tobytes()
        assert same == path.startswith("backbone/"), path
    for path, leaf in tree.flatten(start).items():
        assert np.asarray(leaf).tobytes() == tree.flatten(after.params)[path].tobytes()


def test_moments_and_average_exist_for_trained_leaves_only(fake_model):
    before, _, _ = run(fakes.config(), TWO, 1)
    assert set(before.ema) == {"memory"}
    moments = {path for path in tree.flatten(before.opt_state) if "/mu/" in path or "/nu/" in path}
    assert moments
    assert all("/memory/" in path for path in moments)


def test_the_average_follows_its_definition(fake_model):
    config = fakes.config(ema=0.3)
    before, history, _ = run(config, ONE, 5)
    average = before.params["backbone"]["kernel"]
    for number, now in enumerate(history):
        decay = min(0.3, (2 + number) / (11 + number))
        average = decay * average + (1 - decay) * now.params["backbone"]["kernel"]
        np.testing.assert_allclose(now.ema["backbone"]["kernel"], average, rtol=1e-5, atol=1e-6)


def test_inference_uses_the_average_where_trained_and_the_frozen_weights_elsewhere(fake_model):
    _, history, _ = run(fakes.config(), TWO, 3)
    params = state.inference_params(TWO, history[-1])
    np.testing.assert_array_equal(params["memory"]["gate"], history[-1].ema["memory"]["gate"])
    np.testing.assert_array_equal(
        params["backbone"]["kernel"], history[-1].params["backbone"]["kernel"]
    )
    assert tree.mismatches(params, history[-1].params) == []


def test_the_noise_of_a_step_depends_on_its_number_and_on_nothing_else(fake_model):
    config = fakes.config()
    clip, key = fakes.clip(config, 8, 0), step.noise_key(config, ONE)
    now = state.create(config, ONE, key)
    loss = [
        float(step.train_step(config, ONE, s, clip, key)[1]["loss"])
        for s in (now, now, state.TrainState(now.params, now.ema, now.opt_state, jnp.int32(7)))
    ]
    assert loss[0] == loss[1]
    assert loss[0] != loss[2]


def test_weights_that_a_stage_cannot_start_from_are_refused(fake_model):
    config, key = fakes.config(), jax.random.key(0)
    wrong = {"backbone": {"kernel": jnp.zeros((3, 4)), "bias": jnp.zeros(3)}}
    with pytest.raises(tree.TreeError, match=r"Initial weights of stage 2 .* \(3, 4\)"):
        state.create(config, TWO, key, wrong)


def test_a_stage_without_settings_is_named(fake_model):
    stage = dataclasses.replace(ONE, name="other")
    with pytest.raises(UserError, match=r"'other' has no settings: .* needs a field `other: Stage"):
        stage.settings(fakes.config())


@pytest.mark.parametrize(
    ("found", "message"),
    [
        (jnp.zeros(()), r"must return \(loss, measured\), .*; it returned a"),
        ((jnp.zeros(()), jnp.zeros(())), r"must return \(loss, measured\)"),
        ((jnp.zeros(3), {}), r"returned loss of shape \(3,\): it must be one number"),
        ((jnp.zeros(()), {"psnr": jnp.zeros(3)}), r"returned psnr of shape \(3,\)"),
    ],
)
def test_a_loss_that_is_no_number_is_refused(fake_model, found, message):
    config = fakes.config()
    stage = dataclasses.replace(ONE, loss=lambda *_: found)
    now = state.create(config, stage, jax.random.key(0))
    with pytest.raises(UserError, match=rf"The loss of stage 1 {message}"):
        step.train_step(config, stage, now, fakes.clip(config, 8, 0), jax.random.key(0))


def test_a_batch_that_devices_cannot_share_is_refused(fake_model):
    mesh = jax.sharding.AbstractMesh((3, 1, 1, 1), AXES)
    with pytest.raises(
        ConfigError, match=r"stage1\.batch is 8, which cannot be split evenly over 3 devices"
    ):
        sharding.require_divisible(fakes.config(), ONE, mesh)


def test_every_leaf_of_the_state_needs_a_sharding_rule(monkeypatch):
    model = configs.load("tiny").model
    first = model.sharding()[:1]
    monkeypatch.setattr(pewm.PEWM, "sharding", lambda model: first)
    with pytest.raises(tree.TreeError, match="sharding rules matches params/w"):
        sharding.of_state(model, sharding.make_mesh(), {"step": 0, "params": {"w": 0}})


@pytest.mark.slow
def test_freezing_the_backbone_makes_the_step_of_the_real_model_cheaper():
    small = configs.load("tiny")
    wide = DiTBackbone(layers=1, heads=16, head_dim=32, text_length=1, text_dim=8, time_dim=16)
    config = small.with_model(backbone=wide)
    clip, mesh = fakes.clip(config, 2, 0), sharding.make_mesh(jax.devices()[:1])

    def flops(stage):
        return step.trace_step(config, stage, mesh, clip).lower().cost_analysis()["flops"]

    everything = dataclasses.replace(REAL, rules=((r".*", TRAIN),))
    assert flops(REAL) < 0.85 * flops(everything)


def test_the_stages_cover_the_parameters_of_the_real_model():
    make = functools.partial(world_model.init, configs.load("tiny").model, memory=True)
    params = jax.eval_shape(make, jax.random.key(0))
    assert set(tree.select(params, REAL.trained)) == {"memory"}
    labels = tree.flatten(REAL.labels(params))
    assert {p for p, label in labels.items() if label == TRAIN} == {
        p for p in labels if p.startswith("memory/")
    }
    with pytest.raises(tree.TreeError, match="rules of stage2 matches stranger"):
        REAL.labels({**params, "stranger": 0})
    assert set(tree.exclude(params, REAL.trained)) == {"backbone"}
    assert (
        tree.mismatches(tree.select(params, ONE.trained), tree.exclude(params, REAL.trained)) == []
    )
    decayed = tree.flatten(tree.assign(optimizer.DECAYED, params))
    assert any(decayed.values())
    assert not all(decayed.values())


@pytest.mark.parametrize("parts", [2, 4, 8])
def test_micro_batches_give_the_mean_gradient_of_their_clips(fake_model, parts):
    """Equal to the mean of losses and gradients of each part, with its own noise."""
    config = fakes.config()
    split = fakes.with_stage(config, "stage1", micro_batches=parts)
    mesh = sharding.make_mesh(jax.devices()[:1])
    now, batch = step.initial_state(config, ONE, mesh), fakes.clip(config, 8, 0)
    key = step.noise_key(config, ONE)
    step_key = jax.random.fold_in(key, 0)
    params = jax.tree.map(np.array, now.params)
    found = [
        jax.value_and_grad(lambda p, clip, key: ONE.loss(None, None, p, clip, key)[0])(
            params,
            jax.tree.map(lambda x, number=number: x[number::parts], batch),
            jax.random.fold_in(step_key, number),
        )
        for number in range(parts)
    ]
    loss, gradients = jax.tree.map(lambda *x: sum(x) / parts, *found)
    after, metrics = step.compile_step(split, ONE, mesh, batch)(
        now, jax.device_put(batch, sharding.of_batch(mesh)), key
    )
    norm = np.sqrt(sum(float((x**2).sum()) for x in jax.tree.leaves(gradients)))
    np.testing.assert_allclose(metrics["loss"], loss, rtol=1e-5)
    np.testing.assert_allclose(metrics["loss_rgb"], loss, rtol=1e-5)
    np.testing.assert_allclose(metrics["grad_norm"], norm, rtol=1e-5)
    assert after.step == 1


def test_micro_batches_without_noise_change_nothing(monkeypatch):
    def noiseless(model, train, params, clip, key, *, memory):
        rgb = jnp.asarray(clip.frames.rgb_THWC, jnp.float32) / 255
        out = rgb @ params["backbone"]["kernel"] + params["backbone"]["bias"]
        return jnp.mean((out - rgb[..., ::-1]) ** 2), {"count": jnp.int32(len(rgb))}

    fakes.install(monkeypatch, noiseless)
    stage = dataclasses.replace(ONE, loss=functools.partial(noiseless, memory=False))
    states = []
    for parts in (1, 4):
        config = fakes.with_stage(fakes.config(), "stage1", micro_batches=parts)
        states.append(run(config, stage, 3)[1][-1])
    one, four = (tree.flatten(now.params) for now in states)
    for path, leaf in one.items():
        np.testing.assert_allclose(four[path], leaf, rtol=1e-4, atol=1e-6)


def test_a_batch_that_micro_batches_do_not_divide_is_refused():
    with pytest.raises(ConfigError, match="micro_batches is 3: use a divisor of the batch, 8"):
        fakes.with_stage(fakes.config(), "stage1", micro_batches=3)
    config = fakes.with_stage(fakes.config(), "stage1", micro_batches=4)
    mesh = jax.sharding.AbstractMesh((4, 1, 1, 1), AXES)
    with pytest.raises(ConfigError, match=r"8 in 4 micro-batches.*use a multiple of 16"):
        sharding.require_divisible(config, ONE, mesh)
