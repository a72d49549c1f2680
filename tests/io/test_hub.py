"""Models by name: from a stand-in server over HTTP, from the cache, and from folders."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import pewm_jax
from pewm_jax import config as configuration
from pewm_jax import presets, shipped
from pewm_jax.cli import main as program
from pewm_jax.config import UserError
from pewm_jax.io import hub, tree, weights
from pewm_jax.worlds import init
from tests.io import hub_server

pytest.importorskip("huggingface_hub", reason="huggingface_hub is not installed")
NAME = "someone/rooms"
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    import jax

    folder = tmp_path_factory.mktemp("runs") / "tiny"
    folder.mkdir()
    config = presets.load("tiny")
    configuration.save(config, folder / "config.json")
    shapes = jax.eval_shape(lambda key: init(config.model, key), jax.random.key(0))
    random = np.random.default_rng(0)
    params = jax.tree.map(lambda x: random.normal(size=x.shape).astype(x.dtype), shapes)
    weights.save(folder / "weights.safetensors", params, {"stage": "2", "step": "1"})
    return folder


@pytest.fixture
def server(monkeypatch, tmp_path):
    with hub_server.serving() as found:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("HF_ENDPOINT", found.address)
        monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
        monkeypatch.setenv("HF_HUB_DISABLE_PROGRESS_BARS", "1")
        for name in ("HF_HUB_OFFLINE", "HF_HUB_CACHE", "HUGGINGFACE_HUB_CACHE", "HF_TOKEN"):
            monkeypatch.delenv(name, raising=False)
        hub._find.cache_clear()
        yield found


def require_same(run, params):
    expected = tree.flatten(weights.load(run / "weights.safetensors"))
    found = tree.flatten(params)
    assert found.keys() == expected.keys()
    for name, leaf in found.items():
        np.testing.assert_array_equal(leaf, expected[name])


def test_a_pushed_run_is_loaded_by_its_name_and_without_a_network(server, run, capsys, monkeypatch):
    assert program.main(["push", str(run), NAME]) == 0
    pinned = capsys.readouterr().out.split(": ")[0]
    (commit,) = server.models[NAME]
    assert pinned == f"{NAME}@{commit}"
    files = server.models[NAME][commit]
    assert {"config.json", "weights.safetensors", "README.md"} <= files.keys()
    assert NAME in files["README.md"].decode()
    config, params = pewm_jax.load(NAME)
    assert config == configuration.load(run / "config.json")
    require_same(run, params)
    assert (Path("home/hub") / "models--someone--rooms").is_dir()
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    asked = len(server.requests)
    for name in (NAME, pinned, f"hf://{NAME}"):
        require_same(run, pewm_jax.load(name)[1])
    assert len(server.requests) == asked


def test_a_revision_is_pinned(server, run):
    first = server.add_folder(NAME, run)
    changed = json.loads((run / "config.json").read_text())
    changed["train"]["seed"] = 7
    files = {"config.json": json.dumps(changed).encode()}
    second = server.add(NAME, server.models[NAME][first] | files)
    assert pewm_jax.load(NAME)[0].train.seed == 7
    for name, revision in ((f"{NAME}@{first}", None), (NAME, first)):
        assert pewm_jax.load(name, revision=revision)[0].train.seed == 0
    assert hub.title(shipped.find(f"{NAME}@{second}")) == f"{NAME}@{second}"
    assert shipped.home(NAME) == Path("runs/rooms")
    with pytest.raises(UserError, match="has no revision none; choose another"):
        pewm_jax.load(NAME, revision="none")
    with pytest.raises(UserError, match="is a folder, which has no revision x; omit"):
        pewm_jax.load(run, revision="x")
    with pytest.raises(UserError, match="give one revision"):
        pewm_jax.load(f"{NAME}@{first}", revision=second)


def test_pull_prints_the_commit_and_copies(server, run, capsys, tmp_path):
    commit = server.add_folder(NAME, run)
    assert program.main(["pull", NAME, "--revision", commit, "--out", "copy"]) == 0
    assert capsys.readouterr().out.strip().endswith(f"{NAME}@{commit}: copy")
    require_same(run, pewm_jax.load(tmp_path / "copy")[1])
    server.add("someone/else", {"model.safetensors": b"x"})
    assert program.main(["pull", "someone/else"]) == 2
    assert "someone/else contains none of" in capsys.readouterr().err


def test_push_and_pull_work_with_a_folder(server, run, tmp_path, capsys):
    assert program.main(["push", str(run), "./released"]) == 0
    require_same(run, pewm_jax.load("./released")[1])
    assert program.main(["pull", "./released", "--out", "again"]) == 0
    require_same(run, pewm_jax.load("again")[1])
    assert not server.requests
    assert program.main(["push", str(run), "./released"]) == 2
    assert "exists already" in capsys.readouterr().err


def test_a_cut_download_is_one_sentence_and_resumes(server, run, monkeypatch):
    monkeypatch.setattr("time.sleep", lambda _: None)
    server.add_folder(NAME, run)
    server.cut = 1000
    with pytest.raises(UserError, match=r"interrupted .*run the same command again") as cut:
        pewm_jax.load(NAME)
    assert "\n" not in str(cut.value)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.raises(UserError, match=r"not complete in the cache .* HF_HUB_OFFLINE is set"):
        pewm_jax.load(NAME)
    monkeypatch.delenv("HF_HUB_OFFLINE")
    server.cut = 0
    require_same(run, pewm_jax.load(NAME)[1])


def test_wrong_bytes_are_refused_and_removed(server, run):
    server.add_folder(NAME, run)
    server.wrong = True
    with pytest.raises(UserError, match=r"weights.safetensors in the cache is damaged"):
        pewm_jax.load(NAME)
    server.wrong = False
    hub._find.cache_clear()
    require_same(run, pewm_jax.load(NAME)[1])


def test_what_is_damaged_in_the_cache_is_seen_without_a_network(server, run, monkeypatch):
    server.add_folder(NAME, run)
    path = shipped.find(NAME) / "config.json"
    path.resolve().write_bytes(path.read_bytes().replace(b'"seed": 0', b'"seed": 1'))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.raises(UserError, match=r"config.json in the cache is damaged"):
        pewm_jax.load(NAME)


def test_an_absent_model_or_network_is_one_sentence(server, monkeypatch):
    with pytest.raises(UserError, match="the hub has no such model, or it is private"):
        pewm_jax.load("no-one/nothing")
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(UserError, match=r"the hub cannot be reached .* check the network") as error:
        pewm_jax.load("no-one/nothing")
    assert "\n" not in str(error.value)
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    hub._find.cache_clear()
    with pytest.raises(UserError, match=r"not a folder here; .* pip install 'pewm-jax\[hub\]'"):
        pewm_jax.load("no-one/nothing")


@pytest.mark.parametrize(
    "path", ["runs/demo", "data/demo", "here/demo", "a", "/a/b", "./a/b", "a/b/c"]
)
def test_paths_are_not_names(path, server):
    Path("here").mkdir()
    assert hub.parse(path) is None
    assert shipped.find(path) == Path(path)
    assert not server.requests


def test_the_command_line_needs_no_network_for_cached_models(server, run, tmp_path):
    server.add_folder(NAME, run)
    shipped.find(NAME)
    code = f"import pewm_jax; print(pewm_jax.load({NAME!r})[0].train.run)"
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(  # noqa: PLW1510
        [sys.executable, "-c", code], env=environment, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
