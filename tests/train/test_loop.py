"""The loop: resuming is exact, stopping is clean, and what does not fit is refused."""

import itertools
import json
import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest

from pewm_jax import config as configuration
from pewm_jax.config import ConfigError, UserError
from pewm_jax.data import loader
from pewm_jax.io import weights
from pewm_jax.train import loop, runs
from pewm_jax.train.signals import Interrupted
from pewm_jax.train.watch import Previewed
from tests.train import fakes

PICTURE = Previewed((Path("picture.png"),))


def train(config, **options):
    said = []
    loop.train(config, log=said.append, **options)
    return said


def losses(run):
    entries = map(json.loads, (run / "metrics.jsonl").read_text().splitlines())
    return [(e["stage"], e["step"], e["loss"], e["grad_norm"]) for e in entries]


def file_bytes(run):
    return (run / "weights.safetensors").read_bytes()


class StopAt:
    """A preview that sends a signal at one step of one stage."""

    def __init__(self, stage, step, number=signal.SIGTERM):
        self.when, self.number, self.seen = (stage, step), number, []

    def __call__(self, params, stage, step):
        self.seen.append((stage.number, step))
        if (stage.number, step) == self.when:
            os.kill(os.getpid(), self.number)
        return PICTURE


@pytest.fixture
def undisturbed(fake_model, tmp_path):
    run = tmp_path / "undisturbed"
    train(fakes.config(run))
    return run


def test_a_run_leaves_all_that_inference_needs(undisturbed):
    config = configuration.load(undisturbed / "config.json")
    assert config == fakes.config(undisturbed)
    params = weights.load(undisturbed / "weights.safetensors")
    assert set(params) == {"backbone", "memory"}
    assert weights.metadata(undisturbed / "weights.safetensors") == {"stage": "2", "step": "6"}
    assert [entry[:2] for entry in losses(undisturbed)] == list(
        itertools.product((1, 2), range(1, 7))
    )


@pytest.mark.slow(but=("3-2", "4-2", "6-1"))
@pytest.mark.parametrize("stage", [1, 2])
@pytest.mark.parametrize("step", [3, 4, 6])
def test_a_stopped_run_goes_on_bit_identically(undisturbed, tmp_path, stage, step):
    config = fakes.config(tmp_path / "stopped", preview_every=1)
    stopper = StopAt(stage, step)
    if (stage, step) == (2, 6):
        train(config, preview=stopper)
    else:
        with pytest.raises(Interrupted) as stopped:
            train(config, preview=stopper)
        assert stopped.value.exit_code == 143
        assert f"after step {step} of stage {stage}" in str(stopped.value)
    train(config)
    assert losses(tmp_path / "stopped") == losses(undisturbed)
    assert file_bytes(tmp_path / "stopped") == file_bytes(undisturbed)


def test_a_killed_run_goes_on_from_its_last_checkpoint(undisturbed, tmp_path):
    config = fakes.config(tmp_path / "killed", preview_every=1)

    def die(_params, stage, step):
        if (stage.number, step) == (2, 5):
            raise RuntimeError("power cut")

    with pytest.raises(RuntimeError, match="power cut"):
        train(config, preview=die)
    train(config)
    assert losses(tmp_path / "killed") == losses(undisturbed)
    assert file_bytes(tmp_path / "killed") == file_bytes(undisturbed)


def test_ctrl_c_ends_with_130_and_the_handlers_are_put_back(fake_model, tmp_path):
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(Interrupted) as stopped:
        train(fakes.config(tmp_path, preview_every=1), preview=StopAt(1, 2, signal.SIGINT))
    assert stopped.value.exit_code == 130
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_stage_2_starts_from_the_average_of_stage_1_and_leaves_it(fake_model, tmp_path):
    train(fakes.config(tmp_path, stage2=0))
    after_one = weights.load(tmp_path / "weights.safetensors")
    assert set(after_one) == {"backbone"}
    other = tmp_path / "both"
    train(fakes.config(other))
    after_two = weights.load(other / "weights.safetensors")
    for name, leaf in after_one["backbone"].items():
        assert leaf.tobytes() == after_two["backbone"][name].tobytes()


@pytest.mark.parametrize("stage1", [0, 3])
def test_memory_blocks_of_the_start_go_on_in_stage_2_alone(undisturbed, tmp_path, stage1):
    config = fakes.config(tmp_path / "on", stage1=stage1, stage2=3, start=str(undisturbed))
    config = fakes.with_stage(config, "stage2", learning_rate=1e-9)
    said = train(config)
    kept = weights.load(undisturbed / "weights.safetensors")["memory"]
    now = weights.load(tmp_path / "on" / "weights.safetensors")["memory"]
    near = all(np.allclose(now[name], kept[name], atol=1e-6) for name in kept)
    assert near == (stage1 == 0)
    assert any("memory blocks are ignored" in line for line in said) == (stage1 > 0)


def test_a_finished_run_says_so_and_does_nothing(undisturbed, monkeypatch):
    monkeypatch.setattr(loader, "clips", None)
    before = file_bytes(undisturbed)
    assert train(fakes.config(undisturbed)) == [f"{undisturbed} is already trained: nothing to do."]
    assert file_bytes(undisturbed) == before


