"""What is not finite stops or is skipped, by name; traces and previews come when they are asked."""

import contextlib
import dataclasses
import json
import os
import signal
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from pewm_jax.config import UserError
from pewm_jax.data import loader
from pewm_jax.io import weights
from pewm_jax.train import chips, flops, loop, optimizer, step, watch
from pewm_jax.train import watch as samples
from pewm_jax.train.sharding import make_mesh
from pewm_jax.train.signals import Interrupted
from tests.train import fakes

BAD = 5
"""The step whose batch makes everything NaN."""


@pytest.fixture
def nan_at_5(fake_model, monkeypatch):
    fakes.install(monkeypatch, fakes.loss_of_depth)
    monkeypatch.setattr(loader, "clips", fakes.without_depth_at(BAD))


def lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def train(config, **options):
    loop.train(config, log=lambda _: None, **options)


def test_stopping_writes_the_step_and_the_records_and_names_the_file(nan_at_5, tmp_path):
    with pytest.raises(UserError) as stopped:
        train(fakes.config(tmp_path))
    path = tmp_path / "nonfinite-stage1-5.json"
    for part in ("stopped at step 5: loss nan", "step 3 is intact", str(path), "on_nonfinite skip"):
        assert part in str(stopped.value)
    entry = json.loads(path.read_text())
    assert (entry["stage"], entry["step"], entry["loss"]) == (1, 5, "nan")
    assert entry["records"] == [f"record 1004-{row}" for row in range(8)]
    assert not list(tmp_path.glob("*.partial"))


def test_a_skipped_update_leaves_all_but_the_step_as_it_was(fake_model):
    stage, config = fakes.replaced(fakes.loss_of_depth)[1], fakes.config(on_nonfinite="skip")
    mesh = make_mesh(jax.devices()[:1])
    key = step.noise_key(config, stage)
    good = fakes.clip(config, 8, 0)
    bad = fakes.without_depth(good)
    take = step.compile_step(config, stage, mesh, good)
    state, metrics = take(step.initial_state(config, stage, mesh), good, key)
    assert not metrics["skipped"]
    before = jax.device_get(state)
    state, metrics = take(state, bad, key)
    assert metrics["skipped"]
    after = jax.device_get(state)
    assert int(after.step) == int(before.step) + 1 == 2
    assert jax.tree.all(
        jax.tree.map(np.array_equal, dataclasses.replace(after, step=before.step), before)
    )
    state, metrics = take(state, good, key)
    assert not metrics["skipped"]
    rate = optimizer.schedule(stage.settings(config))
    assert float(metrics["learning_rate"]) == pytest.approx(float(rate(1))), "that of Adam's count"
    moved = jax.device_get(state).params["memory"]["kernel"]
    assert np.isfinite(moved).all()
    assert not np.array_equal(moved, before.params["memory"]["kernel"])


def test_skipping_goes_on_counts_and_names_the_records(nan_at_5, tmp_path):
    config = fakes.config(tmp_path, on_nonfinite="skip")
    train(config)
    params = weights.load(tmp_path / "weights.safetensors")
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))
    entries = lines(tmp_path / watch.SKIPPED)
    assert [(entry["stage"], entry["step"]) for entry in entries] == [(1, 5), (2, 5)]
    assert entries[1]["records"] == [f"record 2004-{row}" for row in range(8)]
    counts = [(e["stage"], e["step"], e["skipped"]) for e in lines(tmp_path / "metrics.jsonl")]
    assert counts == [
        (stage, number, float((stage == 2) + (number >= BAD)))
        for stage in (1, 2)
        for number in range(1, 7)
    ]


