"""LoRA: adapters are trained, saved and resumed alone, and loading adds them to their base."""

import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest

import pewm_jax
from pewm_jax.config import ConfigError, LoRAConfig, UserError
from pewm_jax.io import tree, weights
from pewm_jax.train import loop, runs, sharding, step
from pewm_jax.worlds import lora, rollouts
from tests.train import fakes

ADAPT = LoRAConfig(rank=2, alpha=3.0, target=r".*kernel")
QUIET = {"log": lambda _: None}


def stage(number=0, config=None, **changes):
    config = fakes.config(lora=ADAPT) if config is None else config
    return runs.all_stages(config)[number]


@pytest.fixture
def base(fake_model, tmp_path):
    loop.train(fakes.config(tmp_path / "base"), **QUIET)
    return tmp_path / "base"


def adapted(path, base, **changes):
    settings = {"stage1": 6, "stage2": 0, "lora": ADAPT, "start": str(base)} | changes
    return fakes.config(path, **settings)


def paths(params):
    return set(tree.flatten(params))


def same(left, right):
    left, right = tree.flatten(left), tree.flatten(right)
    assert left.keys() == right.keys()
    return all(np.asarray(left[p]).tobytes() == np.asarray(right[p]).tobytes() for p in left)


PAIR = {"lora/backbone/kernel/a", "lora/backbone/kernel/b"}


def test_only_adapters_have_optimizer_state_and_move(fake_model):
    config = fakes.config(lora=ADAPT, start="somewhere")
    mesh = sharding.make_mesh(jax.devices()[:1])
    one = stage(config=config)
    now = step.initial_state(config, one, mesh, fakes.init(None, jax.random.key(1), memory=False))
    arrays = [path for path, x in tree.flatten(now.opt_state).items() if np.ndim(x)]
    assert arrays
    assert all("/lora/backbone/kernel/" in path for path in arrays)
    assert paths(now.ema) == PAIR
    before = jax.tree.map(np.array, now.params)
    clip = jax.device_put(fakes.clip(config, 8, 0), sharding.of_batch(mesh))
    compiled = step.compile_step(config, one, mesh, clip)
    for _ in range(2):  # A moves once B is not zero
        now, _ = compiled(now, clip, step.noise_key(config, one))
    after, before = tree.flatten(now.params), tree.flatten(before)
    moved = {p for p in after if np.asarray(after[p]).tobytes() != before[p].tobytes()}
    assert moved == PAIR


def test_the_first_step_predicts_what_the_base_predicts(fake_model):
    config = fakes.config(lora=ADAPT)
    params = stage(config=config).init(config.model, jax.random.key(0))
    whole = {"backbone": fakes.init(None, jax.random.key(0))["backbone"]}
    bound = lora.bind(config.model, ADAPT, params)
    np.testing.assert_array_equal(bound["backbone"]["kernel"].unbox(), whole["backbone"]["kernel"])


def test_checkpoints_and_weights_hold_adapters_alone_and_name_their_base(base, tmp_path):
    run = loop.train(adapted(tmp_path / "lora", base), **QUIET)
    assert paths(weights.load(run / "weights.safetensors")) == PAIR
    facts = weights.metadata(run / "weights.safetensors")
    assert facts["base"] == str(base)
    assert facts["base_sha256"] == lora.base_hash(base)
    newest = run / "checkpoints/stage1/6"
    position = json.loads((newest / "data/metadata").read_text())
    assert position["base_sha256"] == lora.base_hash(base)
    size = sum(p.stat().st_size for p in (newest / "weights").rglob("*") if p.is_file())
    assert "backbone.kernel" not in str([p.name for p in (newest / "weights").rglob("*")])
    assert size < 100_000


def test_loading_adds_the_adapters_to_the_base(base, tmp_path):
    run = loop.train(adapted(tmp_path / "lora", base), **QUIET)
    before, after = rollouts.load_finished(base)[1], pewm_jax.load(run)[1]
    found = weights.load(run / "weights.safetensors")["lora"]["backbone"]["kernel"]
    wanted = before["backbone"]["kernel"] + 1.5 * found["a"] @ found["b"]
    assert np.abs(found["b"]).max() > 1e-3
    np.testing.assert_allclose(after["backbone"]["kernel"], wanted, rtol=0, atol=1e-6)
    assert same(after["memory"], before["memory"])
    shutil.rmtree(run / "checkpoints/stage1/3")
    newest = pewm_jax.load(run / "checkpoints/stage1/6")[1]
    assert same(newest, after)


