"""What is not DINOv2, or not all of it, is refused in a sentence."""

import json
import sys

import jax
import numpy as np
import pytest
from safetensors.numpy import save_file

from pewm_jax.config import UserError
from pewm_jax.convert import dinov2, pipeline
from pewm_jax.models.dinov2 import model
from pewm_jax.models.dinov2.config import DINOv2Config
from pewm_jax.models.dinov2.convert import entries

CONFIG = DINOv2Config(layers=2, heads=1, width=64, pretrained_size=28, registers=2, antialias=True)
SETTINGS = {
    "architectures": ["Dinov2WithRegistersModel"],
    "model_type": "dinov2_with_registers",
    "hidden_size": 64,
    "num_hidden_layers": 2,
    "num_attention_heads": 1,
    "image_size": 28,
    "patch_size": 14,
    "num_register_tokens": 2,
    "torch_dtype": "float32",
}


@pytest.fixture(scope="module")
def params():
    return jax.jit(model.init, static_argnums=0)(CONFIG, jax.random.key(0))


@pytest.fixture
def folder(params, tmp_path):
    """A transformers folder, its tensors written by our own table."""
    return write(tmp_path / "theirs", dict(pipeline.write_tensors(entries(CONFIG), params)))


def write(folder, tensors, settings=SETTINGS):
    folder.mkdir(exist_ok=True)
    save_file(tensors, folder / "model.safetensors")
    (folder / "config.json").write_text(json.dumps(settings))
    return folder


def test_entries_read_what_they_wrote(folder, params):
    config, read = dinov2.read(folder)
    assert config == CONFIG
    jax.tree.map(np.testing.assert_array_equal, read, params)


def test_shards_are_read_like_one_file(folder, params):
    tensors = dict(pipeline.write_tensors(entries(CONFIG), params))
    (folder / "model.safetensors").unlink()
    table = {}
    for number, name in enumerate(tensors):
        table[name] = f"model-{number % 2 + 1:05d}-of-00002.safetensors"
    for shard in set(table.values()):
        save_file({n: tensors[n] for n, file in table.items() if file == shard}, folder / shard)
    (folder / "model.safetensors.index.json").write_text(json.dumps({"weight_map": table}))
    jax.tree.map(np.testing.assert_array_equal, dinov2.read(folder)[1], params)


@pytest.mark.parametrize("dtype", ["float16", "bfloat16"])
def test_a_dtype_can_be_asked_for(folder, params, dtype, tmp_path):
    dinov2.convert(folder, tmp_path / "ours", dtype, log=lambda _: None)
    _, loaded = model.load(tmp_path / "ours")
    want = jax.tree.map(lambda leaf: np.asarray(leaf.astype(dtype)), params)
    jax.tree.map(np.testing.assert_array_equal, loaded, want)
    assert {leaf.dtype.name for leaf in jax.tree.leaves(loaded)} == {dtype}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"model_type": "vit"}, "model_type 'vit'"),
        ({"hidden_act": "relu"}, "hidden_act 'relu'"),
        ({"qkv_bias": False}, "qkv_bias False"),
        ({"num_new_things": 3}, "num_new_things"),
        ({"hidden_size": "many"}, "hidden_size 'many'"),
        ({"patch_size": [14, 16]}, "patch_size \\[14, 16\\]"),
        ({"num_attention_heads": 3}, "not a multiple of dinov2.heads 3"),
        ({"num_hidden_layers": 3}, "encoder.layer.2"),
        ({"num_hidden_layers": 1}, "unexpected tensors"),
        ({"image_size": 42}, "position_embeddings"),
        ({"use_swiglu_ffn": True}, "weights_in"),
        ({"model_type": "dinov2"}, "num_register_tokens"),
    ],
)
def test_settings_that_do_not_fit_are_refused(folder, change, words):
    (folder / "config.json").write_text(json.dumps({**SETTINGS, **change}))
    with pytest.raises(UserError, match=words):
        dinov2.read(folder)