@pytest.mark.parametrize("last", [4, 6])
def test_the_count_goes_on_right_after_a_kill(nan_at_5, tmp_path, last):
    def die(_params, stage, number):
        if (stage.number, number) == (1, last):
            raise RuntimeError("power cut")
        return samples.Previewed(())

    config = fakes.config(tmp_path / "whole", stage2=0, on_nonfinite="skip")
    train(config)
    config = fakes.config(tmp_path / "killed", stage2=0, on_nonfinite="skip", preview_every=1)
    with pytest.raises(RuntimeError, match="power cut"):
        train(config, preview=die)
    train(fakes.with_train(config, preview_every=0))
    for name in (watch.SKIPPED, "metrics.jsonl"):
        one, two = (
            [(e["stage"], e["step"], e.get("skipped"), e["loss"]) for e in lines(folder / name)]
            for folder in (tmp_path / "whole", tmp_path / "killed")
        )
        assert one == two
    one, two = ((tmp_path / run / "weights.safetensors") for run in ("whole", "killed"))
    assert one.read_bytes() == two.read_bytes()


def test_records_that_cannot_be_named_do_not_hide_why_training_stopped(
    nan_at_5, tmp_path, monkeypatch
):
    def gone(*_args, **_options):
        raise UserError("the data are gone")

    monkeypatch.setattr(loader, "records", gone)
    with pytest.raises(UserError, match="stopped at step 5"):
        train(fakes.config(tmp_path))
    entry = json.loads((tmp_path / "nonfinite-stage1-5.json").read_text())
    assert (entry["records"], entry["why_not"]) == ([], "the data are gone")


def test_utilisation_is_told_where_the_chip_is_known(fake_model, tmp_path, monkeypatch):
    train(fakes.config(tmp_path / "cpu", stage2=0))
    assert all("mfu" not in entry for entry in lines(tmp_path / "cpu" / "metrics.jsonl"))
    monkeypatch.setattr(chips, "find", lambda _kind: chips.CHIPS[0])
    train(fakes.config(tmp_path / "chip", stage2=0))
    for entry in lines(tmp_path / "chip" / "metrics.jsonl"):
        rate = entry["tflops_per_second_per_device"] * 1e12
        assert entry["mfu"] == pytest.approx(rate / chips.CHIPS[0].flops)
        per_step = rate * entry["step_seconds"] * jax.device_count()
        clip = fakes.clip(fakes.config(), 8, 0)
        needed = flops.of_stage(fakes.config(), fakes.STAGES[0], clip).total
        assert per_step == pytest.approx(needed)
        assert entry["clips_per_second"] == pytest.approx(8 / entry["step_seconds"])


