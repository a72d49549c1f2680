"""Weights on disk: what comes back is what went in, and a damaged file is never taken for whole."""

import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import weights
from pewm_jax.config import UserError

PARAMS = {
    "backbone": {
        "kernel": jnp.arange(6.0).reshape(2, 3),
        "half": jnp.linspace(-1, 1, 5, dtype=jnp.bfloat16),
        "step": jnp.asarray(3, jnp.int32),
    },
    "memory": {"gate": jnp.zeros((0, 4))},
}


def test_every_leaf_comes_back_bit_identical(tmp_path):
    path = tmp_path / "new" / "weights.safetensors"
    weights.save(path, PARAMS, {"stage": "1"})
    back = weights.load(path)
    weights.check(back, PARAMS, str(path))
    for part, leaves in PARAMS.items():
        for name, leaf in leaves.items():
            assert back[part][name].dtype == leaf.dtype
            assert back[part][name].tobytes() == np.asarray(leaf).tobytes()
    assert weights.metadata(path) == {"stage": "1"}
    assert [p.name for p in path.parent.iterdir()] == ["weights.safetensors"]


def test_transposed_arrays_are_written_in_their_own_order(tmp_path):
    kernel = np.arange(6.0).reshape(2, 3).T
    weights.save(tmp_path / "w", {"kernel": kernel})
    np.testing.assert_array_equal(weights.load(tmp_path / "w")["kernel"], kernel)


def test_a_truncated_file_is_refused_in_a_sentence(tmp_path):
    path = tmp_path / "weights.safetensors"
    weights.save(path, PARAMS)
    whole = path.read_bytes()
    for size in (0, 4, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        for read in (weights.load, weights.metadata):
            with pytest.raises(UserError, match="is damaged"):
                read(path)


def test_absent_or_unfitting_weights_are_refused(tmp_path):
    with pytest.raises(UserError, match="does not exist"):
        weights.load(tmp_path / "none")
    with pytest.raises(UserError, match="backbone/kernel is unexpected"):
        weights.check(PARAMS, {"backbone": {"other": jnp.ones(2)}}, "w")


def test_equal_weights_are_equal_files(tmp_path):
    words = {"stage": "1", "step": "200", "of": "demo"}
    for name in "ab":
        weights.save(tmp_path / name, PARAMS, words)
    weights.save(tmp_path / "c", dict(reversed(PARAMS.items())), dict(reversed(words.items())))
    assert len({(tmp_path / name).read_bytes() for name in "abc"}) == 1
