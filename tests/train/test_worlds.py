"""A task with stages of its own names and number is trained as PEWM is: nothing knows two."""

import dataclasses
import json
import shutil
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec as P

import pewm_jax
from pewm_jax import config as configuration
from pewm_jax import registry as kinds
from pewm_jax.config import Config, ConfigError, StageConfig, Task, TrainSettings, register
from pewm_jax.data import loader
from pewm_jax.io import tree
from pewm_jax.train import loop, runs
from pewm_jax.train import watch as samples
from pewm_jax.worlds.stages import FREEZE, TRAIN, Stage

STEPS = StageConfig(steps=4, batch=8, warmup=0, learning_rate=0.1)
NAMES = ("warm_up", "fit", "fit2")


@dataclasses.dataclass(frozen=True)
class ThreeStages(TrainSettings):
    warm_up: StageConfig = STEPS
    fit: StageConfig = STEPS
    fit2: StageConfig = STEPS


@dataclasses.dataclass(frozen=True)
class LineConfig(Task):
    """A line through points: the task needs no clip, no codec and no memory."""

    TRAIN: ClassVar[type[TrainSettings]] = ThreeStages

    width: int = 3

    def init(self, key):
        return init(self, key)

    def stages(self):
        return line_stages(self)

    def sharding(self):
        return (("slope", P("fsdp")), ("offset", P()))


def init(model, key):
    return {"slope": jax.random.normal(key, (model.width,)), "offset": jnp.zeros(())}


def loss(model, train, params, clip, key):
    error = clip["x"] @ params["slope"] + params["offset"] - clip["y"]
    return jnp.mean(error**2), {"worst": jnp.abs(error).max()}


def line_stages(model):
    trained = ("slope", "offset", "slope|offset")
    return tuple(
        Stage(name, number, ((pattern, TRAIN), (r".*", FREEZE)), init, loss)
        for number, (name, pattern) in enumerate(zip(NAMES, trained, strict=True), 1)
    )


def clips(config, split="train", *, seed, batch, start_step=0, **_options):
    for step in range(start_step, 1000):
        rng = np.random.default_rng((seed, step))
        x = rng.normal(size=(batch, config.model.width)).astype(np.float32)
        yield {"x": x, "y": x.sum(-1) + 2}


@pytest.fixture
def line(monkeypatch):
    """Register the task, for one test."""
    monkeypatch.setattr(kinds, "_KINDS", dict(kinds._KINDS))
    monkeypatch.setattr(loader, "clips", clips)
    register("world", "line", LineConfig)


def config(run, **changes):
    settings = {"save_every": 2, "log_every": 1, "preview_every": 0, "ema": 0.5} | changes
    return Config(model=LineConfig(), train=ThreeStages(run=str(run), **settings))


def train(config, **options):
    said = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop.LiveView, "log", lambda _view, text: said.append(text))
        loop.train(config, log=said.append, **options)
    return said


def losses(run):
    entries = map(json.loads, (run / "metrics.jsonl").read_text().splitlines())
    return [(e["stage"], e["step"], e["loss"]) for e in entries]


def test_all_its_stages_are_trained_called_by_their_names_and_loaded(line, tmp_path):
    run = tmp_path / "run"
    said = train(config(run))
    for name, title in zip(NAMES, ("warm up", "fit", "fit 2"), strict=True):
        assert f"{title}: compiling the training step …" in said
        assert (run / "checkpoints" / name / "4").is_dir()
        assert any((run / "tensorboard" / name).iterdir())
    assert [entry[:2] for entry in losses(run)] == [(s, k) for s in (1, 2, 3) for k in range(1, 5)]
    found, params = pewm_jax.load(run)
    assert found == config(run)
    _, first = pewm_jax.load(run / "checkpoints" / "warm_up" / "4")
    _, second = pewm_jax.load(run / "checkpoints" / "fit" / "4")
    assert first["offset"] == 0
    assert first["slope"].tobytes() == second["slope"].tobytes()
    assert params["slope"].tobytes() != second["slope"].tobytes()
    assert losses(run)[-1][2] < losses(run)[0][2]


def test_it_goes_on_from_the_middle_of_any_stage(line, tmp_path):
    whole = tmp_path / "whole"
    train(config(whole))
    for number, name in enumerate(NAMES):
        run = shutil.copytree(whole, tmp_path / name)
        for later in NAMES[number + 1 :]:
            shutil.rmtree(run / "checkpoints" / later)
        shutil.rmtree(run / "checkpoints" / name / "4")
        (run / "weights.safetensors").unlink()
        train(config(run))
        assert losses(run) == losses(whole)
        one, two = (tree.flatten(pewm_jax.load(folder)[1]) for folder in (run, whole))
        assert all(one[path].tobytes() == two[path].tobytes() for path in two)


def test_samples_are_made_of_the_stage_that_is_trained(line, tmp_path):
    seen = []

    def preview(_params, stage, number):
        seen.append((stage.name, number))
        return samples.Previewed((tmp_path / f"{stage.name}.png",), {"model": 1.0})

    said = train(config(tmp_path / "run", preview_every=3), preview=preview)
    assert seen == [(name, number) for name in NAMES for number in (3, 4)]
    assert f"warm up: model 1.0 dB; sample pictures {tmp_path}/warm_up.png" in said


def test_its_settings_come_back_from_json_and_stages_of_no_steps_are_refused(line, tmp_path):
    configuration.save(config(tmp_path), tmp_path / "config.json")
    values = json.loads((tmp_path / "config.json").read_text())
    assert values["model"]["kind"] == "line"
    assert values["train"].keys() >= set(NAMES)
    assert configuration.load(tmp_path / "config.json") == config(tmp_path)
    nothing = StageConfig(steps=0)
    idle = config(tmp_path, warm_up=nothing, fit=nothing, fit2=nothing)
    with pytest.raises(ConfigError, match=r"train\.fit\.steps and train\.fit2\.steps are all 0"):
        runs.planned(idle)
    some = config(tmp_path, warm_up=nothing)
    assert [stage.name for stage in runs.planned(some)] == ["fit", "fit2"]