def test_a_profile_is_written_and_said_where(fake_model, tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr(loop.LiveView, "log", lambda _view, text: told.append(text))
    train(fakes.config(tmp_path, stage2=0), profile=2)
    folder = tmp_path / "profile" / "stage1"
    (trace,) = folder.rglob("*.xplane.pb")
    assert trace.stat().st_size > 0
    (line,) = [text for text in told if "traced" in text]
    assert line.startswith(f"stage 1: traced 2 steps; open with `tensorboard --logdir {folder}")
    assert str(next(folder.rglob("*.trace.json.gz"))) in line


@pytest.mark.parametrize(
    ("steps", "first", "last", "traced"),
    [(0, 1, 9, []), (2, 1, 9, [3, 4]), (9, 1, 4, [1, 2, 3, 4]), (2, 8, 9, [8, 9]), (1, 9, 9, [9])],
)
def test_the_first_steps_are_traced_only_where_there_are_no_others(
    monkeypatch, tmp_path, steps, first, last, traced
):
    seen, ended, told = [], [], []
    monkeypatch.setattr(jax.profiler, "start_trace", seen.append)
    monkeypatch.setattr(jax.profiler, "stop_trace", lambda: ended.append(now))
    profile = loop.Profile(
        tmp_path, fakes.STAGES[0], steps=steps, first=first, last=last, log=told.append
    )
    annotated = []
    monkeypatch.setattr(
        jax.profiler,
        "StepTraceAnnotation",
        lambda _name, step_num: contextlib.nullcontext(annotated.append(step_num)),
    )
    for now in range(first, last + 1):
        with profile.around(now):
            pass
        profile.after(now, None)
    profile.close()
    assert annotated == traced
    assert (len(seen), ended) == ((1, traced[-1:]) if traced else (0, []))
    said = f"traced {len(traced)} step{'s' * (len(traced) > 1)};"
    assert [said in line for line in told] == [True] * len(seen)


def test_a_trace_that_is_broken_off_counts_what_it_holds(monkeypatch, tmp_path):
    monkeypatch.setattr(jax.profiler, "start_trace", lambda _folder: None)
    monkeypatch.setattr(jax.profiler, "stop_trace", lambda: None)
    told = []
    profile = loop.Profile(tmp_path, fakes.STAGES[0], steps=5, first=1, last=9, log=told.append)
    with profile.around(3):
        pass
    profile.close()
    (line,) = told
    assert "traced 1 step;" in line


def test_what_a_preview_measures_stands_in_its_steps_line(fake_model, tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr(loop.LiveView, "log", lambda _view, text: told.append(text))

    def preview(_params, stage, number):
        psnr = {"model": 12.5} if stage.number == 1 else {"memory": 15.25, "empty": 13.0 + number}
        return samples.Previewed((Path("a.png"), Path("a.mp4")), psnr)

    train(fakes.config(tmp_path, preview_every=4, log_every=5), preview=preview)
    entries = {(e["stage"], e["step"]): e for e in lines(tmp_path / "metrics.jsonl")}
    assert list(entries) == [(stage, number) for stage in (1, 2) for number in (1, 4, 5, 6)]
    assert entries[1, 4]["psnr_model"] == 12.5
    assert (entries[2, 6]["psnr_memory"], entries[2, 6]["psnr_empty"]) == (15.25, 19.0)
    assert "psnr_memory" not in entries[2, 5]
    assert (
        "stage 2: with its map 15.2 dB, empty map 17.0 dB; sample pictures a.png and a.mp4" in told
    )
    (events,) = (tmp_path / "tensorboard" / "stage2").glob("events.*")
    assert b"psnr_memory" in events.read_bytes()


def test_a_preview_that_does_not_fit_costs_a_line_and_not_the_training(
    fake_model, tmp_path, monkeypatch
):
    told = []
    monkeypatch.setattr(loop.LiveView, "log", lambda _view, text: told.append(text))

    def preview(_params, _stage, _number):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory")

    train(fakes.config(tmp_path, stage2=0, preview_every=4), preview=preview)
    assert (tmp_path / "weights.safetensors").exists()
    assert any(
        "no sample pictures of step 4 (RESOURCE_EXHAUSTED: out of memory)" in t for t in told
    )


def test_a_signal_while_no_batch_comes_saves_the_last_step(fake_model, tmp_path, monkeypatch):
    def stuck(config, split="train", *, seed, batch, start_step=0, **_options):
        source = fakes.clips(config, split, seed=seed, batch=batch, start_step=start_step)
        for number, clip in enumerate(source, start_step + 1):
            if number == 5:
                while len(lines(tmp_path / "metrics.jsonl")) < 3:  # step 4 is being done
                    time.sleep(0.01)
                time.sleep(0.1)
                os.kill(os.getpid(), signal.SIGTERM)
            yield clip

    with monkeypatch.context() as patch:
        patch.setattr(loader, "clips", stuck)
        with pytest.raises(Interrupted, match="after step 4 of stage 1"):
            train(fakes.config(tmp_path, save_every=100))
    steps = [(e["stage"], e["step"]) for e in lines(tmp_path / "metrics.jsonl")]
    assert steps == [(1, number) for number in range(1, 5)]
    train(fakes.config(tmp_path))
    train(fakes.config(tmp_path / "whole"))
    one, two = (folder / "weights.safetensors" for folder in (tmp_path, tmp_path / "whole"))
    assert one.read_bytes() == two.read_bytes()
