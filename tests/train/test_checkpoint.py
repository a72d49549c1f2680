"""Checkpoints: exact, safe under donation, and never read half-written or for another run."""

import dataclasses
import threading

import jax
import numpy as np
import pytest

from pewm_jax.config import UserError
from pewm_jax.io import tree
from pewm_jax.train import checkpoint, checkpoint_files, runs, sharding, step
from pewm_jax.train.checkpoint import Checkpoints
from tests.train import fakes

ONE, TWO = fakes.STAGES[:2]


def train(config, stage, run, steps, every=1):
    """Train without waiting, saving as the steps go by; returns the states after each save."""
    mesh = sharding.make_mesh(jax.devices()[:1])
    state = step.initial_state(config, stage, mesh)
    step_fn = step.compile_step(config, stage, mesh, fakes.clip(config, 8, 0))
    clip = jax.device_put(fakes.clip(config, 8, 0), sharding.of_batch(mesh))
    key, saved = step.noise_key(config, stage), {}
    with Checkpoints(run, config, stage) as checkpoints:
        for number in range(1, steps + 1):
            state, _ = step_fn(state, clip, key)
            if number % every == 0:
                saved[number] = jax.tree.map(np.array, state)
                checkpoints.save(state)
    return mesh, saved


def same(left, right):
    assert jax.tree.structure(left) == jax.tree.structure(right)
    for path, leaf in tree.flatten(left).items():
        assert np.asarray(leaf).tobytes() == np.asarray(tree.flatten(right)[path]).tobytes(), path


@pytest.mark.parametrize("stage", [ONE, TWO])
def test_the_state_comes_back_bit_identical_though_its_buffers_were_donated_on(
    fake_model, tmp_path, stage
):
    config = fakes.config(keep=3)
    mesh, saved = train(config, stage, tmp_path, 9, every=2)
    like = step.abstract_state(config, stage, mesh)
    with Checkpoints(tmp_path, config, stage) as checkpoints:
        assert checkpoints.latest() == 8
        same(checkpoints.restore(like), saved[8])
        weights = checkpoints.restore_weights(like)
    assert tree.mismatches(weights, saved[8].params) == []
    same(tree.select(weights, stage.trained), saved[8].ema)
    folder = tmp_path / "checkpoints" / stage.name
    assert {path.name for path in folder.iterdir()} == {"4", "6", "8"}


def test_a_checkpoint_of_another_configuration_is_refused_with_the_setting(fake_model, tmp_path):
    config = fakes.config()
    mesh, _ = train(config, ONE, tmp_path, 1)
    other = fakes.with_train(config, seed=3)
    with (
        Checkpoints(tmp_path, other, ONE) as checkpoints,
        pytest.raises(UserError, match=r"another configuration \(train\.seed 0 there, 3 here\)"),
    ):
        checkpoints.restore(step.abstract_state(other, ONE, mesh))


def test_an_unfinished_checkpoint_is_not_there(fake_model, tmp_path):
    config = fakes.config()
    train(config, ONE, tmp_path, 2)
    folder = tmp_path / "checkpoints" / "stage1"
    (folder / "2").rename(folder / "2.writing")
    with Checkpoints(tmp_path, config, ONE) as checkpoints:
        assert checkpoints.latest() == 1
    assert [path.name for path in folder.iterdir()] == ["1"]


def test_the_newest_and_every_so_many_th_are_kept(fake_model, tmp_path):
    train(fakes.config(keep=2, keep_every=4), ONE, tmp_path, 11)
    folder = tmp_path / "checkpoints" / "stage1"
    assert {path.name for path in folder.iterdir()} == {"4", "8", "10", "11"}
    for path in folder.iterdir():
        assert {item.name for item in path.iterdir() if item.is_dir()} == {
            "weights",
            "state",
            "data",
            "config",
        }


def test_a_save_is_waited_for_within_reason_before_a_step_is_told_of(
    fake_model, tmp_path, monkeypatch
):
    config = fakes.config()
    mesh, _ = train(config, ONE, tmp_path, 1)
    state = step.initial_state(config, ONE, mesh)
    go_on, put = threading.Event(), checkpoint_files.put
    monkeypatch.setattr(checkpoint_files, "put", lambda *args: (go_on.wait(), put(*args)))
    monkeypatch.setattr(checkpoint, "_MOMENT_S", 0.01)
    with Checkpoints(tmp_path, config, ONE) as checkpoints:
        checkpoints.save(state)
        checkpoints.settle()
        assert checkpoints.latest() == 1
        monkeypatch.setattr(checkpoint, "_MOMENT_S", 1e9)
        checkpoints.settle()
        assert checkpoints.latest() == 1, "what is slow is waited for once only"
        go_on.set()
        checkpoints.wait()
        assert checkpoints.latest() == 0
        checkpoints.save(dataclasses.replace(state, step=state.step + 5))
        checkpoints.settle()
        assert checkpoints.latest() == 5


def test_what_fails_in_the_background_is_told_at_the_next_step(fake_model, tmp_path, monkeypatch):
    config = fakes.config()
    mesh, _ = train(config, ONE, tmp_path, 1)
    state = step.initial_state(config, ONE, mesh)

    def full(*_args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint_files, "put", full)
    with Checkpoints(tmp_path, config, ONE) as checkpoints:
        checkpoints.save(state)
        with pytest.raises(UserError, match=r"\(No space left.*\); the checkpoint of step 1 is"):
            checkpoints.settle()
    assert [path.name for path in (tmp_path / "checkpoints" / "stage1").iterdir()] == ["1"]


def test_without_a_checkpoint_there_is_a_sentence(fake_model, tmp_path):
    config = fakes.config()
    with (
        Checkpoints(tmp_path, config, ONE) as checkpoints,
        pytest.raises(UserError, match="no complete checkpoint"),
    ):
        checkpoints.restore_weights(
            step.abstract_state(config, ONE, sharding.make_mesh(jax.devices()[:1]))
        )


@pytest.mark.parametrize("where", ["save", "wait_until_finished"])
def test_a_full_disk_is_a_sentence_that_says_which_checkpoint_is_kept(
    fake_model, tmp_path, monkeypatch, where
):
    config = fakes.config()
    mesh, _ = train(config, ONE, tmp_path, 2)
    state = step.initial_state(config, ONE, mesh)

    def full(*_args, **_options):
        raise OSError(28, "No space left on device")

    with Checkpoints(tmp_path, config, ONE) as checkpoints, monkeypatch.context() as patch:
        patch.setattr(checkpoints._writer, where, full)
        with pytest.raises(UserError, match=r"No space left .* the checkpoint of step 2 is kept"):
            (checkpoints.save(state), checkpoints.wait())
        assert checkpoints.latest() == 2


def test_what_a_killed_process_left_beside_the_weights_is_removed(tmp_path):
    for name in ("weights.safetensors.partial", "weights.safetensors.123.partial"):
        (tmp_path / name).touch()
    runs.publish(tmp_path, ONE, 3, {"kernel": np.ones(2)})
    assert [path.name for path in tmp_path.iterdir()] == [runs.WEIGHTS]
