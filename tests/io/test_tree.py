"""Choosing leaves by path: nothing is matched by accident, nothing is left out in silence."""

import hypothesis
import jax
import numpy as np
import pytest
from hypothesis import strategies as st

from pewm_jax.io import tree

PARAMS = {
    "backbone": {"block": {"kernel": np.ones((2, 3)), "bias": np.zeros(3)}, "scale": np.ones(2)},
    "memory": {"block": {"kernel": np.ones((4, 3)), "gate": np.zeros(3)}},
}

names = st.text("abc", min_size=1, max_size=2)
trees = st.recursive(
    st.integers(), lambda node: st.dictionaries(names, node, min_size=1, max_size=3), max_leaves=12
).filter(lambda node: isinstance(node, dict))


@hypothesis.given(trees)
def test_flatten_and_unflatten_are_inverses(params):
    assert tree.unflatten(tree.flatten(params)) == params


@hypothesis.given(trees, st.data())
def test_split_parts_are_disjoint_complete_and_merge_back(params, data):
    paths = list(tree.flatten(params))
    chosen = data.draw(st.lists(st.sampled_from(paths), min_size=1, unique=True))
    inside, outside = tree.split(params, chosen)
    assert set(tree.flatten(inside)) == set(chosen)
    assert set(tree.flatten(outside)) == set(paths) - set(chosen)
    assert tree.merge(inside, outside) == params


def test_patterns_match_whole_paths_only():
    assert set(tree.flatten(tree.select(PARAMS, ["memory/.*"]))) == {
        "memory/block/gate",
        "memory/block/kernel",
    }
    with pytest.raises(tree.TreeError, match="'memory' matches none"):
        tree.split(PARAMS, ["memory"])
    assert "memory" not in tree.exclude(PARAMS, ["memory/.*"])


def test_a_pattern_that_matches_nothing_is_refused_even_beside_one_that_does():
    with pytest.raises(tree.TreeError, match="memry"):
        tree.split(PARAMS, ["backbone/.*", "memry/.*"])


def test_the_first_rule_wins_and_the_structure_is_kept():
    out = tree.assign(((r".*/kernel", "decay"), (r"backbone/.*", "none"), (r".*", "gate")), PARAMS)
    assert out["backbone"]["block"] == {"kernel": "decay", "bias": "none"}
    assert out["memory"]["block"] == {"kernel": "decay", "gate": "gate"}


def test_a_leaf_without_a_rule_is_listed():
    with pytest.raises(tree.TreeError, match=r"sharding matches backbone/scale, memory/block/gate"):
        tree.assign(((r".*/(kernel|bias)", 1),), PARAMS, "sharding")


def test_paths_of_other_pytrees_read_the_same_way():
    nested = {"layers": [{"w": 1}, {"w": 2}], "pair": (3,)}
    assert list(tree.flatten(nested)) == ["layers/0/w", "layers/1/w", "pair/0"]


def test_merge_refuses_overlap_and_unflatten_refuses_a_leaf_used_as_a_branch():
    with pytest.raises(tree.TreeError, match="both contain memory/block/gate"):
        tree.merge(PARAMS, {"memory": {"block": {"gate": 1}}})
    with pytest.raises(tree.TreeError, match="leaf and not a branch"):
        tree.unflatten({"a": 1, "a/b": 2})
    with pytest.raises(tree.TreeError, match="both a leaf and a branch"):
        tree.unflatten({"a/b": 2, "a": 1})


def test_mismatches_name_what_is_missing_unexpected_and_of_another_shape():
    other = jax.tree.map(lambda leaf: leaf, PARAMS)
    other["memory"] = {"block": {"kernel": np.ones((4, 5))}, "extra": np.ones(1)}
    wrong = tree.mismatches(other, PARAMS)
    assert wrong == [
        "memory/block/gate is missing",
        "memory/block/kernel has shape (4, 5) instead of (4, 3)",
        "memory/extra is unexpected",
    ]
    assert tree.mismatches(PARAMS, jax.eval_shape(lambda: PARAMS)) == []
    with pytest.raises(tree.TreeError, match=r"The file does not fit .* memory/extra"):
        tree.require_like(other, PARAMS, "The file")


def test_long_lists_are_cut_and_counted():
    text = tree.listing(f"leaf{i:02d}" for i in range(20))
    assert text.endswith("leaf07 and 12 more")
