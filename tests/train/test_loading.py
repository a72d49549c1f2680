"""``pewm_jax.load``: the newest whole weights of whatever training has left, and only those."""

import shutil

import jax
import numpy as np
import pytest

import pewm_jax
from pewm_jax.config import UserError
from pewm_jax.io import tree, weights
from pewm_jax.train import loop
from pewm_jax.train.checkpoint import Checkpoints
from tests.train import fakes


class PowerCutError(RuntimeError):
    pass


def train(config):
    loop.train(config, log=lambda _: None)


def spoil(folder):
    for path in folder.rglob("*"):
        if path.is_file():
            path.write_bytes(b"")


@pytest.fixture
def run(fake_model, tmp_path, monkeypatch):
    """A run that broke off in stage 2, after the checkpoint of step 4."""
    save = Checkpoints.save

    def save_and_die(self, state):
        save(self, state)
        if (self.stage.number, int(state.step)) == (2, 4):
            raise PowerCutError

    monkeypatch.setattr(Checkpoints, "save", save_and_die)
    with pytest.raises(PowerCutError):
        train(fakes.config(tmp_path / "run", save_every=2, keep=3))
    monkeypatch.setattr(Checkpoints, "save", save)
    return tmp_path / "run"


def same(left, right):
    left, right = tree.flatten(left), tree.flatten(right)
    assert left.keys() == right.keys()
    for path in left:
        assert np.asarray(left[path]).tobytes() == np.asarray(right[path]).tobytes(), path


def test_a_run_in_mid_training_gives_its_newest_checkpoint(run):
    config, params = pewm_jax.load(run)
    assert config.train.save_every == 2
    assert all(type(leaf) is np.ndarray for leaf in jax.tree.leaves(params))
    folder = run / "checkpoints"
    same(params, pewm_jax.load(folder / "stage2" / "4")[1])
    _, before = pewm_jax.load(folder / "stage2" / "2")
    assert before["memory"]["gate"].tobytes() != params["memory"]["gate"].tobytes()
    same(before["backbone"], params["backbone"])
    same(pewm_jax.load(folder / "stage1" / "6")[1], weights.load(run / "weights.safetensors"))


def test_runs_and_checkpoints_are_named_by_relative_paths_too(run, monkeypatch):
    _, params = pewm_jax.load(run)
    monkeypatch.chdir(run.parent)
    same(pewm_jax.load("run")[1], params)
    same(pewm_jax.load("run/checkpoints/stage2/4")[1], params)


def test_the_state_of_the_optimizer_is_never_touched(run):
    _, params = pewm_jax.load(run)
    newest = run / "checkpoints" / "stage2" / "4"
    spoil(newest / "state")
    same(pewm_jax.load(run)[1], params)
    shutil.rmtree(newest / "state")
    same(pewm_jax.load(run)[1], params)
    same(pewm_jax.load(newest)[1], params)


def test_weights_come_in_the_dtype_in_which_they_were_trained(fake_model, tmp_path):
    config = fakes.config(tmp_path / "run", dtype="bfloat16", stage1=2, stage2=2)
    train(config)
    _, params = pewm_jax.load(tmp_path / "run" / "checkpoints" / "stage2" / "2")
    assert {leaf.dtype.name for leaf in jax.tree.leaves(params["backbone"])} == {"bfloat16"}
    assert {leaf.dtype.name for leaf in jax.tree.leaves(params["memory"])} == {"float32"}
    same(params, pewm_jax.load(tmp_path / "run")[1])


def test_a_finished_run_gives_its_file_of_weights_also_without_checkpoints(run):
    config = fakes.config(run, save_every=2, keep=3)
    train(config)
    _, params = pewm_jax.load(run)
    same(params, weights.load(run / "weights.safetensors"))
    same(params, pewm_jax.load(run / "checkpoints" / "stage2" / "6")[1])
    shutil.rmtree(run / "checkpoints")
    same(params, pewm_jax.load(run)[1])


def test_a_damaged_newest_checkpoint_is_named_and_the_one_before_is_loaded(run):
    folder = run / "checkpoints" / "stage2"
    _, before = pewm_jax.load(folder / "2")
    spoil(folder / "4" / "weights")
    with pytest.warns(UserWarning, match=r"stage2/4 is damaged .* The previous one is loaded"):
        same(pewm_jax.load(run)[1], before)
    assert (folder / "4").exists()
    with pytest.raises(UserError, match=r"stage2/4 is damaged \(weights/.* and \d+ more\)"):
        pewm_jax.load(folder / "4")


def test_where_no_checkpoint_is_whole_the_stage_before_is_loaded_or_a_sentence_given(run):
    spoil(run / "checkpoints" / "stage2")
    with pytest.warns(UserWarning, match="is damaged"):
        assert set(pewm_jax.load(run)[1]) == {"backbone"}
    (run / "weights.safetensors").unlink()
    spoil(run / "checkpoints" / "stage1")
    with (
        pytest.warns(UserWarning, match="[Tt]he previous one"),
        pytest.raises(UserError, match=r"manifest\.json is damaged"),
    ):
        pewm_jax.load(run)


def test_a_damaged_file_of_weights_is_a_sentence_and_training_writes_it_again(run):
    config = fakes.config(run, save_every=2, keep=3)
    train(config)
    path = run / "weights.safetensors"
    whole = path.read_bytes()
    path.write_bytes(whole[:-3] + bytes([whole[-3] ^ 1]) + whole[-2:])
    with pytest.raises(UserError, match=r"weights.safetensors is damaged .* wrong checksum"):
        pewm_jax.load(run)
    train(config)
    assert path.read_bytes() == whole


def test_a_folder_without_weights_is_a_sentence(tmp_path):
    with pytest.raises(UserError, match="is this a run folder"):
        pewm_jax.load(tmp_path / "none")
