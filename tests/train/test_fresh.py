"""What a stage starts from: all of its weights, but for those that train.fresh lets be random."""

import functools

import jax
import numpy as np
import pytest

from pewm_jax.config import ConfigError
from pewm_jax.io import tree, weights
from pewm_jax.train import loop
from pewm_jax.train import step as state
from tests.train import fakes

TWO = fakes.STAGES[1]
KEY = jax.random.key(7)


def create(start, stage=TWO, **changes):
    config = fakes.config(**changes)
    return state.create(config, stage, KEY, start)


@pytest.fixture
def whole(fake_model):
    return jax.tree.map(np.asarray, fakes.init(None, jax.random.key(1)))


def same(left, right):
    return {p for p, leaf in tree.flatten(left).items() if (leaf == tree.flatten(right)[p]).all()}


def test_memory_blocks_that_are_absent_begin_at_random_and_others_go_on(whole):
    drawn = fakes.init(None, KEY)
    given, memory = {"backbone": whole["backbone"]}, {"memory": {"gate": whole["memory"]["gate"]}}
    made = create(given)
    assert same(made.params, whole) >= {"backbone/kernel", "backbone/bias"}
    assert same(made.params, drawn) >= {"memory/kernel", "memory/gate"}
    made = create(given | memory)
    assert "memory/gate" in same(made.params, whole)
    assert "memory/kernel" in same(made.params, drawn)
    assert same(create(whole).params, whole) == tree.flatten(whole).keys()


def test_anything_else_absent_or_unexpected_is_an_error_that_lists_it(whole):
    broken = {"backbone": {"kernel": whole["backbone"]["kernel"]}, "memroy": {"gate": np.ones(3)}}
    with pytest.raises(tree.TreeError) as refused:
        create(broken)
    for part in ("backbone/bias is missing", "memroy/gate is unexpected", r"memory/.*"):
        assert part in str(refused.value)
    assert "memory/kernel" not in str(refused.value)


def test_train_fresh_says_what_may_be_absent(whole):
    without = {"backbone": {"kernel": whole["backbone"]["kernel"]}}
    made = create(without, fresh=(r"memory/.*", r".*/bias"))
    assert "backbone/bias" in same(made.params, fakes.init(None, KEY))
    with pytest.raises(tree.TreeError, match=r"memory/gate is missing, memory/kernel is missing"):
        create({"backbone": whole["backbone"]}, fresh=())
    with pytest.raises(ConfigError, match="no regular expression"):
        fakes.config(fresh=("(",))


def test_of_another_shape_may_be_what_may_be_absent(whole):
    other = {**whole, "memory": {**whole["memory"], "kernel": np.ones((7, 5), np.float32)}}
    made = create(other)
    assert "memory/kernel" in same(made.params, fakes.init(None, KEY))
    assert same(made.params, whole) >= {"backbone/kernel", "backbone/bias", "memory/gate"}
    with pytest.raises(tree.TreeError, match=r"memory/kernel has shape \(7, 5\)"):
        create(other, fresh=())


def test_what_the_model_has_not_is_left_out_if_it_may_be_absent(whole):
    more = whole | {"control": {"kernel": np.ones((2, 3), np.float32)}}
    made = create(more, fresh=(r"control/.*",))
    assert "control" not in made.params
    assert same(made.params, whole) == tree.flatten(whole).keys()
    with pytest.raises(tree.TreeError, match="control/kernel is unexpected"):
        create(more)


def test_kernels_may_get_further_inputs_which_begin_at_zero(whole):
    kernel = whole["backbone"]["kernel"]
    fewer = {**whole, "backbone": {**whole["backbone"], "kernel": kernel[:-1]}}
    made = create(fewer, wider=("backbone/kernel",)).params["backbone"]["kernel"]
    np.testing.assert_array_equal(made[:-1], kernel[:-1])
    np.testing.assert_array_equal(made[-1], 0)
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), fewer)
    config = fakes.config(wider=("backbone/kernel",))
    assert (
        state.require_start(config, TWO, shapes, whole)["backbone"]["kernel"].shape == kernel.shape
    )
    more = {**whole, "backbone": {**whole["backbone"], "kernel": np.concatenate([kernel] * 2)}}
    for start, changes in ((fewer, {}), (more, {"wider": ("backbone/kernel",)})):
        with pytest.raises(tree.TreeError, match="backbone/kernel has shape"):
            create(start, **changes)
    with pytest.raises(ConfigError, match=r"train\.wider: '\(' is no regular expression"):
        fakes.config(wider=("(",))


def test_the_rule_is_known_before_anything_is_computed(whole):
    shapes = jax.eval_shape(functools.partial(fakes.init, None), KEY)
    config = fakes.config()
    state.require_start(config, TWO, {"backbone": shapes["backbone"]}, shapes)
    with pytest.raises(tree.TreeError, match="backbone/bias is missing"):
        state.require_start(config, TWO, {"memory": shapes["memory"]}, shapes)


def test_stage_2_starts_from_another_run_of_stage_1_alone(fake_model, tmp_path):
    loop.train(fakes.config(tmp_path / "one", stage1=3, stage2=0), log=lambda _: None)
    config = fakes.config(tmp_path / "two", stage1=0, stage2=3, start=str(tmp_path / "one"))
    loop.train(config, log=lambda _: None)
    one, two = (weights.load(tmp_path / n / "weights.safetensors") for n in ("one", "two"))
    assert set(one) == {"backbone"}
    assert set(two) == {"backbone", "memory"}
    for name, leaf in one["backbone"].items():
        assert leaf.tobytes() == two["backbone"][name].tobytes()
    (tmp_path / "one" / "weights.safetensors").unlink()
    for number, start in enumerate(("one", "one/checkpoints/stage1/3")):
        config = fakes.config(
            tmp_path / f"again{number}", stage1=0, stage2=3, start=str(tmp_path / start)
        )
        loop.train(config, log=lambda _: None)
        again = weights.load(tmp_path / f"again{number}" / "weights.safetensors")
        assert same(again, two) == tree.flatten(two).keys()
    strict = fakes.config(
        tmp_path / "three", stage1=0, stage2=3, start=str(tmp_path / "one"), fresh=()
    )
    with pytest.raises(tree.TreeError, match="memory/gate is missing"):
        loop.train(strict, log=lambda _: None)