def test_a_resumed_run_is_bit_identical(base, tmp_path):
    config = adapted(tmp_path / "cut", base)
    whole = loop.train(adapted(tmp_path / "whole", base), **QUIET)
    cut = loop.train(config, **QUIET)
    shutil.rmtree(cut / "checkpoints/stage1/6")  # as if it was killed after step 3
    (cut / "weights.safetensors").unlink()
    loop.train(config, **QUIET)
    assert same(*(weights.load(run / "weights.safetensors") for run in (whole, cut)))
    states = [run / "checkpoints/stage1/6/state" for run in (whole, cut)]
    assert all(state.is_dir() for state in states)


def test_stage_2_keeps_the_adapters_of_stage_1_and_trains_its_own(base, tmp_path):
    run = loop.train(adapted(tmp_path / "both", base, stage2=6), **QUIET)
    alone = loop.train(adapted(tmp_path / "one", base), **QUIET)
    found, first = (weights.load(x / "weights.safetensors")["lora"] for x in (run, alone))
    assert set(found) == {"backbone", "memory"}
    assert same(found["backbone"], first["backbone"])
    params = pewm_jax.load(run)[1]
    before = rollouts.load_finished(base)[1]
    assert not same(params["memory"]["kernel"], before["memory"]["kernel"])
    assert same(params["memory"]["gate"], before["memory"]["gate"])


def test_parameters_that_the_base_lacks_are_trained_in_full(fake_model, tmp_path):
    loop.train(fakes.config(tmp_path / "base", stage2=0), **QUIET)
    said = []
    config = adapted(tmp_path / "two", tmp_path / "base", stage2=6)
    run = loop.train(config, log=said.append)
    assert any("lacks memory/.*: trained in full" in line for line in said)
    found = weights.load(run / "weights.safetensors")
    assert paths(found) == PAIR | {"memory/kernel", "memory/gate"}
    assert paths(pewm_jax.load(run)[1]) == paths(fakes.init(None, jax.random.key(0)))
    loop.train(config, log=said.append)
    assert "already trained" in said[-1]


def test_adapters_of_adapted_weights(base, tmp_path):
    one = loop.train(adapted(tmp_path / "one", base), **QUIET)
    two = loop.train(adapted(tmp_path / "two", one), **QUIET)
    first, second = (pewm_jax.load(run)[1]["backbone"]["kernel"] for run in (one, two))
    found = weights.load(two / "weights.safetensors")["lora"]["backbone"]["kernel"]
    np.testing.assert_allclose(second, first + 1.5 * found["a"] @ found["b"], atol=1e-6)


def test_full_parameters_are_trained_beside_adapters(base, tmp_path):
    more = dataclasses.replace(ADAPT, full=(r".*/bias",))
    run = loop.train(adapted(tmp_path / "lora", base, lora=more), **QUIET)
    found = weights.load(run / "weights.safetensors")
    assert paths(found) == PAIR | {"backbone/bias"}
    assert same(pewm_jax.load(run)[1]["backbone"]["bias"], found["backbone"]["bias"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"start": ""}, "train.start is empty"),
        (
            {"lora": dataclasses.replace(ADAPT, target="kernel")},
            "matches no path .*backbone/kernel",
        ),
        ({"start": "nowhere"}, "nowhere has no weights.safetensors"),
    ],
)
def test_settings_without_effect_are_refused(base, tmp_path, changes, message):
    with pytest.raises(UserError, match=message):
        loop.train(adapted(tmp_path / "lora", base, **changes), **QUIET)


def test_invalid_settings_are_refused():
    for values in ({"rank": -1}, {"alpha": -1.0}, {"target": "("}, {"full": ("(",)}):
        with pytest.raises(ConfigError, match=r"train\.lora"):
            LoRAConfig(**values)


def test_adapters_of_other_weights_are_refused(base, tmp_path):
    config = adapted(tmp_path / "lora", base)
    run = loop.train(config, **QUIET)
    shutil.move(base, tmp_path / "elsewhere")
    with pytest.raises(UserError, match="holds adapters alone"):
        pewm_jax.load(run)
    loop.train(fakes.config(base, seed=9), **QUIET)
    with pytest.raises(UserError, match="adapters of other weights"):
        pewm_jax.load(run)
    (run / "weights.safetensors").unlink()
    longer = fakes.with_stage(config, "stage1", steps=9)
    with pytest.raises(UserError, match=r"another configuration|adapters of other weights"):
        loop.train(longer, **QUIET)


def test_a_base_beside_the_run_is_found(base, tmp_path, monkeypatch):
    run = loop.train(adapted(tmp_path / "lora", base), **QUIET)
    before = pewm_jax.load(run)[1]
    (tmp_path / "moved").mkdir()
    for name in ("lora", "base"):
        shutil.move(tmp_path / name, tmp_path / "moved" / name)
    assert same(pewm_jax.load(tmp_path / "moved/lora")[1], before)