def test_tensors_that_do_not_fit_are_refused(folder, params, tmp_path):
    tensors = dict(pipeline.write_tensors(entries(CONFIG), params))
    del tensors["layernorm.bias"]
    with pytest.raises(UserError, match=r"lacks 1 tensors \(layernorm.bias\)"):
        dinov2.read(write(folder, tensors))
    tensors["layernorm.bias"] = np.zeros(32, np.float32)
    with pytest.raises(UserError, match=r"layernorm.bias \(32,\) instead of \(64,\)"):
        dinov2.read(write(folder, tensors))
    save_file({"conv.weight": np.zeros((3, 3), np.float32)}, tmp_path / "other.safetensors")
    with pytest.raises(UserError, match=r"not a DINOv2 state dict: it holds conv.weight"):
        dinov2.read(tmp_path / "other.safetensors")


def test_files_that_are_absent_or_damaged_are_refused(folder, tmp_path):
    with pytest.raises(UserError, match=r"nowhere does not exist"):
        dinov2.read(tmp_path / "nowhere")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(UserError, match=r"one file of weights, .safetensors or .pth, .* none"):
        dinov2.read(empty)
    whole = (folder / "model.safetensors").read_bytes()
    (folder / "model.safetensors").write_bytes(whole[:-4])
    with pytest.raises(UserError, match="damaged or truncated"):
        dinov2.read(folder)


def test_torch_files_are_read_as_tables_of_tensors_and_nothing_else(tmp_path):
    torch = pytest.importorskip("torch")
    path = tmp_path / "weights.pth"
    path.write_bytes(b"not a torch file")
    with pytest.raises(UserError, match="cannot be read as a table of tensors"):
        dinov2.read(path)
    torch.save({"epoch": 3, "model": {"cls_token": torch.zeros(1)}}, path)
    with pytest.raises(UserError, match="cannot be read as a table of tensors"):
        dinov2.read(path)
    torch.save({"cls_token": Danger()}, path)
    with pytest.raises(UserError, match="cannot be read as a table of tensors"):
        dinov2.read(path)
    assert not Danger.done


def test_a_torch_file_is_read_without_torch(folder, params, tmp_path, monkeypatch):
    torch = pytest.importorskip("torch")
    tensors = {
        name: torch.tensor(np.asarray(tensor))
        for name, tensor in pipeline.write_tensors(entries(CONFIG), params)
    }
    torch.save(tensors, tmp_path / "weights.pth")
    monkeypatch.setitem(sys.modules, "torch", None)
    config, read = dinov2.read(tmp_path / "weights.pth")
    assert config == CONFIG
    jax.tree.map(np.testing.assert_array_equal, read, params)


def test_nothing_is_overwritten_and_nothing_half_written_stays(folder, tmp_path):
    (tmp_path / "ours").mkdir()
    with pytest.raises(UserError, match="ours exists"):
        dinov2.convert(folder, tmp_path / "ours")
    (folder / "config.json").write_text("{")
    with pytest.raises(UserError, match="not valid JSON"):
        dinov2.convert(folder, tmp_path / "new")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ours", "theirs"]


def test_a_folder_of_ours_is_checked_when_it_is_loaded(folder, tmp_path):
    dinov2.convert(folder, tmp_path / "ours", log=lambda _: None)
    settings = json.loads((tmp_path / "ours" / "config.json").read_text())
    (tmp_path / "ours" / "config.json").write_text(json.dumps({**settings, "layers": 1}))
    with pytest.raises(UserError, match="does not fit this configuration"):
        model.load(tmp_path / "ours")
    with pytest.raises(UserError, match=r"pewm-jax convert import dinov2"):
        model.load(tmp_path / "absent")


class Danger:
    """Pickled so that loading it freely would run code."""

    done = False

    def __reduce__(self):
        return setattr, (Danger, "done", True)
