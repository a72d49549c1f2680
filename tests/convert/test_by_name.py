"""Checkpoints that are converted by their names on a hub; a stand-in server has them."""

import json
import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.cli import main as program
from pewm_jax.convert import pipeline
from pewm_jax.io import hub, tensor_files, tree, weights
from pewm_jax.io.published import LINEAR, Entry, Network
from tests.convert import pipelines
from tests.io import hub_server

pytest.importorskip("huggingface_hub", reason="huggingface_hub is not installed")
NAME = "someone/video"


@pytest.fixture
def server(monkeypatch, tmp_path):
    with hub_server.serving() as found:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("HF_ENDPOINT", found.address)
        monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
        for name in ("HF_HUB_OFFLINE", "HF_HUB_CACHE", "HUGGINGFACE_HUB_CACHE", "HF_TOKEN"):
            monkeypatch.delenv(name, raising=False)
        hub._find.cache_clear()
        yield found


@pytest.mark.parametrize("world", [False, True])
def test_a_name_gives_what_its_folder_gives(server, tmp_path, world):
    folder = pipelines.save(tmp_path / "published", shard="40KB")
    commit = server.add_folder(NAME, folder)
    size = ["--height", "32", "--width", "32", "--frames", "9"]
    flags = ["--rgbd", "--camera", *size] if world else ["--dtype", "bfloat16"]
    for src, dst in ((NAME, "by_name"), (folder, "by_folder")):
        assert program.main(["convert", "import", "cogvideox", str(src), dst, *flags]) == 0
    where = "weights.safetensors" if world else "transformer/weights.safetensors"
    one, other = (
        tree.flatten(weights.load(tmp_path / dst / where)) for dst in ("by_name", "by_folder")
    )
    assert one.keys() == other.keys()
    for name, leaf in one.items():
        np.testing.assert_array_equal(leaf, other[name])
    assert json.loads((tmp_path / "by_name/base.json").read_text())["name"] == f"{NAME}@{commit}"


def test_weights_of_another_precision_are_not_downloaded(server, tmp_path):
    folder = pipelines.save(tmp_path / "published")
    files = {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    half = "transformer/diffusion_pytorch_model.fp16.safetensors"
    files |= {half: b"x" * 2000, "model.safetensors": b"x" * 2000}
    server.add(NAME, files)
    assert program.main(["convert", "import", "cogvideox", NAME, "ours"]) == 0
    asked = {path.rsplit("/resolve/")[-1].partition("/")[2] for _, path in server.requests}
    assert not {half, "model.safetensors"} & asked


def test_only_one_tensor_is_in_memory(tmp_path):
    """Of 24 layers of 1 MiB in 12 shards, and one of 8 MiB in another; 1.3 shards are 10.4 MiB."""
    layer, layers, big = (512, 512), 24, (4096, 512)
    shapes = {f"l.{i}": layer for i in range(layers)} | {"big": big}
    shard = {name: f"m-{i // 2}.safetensors" for i, name in enumerate(shapes)}
    folder = tmp_path / "net"
    for file in set(shard.values()):
        like = {
            name: jax.ShapeDtypeStruct(shapes[name], np.float32)
            for name in shapes
            if shard[name] == file
        }
        pairs = ((name, np.full(spec.shape, len(name), np.float32)) for name, spec in like.items())
        tensor_files.write(folder / file, like, pairs, {})
    (folder / "m.safetensors.index.json").write_text(json.dumps({"weight_map": shard}))
    (folder / "config.json").write_text(json.dumps({"_class_name": "Net"}))

    def init(config, key):
        del config, key
        return {"w": jnp.zeros((layers, *layer)), "big": jnp.zeros(big[::-1])}

    entries = [Entry(f"l.{i}", "w", LINEAR, i) for i in range(layers)]
    entries.append(Entry("big", "big", LINEAR))
    net = Network("net", "Net", dict, dict, dict, lambda _: entries, init)
    for dtype in ("float32", "bfloat16"):
        specs, blocks = pipeline.part(net, folder, dtype)
        tracemalloc.start()
        tensor_files.write(tmp_path / dtype, specs, blocks(), tensor_files.header({}))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 1.3 * (8 << 20)
        found = weights.load(tmp_path / dtype)
        whole = pipeline.read(net, folder, dtype)[1]
        for name, leaf in whole.items():
            np.testing.assert_array_equal(found[name], leaf)
