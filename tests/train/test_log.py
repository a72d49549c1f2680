"""Logs: each step once, whatever was interrupted; figures that people can read."""

import io
import json
import sys

import pytest
from rich.console import Console

from pewm_jax.config import Config, ConfigError, TrainConfig, UserError
from pewm_jax.train import log, sinks
from pewm_jax.train.sinks import drop_after
from pewm_jax.worlds.pewm.world import STAGES

ONE, TWO = STAGES[:2]
METRICS = {
    "loss": 0.5,
    "learning_rate": 1e-3,
    "grad_norm": 1.0,
    "step_seconds": 0.25,
    "clips_per_second": 32.0,
    "tflops_per_second_per_device": 2.5e-3,
}


def metrics_log(run, stage, step, *names):
    train = TrainConfig(run=str(run), log=names) if names else TrainConfig(run=str(run))
    return log.MetricsLog(run, stage, step, Config(train=train))


def lines(path):
    return [(e["stage"], e["step"]) for e in map(json.loads, path.read_text().splitlines())]


def test_what_was_logged_beyond_the_restored_step_is_dropped(tmp_path):
    path = tmp_path / "metrics.jsonl"
    with metrics_log(tmp_path, ONE, 0) as out:
        for step in (1, 2, 3):
            out.write(step, METRICS)
    with metrics_log(tmp_path, TWO, 0) as out:
        for step in (1, 2, 3):
            out.write(step, METRICS)
    with path.open("a") as file:
        file.write('{"stage": 2, "st')
    with metrics_log(tmp_path, TWO, 2) as out:
        assert lines(path) == [(1, 1), (1, 2), (1, 3), (2, 1), (2, 2)]
        out.write(3, METRICS)
    assert lines(path)[-1] == (2, 3)
    assert not list(tmp_path.glob("*.partial"))
    drop_after(path, 1, 1)
    assert lines(path) == [(1, 1)]


def test_a_line_is_json_whatever_the_values(tmp_path):
    def refuse(name):
        raise ValueError(name)

    with metrics_log(tmp_path, ONE, 0) as out:
        out.write(1, METRICS | {"loss": float("nan"), "grad_norm": float("inf")})
    (line,) = (tmp_path / "metrics.jsonl").read_text().splitlines()
    entry = json.loads(line, parse_constant=refuse)
    assert (entry["loss"], entry["grad_norm"], entry["learning_rate"]) == (None, None, 1e-3)


def test_tensorboard_files_are_written_per_stage(tmp_path):
    for stage in (ONE, TWO):
        with metrics_log(tmp_path, stage, 0) as out:
            out.write(1, METRICS)
    for name in ("stage1", "stage2"):
        (events,) = (tmp_path / "tensorboard" / name).glob("events.*")
        assert b"clips_per_second" in events.read_bytes()


WRITTEN = {
    "jsonl": {"metrics.jsonl"},
    "tensorboard": {"tensorboard"},
    "rerun": {"rerun"},
    "none": set(),
}


@pytest.mark.parametrize("names", [("none",), ("jsonl",), ("tensorboard", "jsonl"), ("rerun",)])
def test_only_the_named_logs_are_written(names, tmp_path):
    if "rerun" in names:
        pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    with metrics_log(tmp_path, ONE, 0, *names) as out:
        out.write(1, METRICS)
    assert {path.name for path in tmp_path.iterdir()} == set().union(*(WRITTEN[n] for n in names))


def test_the_recording_of_a_resumed_stage_is_continued_in_another_file(tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    for first in (0, 2):
        with metrics_log(tmp_path, ONE, first, "rerun") as out:
            out.write(first + 1, METRICS | {"loss": float("nan")})
    files = sorted(path.name for path in (tmp_path / "rerun").iterdir())
    assert files == ["stage1-0000001.rrd", "stage1-0000003.rrd"]
    for file in files:
        content = (tmp_path / "rerun" / file).read_bytes()
        assert b"grad_norm" in content
        assert f"{tmp_path.name}-stage1".encode() in content


@pytest.mark.parametrize(
    "names",
    [(), ("csv",), ("none", "jsonl"), ("jsonl", "jsonl"), ("wandb", "wandb:a"), ("jsonl:",)],
)
def test_an_unknown_log_is_refused(names):
    with pytest.raises(ConfigError, match=r"train.log .* use one or several of jsonl, tensorboard"):
        TrainConfig(log=names)


def test_a_missing_package_is_named_with_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(UserError, match=r"train.log rerun .* pip install 'pewm-jax\[rerun\]'\.$"):
        sinks.require_packages(Config(train=TrainConfig(log=("rerun",))))


def view(total, done=0):
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=False, soft_wrap=True)
    return log.LiveView("stage 1", total, done, console), stream


def test_without_a_terminal_there_is_a_line_now_and_then_and_one_at_the_end(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(log.time, "monotonic", lambda: clock[0])
    live, stream = view(total=100)
    with live:
        for step in range(1, 101):
            clock[0] += 1.0
            live.update(step, METRICS)
    told = stream.getvalue().splitlines()
    assert len(told) == 10
    assert told[0].startswith("stage 1 10/100 loss 0.5000")
    assert told[0].endswith("22.5 s left")
    assert told[-1].startswith("stage 1 100/100")


def test_a_line_names_rate_flops_and_time_left():
    text = log.describe(METRICS, 90)
    assert text == (
        "loss 0.5000 · lr 1.00e-03 · grad 1 · 250 ms/step · 32.0 clips/s · 2.5 GFLOP/s/device · "
        "1 min 30 s left"
    )


def test_a_line_names_utilisation_where_the_peak_is_known_and_what_went_wrong():
    known = {"tflops_per_second_per_device": 412.34, "mfu": 0.4168}
    text = log.describe(METRICS | known | {"skipped": 2.0, "bad_records": 0.0}, 90)
    assert "412.3 TFLOP/s/device · MFU 41.7% · skipped 2 · 1 min 30 s left" in text
    assert "bad records 1 ·" in log.describe(METRICS | {"bad_records": 1.0}, 90)


def test_on_a_terminal_there_is_a_bar():
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=True, width=160)
    with log.LiveView("stage 1", 10, 4, console) as live:
        live.update(5, METRICS)
        live.log("a picture")
    assert "5/10" in stream.getvalue()
    assert "a picture" in stream.getvalue()


def test_pauses_do_not_count_as_steps():
    pace = log.Pace(0.0)
    assert pace.tick(2.0) == 2.0
    pace.pause(10.0)
    assert pace.tick(14.0) == pytest.approx(2.0)


def test_the_pace_is_a_mean_at_first_and_forgets_later():
    pace, now = log.Pace(0.0), 0.0
    for seconds in (3.0, 1.0, 2.0):
        now += seconds
        mean = pace.tick(now)
    assert mean == pytest.approx(2.0)
    for _ in range(200):
        now += 0.5
        mean = pace.tick(now)
    assert mean == pytest.approx(0.5, abs=1e-3)
