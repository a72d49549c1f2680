"""Five parts outside the package, each in a file of its own, make a world model (``examples/``)."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import pewm_jax
from pewm_jax import config as configuration
from pewm_jax import worlds
from pewm_jax.cli import parser
from pewm_jax.config import Config, UserError
from pewm_jax.data import loader
from pewm_jax.io import tree
from pewm_jax.train import loop
from pewm_jax.types import Control
from tests.examples import parts
from tests.helpers import random_camera, random_frames

ROOT = Path(__file__).parents[2]
PARTS = {
    name: ROOT / "examples" / f"{name}.py"
    for name in ("backbone", "codec", "control", "memory", "noise")
}
CHOICES = {
    "backbone": ["--backbone.kind", "perceptron"],
    "codec": ["--codec.kind", "turn", "--clip.frames", "5"],
    "control": ["--control.kind", "push"],
    "memory": ["--memory.kind", "newest"],
    "noise": ["--noise.kind", "cosine"],
}
"""The flags that choose each example; the codec folds no frames."""
init = jax.jit(worlds.init, static_argnums=0)


@pytest.fixture(scope="module")
def measured():
    done = subprocess.run(
        [sys.executable, "-m", "tests.examples.parts"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("part", PARTS)
def test_each_is_a_file_of_at_most_60_lines_and_the_package_does_not_name_it(part):
    text = PARTS[part].read_text()
    assert len(text.splitlines()) <= 60
    settings = next(line for line in text.splitlines() if line.startswith("class ")).split("(")[0]
    names = settings.removeprefix("class ")
    for path in (ROOT / "pewm_jax").rglob("*.py"):
        assert names not in path.read_text()


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    walks = ["--train", "1", "--validation", "1", "--test", "1", "--frames", "28", "--size", "16"]
    run_command(folder, "data", "collect", "walks", *walks)
    return folder / "walks"


def run_command(folder, *words):
    """Run a command of the package in a folder, as a user does; return what it prints."""
    done = subprocess.run(
        [sys.executable, "-m", "pewm_jax", *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.environ.get("PYTHONPATH", str(ROOT))},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr + done.stdout
    return done.stdout


@pytest.mark.slow
def test_a_user_trains_with_all_four_in_an_empty_folder(data, tmp_path):
    words = ["train", "tiny", "--data.path", str(data), "--data.context", "3", "--train.run", "run"]
    words += ["--clip.height", "16", "--clip.width", "16", "--train.preview_every", "0"]
    for stage in ("stage1", "stage2"):
        words += [f"--train.{stage}.steps", "1", f"--train.{stage}.batch", "2"]
    for part, flags_ in CHOICES.items():
        shutil.copy(PARTS[part], tmp_path)
        words += ["--plugin", f"{part}.py", *flags_]
    run_command(tmp_path, *words)
    stored = json.loads((tmp_path / "run" / "config.json").read_text())["model"]
    kinds = {part: stored[part]["kind"] for part in CHOICES}
    assert kinds == {
        "backbone": "perceptron",
        "codec": "turn",
        "control": "push",
        "noise": "cosine",
    }


@pytest.mark.slow
def test_they_train_save_load_and_imagine(tmp_path, monkeypatch):
    config = parts.experiment(run=str(tmp_path / "run"))

    def clips(config, split, *, seed, start_step=0, rows=None, **_):
        step = start_step
        while True:
            batch = parts.clip(config, 100 * seed + step)
            yield jax.tree.map(lambda x: x[rows or slice(None)], batch)
            step += 1

    monkeypatch.setattr(loader, "clips", clips)
    run = loop.train(config, log=lambda _line: None)
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [(line["stage"], line["step"]) for line in lines][-1] == (2, 2)

    loaded, params = pewm_jax.load(run)
    assert loaded == config
    assert {"backbone", "codec", "control", "memory"} <= set(params)
    rng = np.random.default_rng(0)
    state = pewm_jax.start(loaded, params, random_frames(rng, 3, 16, 16))
    actions = rng.normal(0, 0.3, (5, 3)).astype(np.float32)
    control = Control(random_camera(rng, 5, 16, 16), actions)
    after, frames = pewm_jax.imagine(loaded, params, state, control, jax.random.key(0))
    assert frames.rgb_THWC.shape == (5, 16, 16, 3)
    assert np.isfinite(frames.depth_THW).all()
    assert not np.array_equal(after.map[1], state.map[1])

    other = Control(control.camera, -actions)  # only the actions steer, and they do
    _, turned = pewm_jax.imagine(loaded, params, state, other, jax.random.key(0))
    assert not np.array_equal(turned.rgb_THWC, frames.rgb_THWC)


@pytest.mark.slow
def test_a_control_that_needs_actions_says_so():
    config = parts.experiment()
    params = init(config, jax.random.key(0))
    rng = np.random.default_rng(0)
    state = pewm_jax.start(config, params, random_frames(rng, 3, 16, 16))
    camera = random_camera(rng, 3, 16, 16)
    with pytest.raises(UserError, match=r"control \(push\) is steered by actions of 3 numbers"):
        pewm_jax.imagine(config, params, state, camera, jax.random.key(0))
    control = Control(camera, np.zeros((3, 7), np.float32))
    with pytest.raises(UserError, match="got actions of 7 numbers"):
        pewm_jax.imagine(config, params, state, control, jax.random.key(0))
    clip = dataclasses.replace(parts.clip(config), actions_TA=None)
    stage = worlds.stages(config)[0]
    with pytest.raises(UserError, match="the loss got cameras without actions"):
        stage.loss(config.model, config.train, params, clip, jax.random.key(0))


@pytest.mark.slow
def test_many_candidates_share_one_memory():
    config = parts.experiment()
    params = init(config, jax.random.key(0))
    rng = np.random.default_rng(0)
    state = pewm_jax.start(config, params, random_frames(rng, 3, 16, 16))
    keys = jax.random.split(jax.random.key(1), 4)
    actions = rng.normal(0, 0.3, (4, 3, 3)).astype(np.float32)
    after, frames = pewm_jax.imagine_many(config, params, state, actions, keys)
    assert frames.depth_THW.shape == (4, 3, 16, 16)
    assert after.frame.depth_THW.shape == (4, 1, 16, 16)
    jax.tree.map(np.testing.assert_array_equal, after.map, state.map)
    _, alone = pewm_jax.imagine(config, params, state, actions[2], keys[2])
    np.testing.assert_allclose(frames.rgb_THWC[2], alone.rgb_THWC, atol=1e-5)


@pytest.mark.slow
def test_eight_devices_by_their_own_rules_give_the_losses_of_one(measured):
    np.testing.assert_allclose(measured["eight"], measured["one"], rtol=1e-5)
    assert measured["split"] == {"spec": "P(None, 'fsdp', 'tensor')", "part": 1 / 8}


@pytest.mark.slow
@pytest.mark.parametrize("stage", [0, 1])
def test_a_plan_counts_their_flops(measured, stage):
    compiled, expected = measured["flops"][stage]
    assert expected == pytest.approx(compiled, rel=0.02)


def test_their_settings_travel_through_json_and_flags():
    config = parts.experiment()
    values = json.loads(json.dumps(configuration.to_dict(config)))
    assert values["model"]["backbone"] == {"kind": "perceptron", "depth": 2, "width": 32}
    assert configuration.from_dict(Config, values) == config
    chosen, rest = parser.take_kinds(["--model.noise.kind", "cosine", "--x"], Config())
    assert (type(chosen.model.noise), rest) == (type(config.model.noise), ["--x"])


def test_a_parameter_that_no_rule_places_is_named():
    rules = worlds.sharding(parts.experiment().model)
    with pytest.raises(tree.TreeError, match="backbone/extra"):
        tree.assign(rules, {"backbone": {"extra": np.zeros(1)}}, "sharding rules")
