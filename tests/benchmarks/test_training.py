"""The benchmark of training: its clocks in the real loop, its sums, what it prints and refuses."""

import dataclasses
import json
import sys
from pathlib import Path

import pytest

from pewm_jax import presets as configs
from pewm_jax.cli import parser as cli
from pewm_jax.config import Config, UserError
from pewm_jax.data.collect import collect
from pewm_jax.data.make_episode import CollectConfig
from pewm_jax.train import loop
from tests.train import fakes

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def benchmark():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "benchmarks"))
        import training

        yield training
    for name in ("training", "training_parts", "record"):
        sys.modules.pop(name, None)


@pytest.fixture
def parts(benchmark):
    return benchmark.training_parts


@pytest.mark.slow
def test_the_clocks_see_every_step_save_and_line_of_the_real_loop(parts, fake_model, tmp_path):
    config = fakes.config(tmp_path / "run", stage1=12, stage2=12, save_every=4)
    with parts.clocks() as spans:
        loop.train(config, log=lambda _: None)
    assert len(spans["step1"]) == len(spans["step2"]) == 12
    assert len(spans["save"]) == 6
    assert len(spans["compile"]) == len(spans["initial"]) == 2
    assert len(spans["log"]) == 2 * 24
    assert "restore" not in spans
    for stage in (1, 2):
        found = parts.summary(spans, stage)
        assert (found["steps"], found["saves"]) == (9, 2)
        assert all(value >= 0 for value in found.values())
        assert found["log"] > 0
    first = parts.launch(spans, 1, spans["initial"][0][0] - 1)
    assert first["first"] >= 1 + first["compile"] + first["state"]


@pytest.mark.slow
def test_an_interrupted_training_is_measured_and_goes_on(parts, fake_model, tmp_path, monkeypatch):
    config = fakes.config(tmp_path / "run", stage1=8, stage2=8, save_every=100)
    monkeypatch.setattr(
        "pewm_jax.cli.main.execute", lambda _argv: loop.train(config, log=lambda _: None)
    )
    spans = parts.train_with_clocks(["tiny"], interrupt=(2, 5))
    assert (len(spans["step1"]), len(spans["step2"])) == (8, 5)
    spans = parts.train_with_clocks(["tiny"])
    assert ("step1" in spans, len(spans["step2"]), len(spans["restore"])) == (False, 3, 1)
    assert parts.launch(spans, 2, spans["restore"][0][0])["state"] > 0


def test_what_saving_and_logging_take_is_told_from_the_steps(parts):
    """Ten steps of a second; the save in the sixth blocks for two, the next is slowed by half."""
    starts = [0.0, 1, 2, 3, 4, 5, 6, 9, 10.5, 11.5, 12.5, 13.5]
    spans = {
        "step1": [(a, a + 0.1) for a in starts],
        "save": [(7.0, 9.0)],
        "log": [(a + 0.5, a + 0.51) for a in starts],
        "data": [(a + 0.2, a + 0.2) for a in starts],
    }
    found = parts.summary(spans, 1)
    assert found["step"] == pytest.approx(1)
    assert found["save"] == pytest.approx(2)
    assert found["behind"] == pytest.approx(0.5)
    assert found["log"] == pytest.approx(0.01)
    assert found["data"] == 0


def test_both_loaders_read_the_same_records(parts, tmp_path):
    collect(CollectConfig(tmp_path, train=2, validation=0, test=0, frames=24, size=16, workers=1))
    config = parts.reading(fakes.config(), path=str(tmp_path), context=4)
    found = parts.input_rates(config, batch=2, batches=2, rounds=1, processes=0)
    assert set(found) == {"1 thread", "2 threads", "torch"}
    assert all(seconds > 0 for (seconds,) in found.values())


def test_seconds_per_step_are_read_from_a_log(parts, tmp_path):
    lines = [{"stage": s, "step": k, "time": 100.0 * s + 2 * k} for s in (1, 2) for k in range(12)]
    (tmp_path / "metrics.jsonl").write_text("\n".join(map(json.dumps, lines)))
    assert parts.step_seconds(tmp_path, 2) == pytest.approx(2)


def test_the_tables_say_what_was_measured(benchmark):
    stage = {"step": 0.5, "save": 0.5, "behind": 0.1, "log": 0.001, "data": 0.0}
    start = {"first": 10.0, "compile": 4.0, "state": 1.0, "data": 0.5, "step": 0.5}
    found = {"stage1": stage, "stage2": stage, "cold": start, "resumed": start}
    config = dataclasses.replace(
        fakes.config(), train=dataclasses.replace(fakes.config().train, save_every=99)
    )
    text = benchmark.report_loop(found, config)
    assert "| stage 1 | 500 | 500 | 100 | 1.00% | 9.09% | 1.00 | 0.20% |" in text
    assert "| first start | 10.0 | 4.0 | 1.0 | 4.0 | 0.5 | 0.5 |" in text
    rates = {"batch": 16, "1 thread": [0.1, 0.1, 9], "2 threads": [0.05], "torch": [0.2]}
    assert "| pewm_jax, 1 thread | 100 | 160 | 5.0× | 5.0× |" in benchmark.report_input(
        rates, found
    )
    shared = benchmark.report_processes({"0": [0.1, 0.2], "4": [0.15, 0.2]})
    assert "| 4 | 150 | 1.50 | 200 | 1.00 |" in shared


def test_shards_are_there_more_than_once_to_save_time(benchmark, tmp_path):
    from pewm_jax.data.dataset import EpisodeSource

    made = benchmark.gather(tmp_path, 8, 1, 3)
    source = EpisodeSource(made / "train")
    assert [episode.name for episode in source] == ["train-000000"] * 3


def test_what_cannot_be_recorded_or_measured_is_refused(benchmark):
    with pytest.raises(UserError, match="leave out --only"):
        benchmark.main(["--only", "input", "--record"])
    with pytest.raises(UserError, match="--steps is 5"):
        benchmark.main(["--steps", "5"])


def test_a_part_that_fails_is_told_and_the_others_are_ended(benchmark, tmp_path):
    logs = [tmp_path / "a", tmp_path / "b"]
    codes = ("raise SystemExit('no luck')", "import time; time.sleep(60)")
    started = [benchmark.python(["-c", c], log) for c, log in zip(codes, logs, strict=True)]
    with pytest.raises(UserError, match="no luck"):
        benchmark.finish(started, logs)
    assert all(process.poll() is not None for process in started)


def test_the_settings_of_the_benchmark_exist(benchmark):
    config = cli.parse(Config, benchmark.SMALL, default=configs.load("tiny"), prog="train.py tiny")
    assert config.model.backbone.layers == 4
