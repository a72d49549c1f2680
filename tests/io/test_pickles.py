"""Pickled tensors are read as data: nothing is executed, and all but tensors is refused."""

import collections
import io
import os
import pickle
import pickletools
import zipfile

import jax
import numpy as np
import pytest
import torch

from pewm_jax.config import UserError
from pewm_jax.io import pickles as pickled_tensors

RNG = np.random.default_rng(0)
TABLE = {
    "a": {"kernel": RNG.standard_normal((3, 2, 4)).astype(np.float32), "bias": np.arange(5)},
    "f": np.asfortranarray(RNG.standard_normal((3, 4))),
    "scalar": np.array(2.5, np.float16),
    "none": np.zeros((0, 3), np.uint8),
    "big": np.arange(6, dtype=">i4").reshape(2, 3),
    "yes": np.array([True, False]),
}


@pytest.mark.parametrize("protocol", [3, 4])
def test_numpy_tables_come_back_bit_for_bit(tmp_path, protocol):
    path = tmp_path / "x.ckpt"
    path.write_bytes(pickle.dumps(TABLE, protocol))
    got = pickled_tensors.read(path)
    jax.tree.map(np.testing.assert_array_equal, got, TABLE)
    assert jax.tree.map(lambda x: x.dtype, got) == jax.tree.map(lambda x: x.dtype, TABLE)


def test_what_torch_saves_comes_back_with_its_steps(tmp_path):
    whole = torch.arange(24.0).reshape(4, 6)
    state = collections.OrderedDict(
        whole=whole,
        turned=whole.T,
        part=whole[1:3, ::2],
        half=torch.tensor([1.5, -2.0], dtype=torch.bfloat16),
        weight=torch.nn.Parameter(torch.ones(2, 2)),
        layer=torch.nn.Linear(2, 3).state_dict(),
        none=torch.zeros(0, 2),
        number=torch.tensor(7),
    )
    torch.save(state, tmp_path / "x.pth")
    got = pickled_tensors.read(tmp_path / "x.pth")
    assert set(got) == set(state)
    for name in ("whole", "turned", "part", "weight", "none", "number"):
        np.testing.assert_array_equal(got[name], state[name].detach().numpy())
    np.testing.assert_array_equal(got["half"].astype(np.float32), [1.5, -2.0])
    np.testing.assert_array_equal(got["layer"]["bias"], state["layer"]["bias"].numpy())


class Evil:
    def __init__(self, *call):
        self.call = call

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize(
    "call",
    [
        (os.mkdir, ("evil",)),
        (eval, ("__import__('os').mkdir('evil')",)),
        (np.load, ("evil",)),
        (getattr, (os, "mkdir")),
        (np.dtype, ("O",)),
        (np.frombuffer, (b"12345678",)),
    ],
    ids=lambda call: call[0].__name__,
)
def test_nothing_is_executed(tmp_path, monkeypatch, call):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "x.ckpt"
    try:
        content = pickle.dumps({"x": Evil(*call)})
    except TypeError:  # a module cannot be pickled
        content = pickle.dumps({"x": Evil(getattr, ("", "mkdir"))})
    path.write_bytes(content)
    torch.save({"x": torch.ones(2)}, tmp_path / "x.pth")
    swapped = tmp_path / "y.pth"
    with zipfile.ZipFile(tmp_path / "x.pth") as old, zipfile.ZipFile(swapped, "w") as new:
        for name in old.namelist():
            new.writestr(name, content if name.endswith("data.pkl") else old.read(name))
    for file in (path, swapped):
        with pytest.raises(UserError, match="cannot be read as a table of tensors"):
            pickled_tensors.read(file)
    assert not (tmp_path / "evil").exists()


def test_the_stand_ins_cannot_be_changed(tmp_path):
    # BUILD on a name sets its attributes, unless it refuses.
    out = io.BytesIO()
    out.write(pickle.PROTO + b"\x02" + pickle.GLOBAL + b"numpy\nndarray\n")
    out.write(pickle.EMPTY_DICT + pickle.BUILD + pickle.STOP)
    pickletools.dis(out.getvalue(), io.StringIO())
    (tmp_path / "x").write_bytes(out.getvalue())
    with pytest.raises(UserError, match="it sets the state of a callable"):
        pickled_tensors.read(tmp_path / "x")


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ([np.ones(2)], "no table of named tensors"),
        ({"x": 1.0}, "no table of named tensors"),
        ({3: np.ones(2)}, "no table of named tensors"),
        ({"x": np.array([{}, "text"], object)}, "not numeric"),
        ({"x": np.array(["text"])}, "not numeric"),
        ({"x": collections.Counter()}, "collections.Counter, which is not a tensor type"),
    ],
)
def test_all_but_tables_of_tensors_is_refused(tmp_path, value, said):
    path = tmp_path / "x.ckpt"
    path.write_bytes(pickle.dumps(value))
    with pytest.raises(UserError, match=said):
        pickled_tensors.read(path)


def test_damaged_absent_and_old_files_are_refused_in_a_sentence(tmp_path):
    path = tmp_path / "x.ckpt"
    with pytest.raises(UserError, match="does not exist"):
        pickled_tensors.read(path)
    whole = pickle.dumps(TABLE)
    torch.save({"x": torch.ones(3)}, tmp_path / "old.pth", _use_new_zipfile_serialization=False)
    for content in (whole[:-50], b"", b"not a pickle", (tmp_path / "old.pth").read_bytes()):
        path.write_bytes(content)
        with pytest.raises(UserError, match=r"torch 1\.6 or newer") as refused:
            pickled_tensors.read(path)
        assert "\n" not in str(refused.value)
