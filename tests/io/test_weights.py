"""Weights on disk: what comes back is what went in, and a damaged file is never taken for whole."""

import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy

from pewm_jax.config import UserError
from pewm_jax.io import tensor_files, weights

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


def test_a_flipped_bit_is_noticed_wherever_it_is(tmp_path):
    path = tmp_path / "weights.safetensors"
    weights.save(path, PARAMS, {"stage": "1"})
    whole = path.read_bytes()
    weights.verify(path)
    for place in range(len(whole)):
        path.write_bytes(
            whole[:place] + bytes([whole[place] ^ 1 << place % 8]) + whole[place + 1 :]
        )
        for read in (weights.load, weights.verify):
            with pytest.raises(UserError, match=r"is damaged|contains .* which is not supported"):
                read(path)


def test_other_peoples_files_have_no_checksums_and_are_read(tmp_path):
    safetensors.numpy.save_file({"a": np.ones(3, np.float32)}, tmp_path / "w", {"format": "pt"})
    assert weights.load(tmp_path / "w")["a"].tolist() == [1, 1, 1]
    assert weights.metadata(tmp_path / "w") == {}


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


def test_one_branch_can_be_read_alone(tmp_path):
    weights.save(tmp_path / "w", PARAMS)
    assert list(weights.load(tmp_path / "w", "memory")) == ["gate"]
    with pytest.raises(UserError, match="contains no codec"):
        weights.load(tmp_path / "w", "codec")


def test_tensors_that_were_not_announced_leave_no_file(tmp_path):
    one = np.ones(3, np.float32)
    for tensors in ([("b", one)], [("a", one[:2])], [("a", one), ("a", one)], []):
        with pytest.raises(ValueError, match=r"differs from ``like``|in ``like`` but"):
            tensor_files.write(tmp_path / "w", {"a": one}, tensors, {})
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "table",
    [
        b"[]",
        b'{"a": 3}',
        b'{"a": {"dtype": 8, "shape": [1], "data_offsets": [0, 4]}}',
        b'{"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 4]}}',
        b'{"a": {"dtype": "F32", "shape": [1], "data_offsets": [4, 8]}}',
        b'{"a": {"dtype": "F32", "shape": [-1], "data_offsets": [4, 0]}}',
        b'{"a": {"dtype": "F32", "shape": ["1"], "data_offsets": [0, 4]}}',
        b'{"a": {"dtype": "F32", "shape": [1], "data_offsets": ["0", 4]}}',
        b'{"a": {"dtype": "F32", "shape": [1], "data_offsets": [0, "4"]}}',
    ],
)
def test_a_header_that_does_not_hold_together_is_refused(tmp_path, table):
    (tmp_path / "w").write_bytes(len(table).to_bytes(8, "little") + table + b"1234")
    with pytest.raises(UserError, match="is damaged"):
        weights.load(tmp_path / "w")


def test_a_dtype_that_is_not_known_is_named(tmp_path):
    table = b'{"a": {"dtype": "F8_E4M3", "shape": [4], "data_offsets": [0, 4]}}'
    (tmp_path / "w").write_bytes(len(table).to_bytes(8, "little") + table + b"1234")
    with pytest.raises(UserError, match="contains a in F8_E4M3, which is not supported"):
        weights.load(tmp_path / "w")
