"""EgoWM's ablation: its rows, equal time, what it writes, and what it refuses."""

import dataclasses
import functools
import json
from pathlib import Path

import numpy as np
import pytest

from pewm_jax import presets
from pewm_jax.config import ConfigError, UserError
from pewm_jax.data.collect import collect
from pewm_jax.data.make_episode import CollectConfig
from pewm_jax.studies import conditioning, step_times
from pewm_jax.studies.conditioning import ROWS, Study
from tests.helpers import shrink

SIZE = 16


@functools.cache
def base(data="data/none", preset="egowm"):
    """The preset, absurdly small."""
    loaded = presets.load(preset)
    stage = dataclasses.replace(loaded.train.adapt, batch=2, warmup=1)
    return dataclasses.replace(
        loaded,
        model=shrink(loaded.model, side=SIZE),
        data=dataclasses.replace(
            loaded.data, path=data, prepared=4, prepared_path="", refresh=0, context=2
        ),
        train=dataclasses.replace(loaded.train, adapt=stage, log_every=100),
        evaluate=dataclasses.replace(loaded.evaluate, batch=2, lpips="off"),
    )


def test_every_row_gives_its_actions_in_its_way_and_trains_one_stage():
    study = Study(base(preset="egowm_humanoid"), Path("out"))
    assert study.base.train.start == "egowm"
    for name in ROWS:
        config = study.config(name, 1, 70)
        assert (config.train.seed, config.train.start) == (1, "")
        assert config.train.run == str(Path("out/seed1") / name)
        steps = (config.train.video.steps, config.train.adapt.steps)
        assert steps == ((70, 0) if name == "none" else (0, 70))
        assert study.stage(name).settings(config).steps == 70
        assert config.model.control.inject == ("timestep" if name == "none" else name)
        assert config.model.backbone == study.base.model.backbone
        assert (config.model.observed, config.train.denoised_lpips) == ("every", 0)
        assert (getattr(config.model.codec, "gate", 0), config.train.gate.steps) == (0, 0)
    assert study.base.model.observed == "warped"


def test_absent_data_are_refused_with_the_command_that_makes_them(tmp_path):
    study = Study(base(data=str(tmp_path / "none")), tmp_path / "out")
    with pytest.raises(UserError, match=r"none/train does not exist; make it with"):
        conditioning.run(study)


def test_rows_keep_the_weights_of_a_learned_codec():
    tiny = presets.load("egowm_tiny")
    config = Study(tiny, Path("out")).config("channels", 0, 70)
    assert config.model.codec == tiny.model.codec
    assert (config.train.start, config.train.fresh) == ("codec", ("(backbone|control)/.*",))


def test_rows_get_as_many_steps_as_their_time_allows_and_it_is_measured_once(tmp_path, monkeypatch):
    asked = []

    def measure(trainings, log):
        asked.append(list(trainings))
        return dict(zip(trainings, (0.5, 1.0, 2.0, 0.25), strict=True))

    monkeypatch.setattr(step_times, "measure", measure)
    study = Study(base(), tmp_path, minutes=1.0, rows=("timestep", "channels"))
    found = {name: one["steps"] for name, one in conditioning._planned(study, print).items()}
    assert found == {"timestep": 120, "channels": 30}
    longer = dataclasses.replace(study, minutes=2.0, rows=ROWS)
    found = {name: one["steps"] for name, one in conditioning._planned(longer, print).items()}
    assert found == {"timestep": 240, "attention": 120, "channels": 60, "none": 480}
    assert len(asked) == 1
    (tmp_path / "plan.json").write_text("{")
    with pytest.raises(UserError, match="is damaged"):
        conditioning._planned(study, print)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"rows": ("text",)}, "--rows are text: choose from timestep"),
        ({"minutes": 0.0}, "--minutes is 0.0"),
        ({"seeds": (1, 1)}, "distinct seeds"),
        ({"clips": 0}, "--clips is 0"),
        ({"base": presets.load("tiny")}, "use a preset of that with the control actions"),
    ],
)
def test_settings_that_cannot_work_are_refused(changes, says):
    with pytest.raises(ConfigError, match=says):
        Study(**{"base": base(), "out": Path("x"), **changes})


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["egowm", "egowm_humanoid"])
def test_the_whole_of_it(tmp_path, preset):
    body = "humanoid" if preset == "egowm_humanoid" else ""
    collect(
        CollectConfig(
            tmp_path / "data",
            train=2,
            validation=0,
            test=3,
            frames=16,
            size=SIZE,
            step_m=0.12,
            turn_deg=10.0,
            turn_around=0.0,
            test_policy="follow",
            ids=True,
            body=body,
            workers=1,
        ),
        log=lambda _: None,
    )
    study = Study(base(str(tmp_path / "data"), preset), tmp_path / "out", steps=2, clips=2)
    page = conditioning.run(study, lambda _: None)
    text, results = page.read_text(), json.loads((page.parent / "results.json").read_text())
    assert "the observed frame, repeated" in text
    assert text.count("\n| ") == 2 + len(ROWS) + 1
    assert ("IoU of the arms" in text) == bool(body)
    for name in ROWS:
        found = results["results"][name]["0"]
        assert np.isfinite(found["all"]["true"]["mean"])
    none = results["results"]["none"]["0"]["all"]
    assert none["true"]["mean"] == pytest.approx(none["shuffled"]["mean"], abs=1e-4)
    said = []
    again = conditioning.run(study, said.append)
    assert again == page
    assert not any("scoring" in line for line in said)
    with pytest.raises(UserError, match="clips"):
        conditioning.run(dataclasses.replace(study, clips=1), print)