def test_weights_lost_after_training_are_written_again_without_training(undisturbed, monkeypatch):
    monkeypatch.setattr(loader, "clips", None)
    before = file_bytes(undisturbed)
    (undisturbed / "weights.safetensors").unlink()
    train(fakes.config(undisturbed))
    assert file_bytes(undisturbed) == before


def test_another_configuration_is_refused_with_the_settings_that_differ(undisturbed):
    before = (undisturbed / "config.json").read_text()
    other = fakes.with_stage(fakes.config(undisturbed, seed=1), "stage2", learning_rate=0.5)
    with pytest.raises(ConfigError) as refused:
        train(other)
    for part in ("train.seed 0 there, 1 here", "train.stage2.learning_rate 0.01 there, 0.5 here"):
        assert part in str(refused.value)
    assert (undisturbed / "config.json").read_text() == before


def test_settings_that_do_not_change_what_is_learnt_may_change(undisturbed):
    config = fakes.config(undisturbed, log_every=5, save_every=100)
    assert "already trained" in train(config)[0]
    assert configuration.load(undisturbed / "config.json") == config


def test_a_folder_in_which_nothing_was_trained_yet_takes_the_new_configuration(
    fake_model, tmp_path, monkeypatch
):
    def broken(*_args, **_options):
        raise UserError("no data there")

    with monkeypatch.context() as patch:
        patch.setattr(loader, "clips", broken)
        with pytest.raises(UserError, match="no data there"):
            train(fakes.config(tmp_path, seed=1))
    train(fakes.config(tmp_path))
    assert configuration.load(tmp_path / "config.json").train.seed == 0


def test_a_loss_that_is_not_finite_stops_at_its_step_and_the_checkpoint_before_is_kept(
    fake_model, tmp_path, monkeypatch
):
    def poisoned(config, split="train", *, seed, batch, start_step=0, **_options):
        for number, clip in enumerate(
            fakes.clips(config, split, seed=seed, batch=batch, start_step=start_step),
            start_step + 1,
        ):
            bad = number == 5
            yield clip if not bad else fakes.clip(config, batch, 0)

    config = fakes.config(tmp_path)

    def loss(model, train, params, clip, key, *, memory):
        value, metrics = fakes.loss(model, train, params, clip, key, memory=memory)
        first = fakes.clip(config, 8, 0).frames.rgb_THWC[0, 0, 0, 0]
        bad = (clip.frames.rgb_THWC[0, 0, 0, 0] == first).all()
        return fakes.jnp.where(bad, np.nan, 1.0) * value, metrics

    fakes.install(monkeypatch, loss)
    monkeypatch.setattr(loader, "clips", poisoned)
    with pytest.raises(UserError, match=r"stopped at step 5: loss nan .* step 3 is intact"):
        train(config)
    with pytest.raises(UserError, match="at step 5"):
        train(config)


def test_previews_come_at_their_steps_and_at_the_end_of_a_stage(fake_model, tmp_path):
    watcher = StopAt(0, 0)
    train(fakes.config(tmp_path, preview_every=4), preview=watcher)
    assert watcher.seen == [(1, 4), (1, 6), (2, 4), (2, 6)]


def test_two_trainings_in_one_folder_are_refused(fake_model, tmp_path):
    first = fakes.config(tmp_path, stage2=0)
    with runs.alone(tmp_path):
        runs.prepare(first)
        with pytest.raises(UserError, match="Another process"):
            train(fakes.config(tmp_path, seed=1))
        assert configuration.load(tmp_path / "config.json") == first
    train(first)


def test_a_run_folder_that_is_a_file_is_refused(fake_model, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be created"):
        train(fakes.config(tmp_path / "file"))


def test_a_start_without_weights_is_refused_before_the_folder_is_made(fake_model, tmp_path):
    nowhere, run = tmp_path / "nowhere", tmp_path / "run"
    with pytest.raises(UserError, match=r"train\.start is .*nowhere, which has no weights"):
        train(fakes.config(run, start=str(nowhere)))
    assert not run.exists()


def test_a_run_that_has_begun_goes_on_without_the_weights_it_started_from(undisturbed, tmp_path):
    start, run = tmp_path / "start", tmp_path / "run"
    shutil.copytree(undisturbed, start)
    config = fakes.config(run, start=str(start), preview_every=1)
    with pytest.raises(Interrupted):
        train(config, preview=StopAt(1, 3))
    shutil.rmtree(start)
    train(config)
    assert runs.is_finished(run, config)


def test_nothing_is_compiled_unannounced(fake_model, tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr(loop.LiveView, "log", lambda _view, text: told.append(text))

    def noting(name):
        real = getattr(loop, name)
        return lambda *args: (told.append(name), real(*args))[1]

    for name in ("initial_state", "compile_step"):
        monkeypatch.setattr(loop, name, noting(name))

    def preview(_params, _stage, step):
        told.append(f"preview {step}")
        return PICTURE

    train(fakes.config(tmp_path, stage1=2, stage2=0, preview_every=1), preview=preview)
    told = [text for text in told if "compiled" not in text and "loss" not in text]
    assert told == [
        "stage 1: compiling the training step …",
        "initial_state",
        "compile_step",
        "stage 1: compiling the sampler for sample pictures …",
        "preview 1",
        "stage 1: sample pictures picture.png",
        "preview 2",
        "stage 1: sample pictures picture.png",
    ]
