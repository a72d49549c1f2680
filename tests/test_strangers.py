"""Five parts that the library has never heard of, each in a file of its own, make a world model.

Nothing of the package names them: they are registered where they are defined (tests/strangers/).
"""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import pewm_jax
from pewm_jax import config as configuration
from pewm_jax import worlds
from pewm_jax.config import Config, UserError, flags
from pewm_jax.data import loader
from pewm_jax.io import tree
from pewm_jax.train import loop
from pewm_jax.types import Control
from tests.helpers import random_camera, random_frames
from tests.strangers import run as strangers

HERE = Path(__file__).parent
PARTS = ("backbone", "codec", "control", "memory", "noise")
init = jax.jit(worlds.init, static_argnums=0)


@pytest.fixture(scope="module")
def measured():
    done = subprocess.run(
        [sys.executable, "-m", "tests.strangers.run"],
        cwd=HERE.parent,
        env={**os.environ, "PYTHONPATH": str(HERE.parent)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("part", PARTS)
def test_each_is_a_file_of_at_most_60_lines_and_the_package_does_not_name_it(part):
    text = (HERE / "strangers" / f"{part}.py").read_text()
    assert len(text.splitlines()) <= 60
    settings = next(line for line in text.splitlines() if line.startswith("class ")).split("(")[0]
    names = settings.removeprefix("class ")
    for path in (HERE.parent / "pewm_jax").rglob("*.py"):
        assert names not in path.read_text()


def test_they_train_save_load_and_imagine(tmp_path, monkeypatch):
    config = strangers.experiment(run=str(tmp_path / "run"))

    def clips(config, split, *, seed, start_step=0, rows=None, **_):
        step = start_step
        while True:
            batch = strangers.clip(config, 100 * seed + step)
            yield jax.tree.map(lambda x: x[rows or slice(None)], batch)
            step += 1

    monkeypatch.setattr(loader, "clips", clips)
    run = loop.train(config, say=lambda _line: None)
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


def test_a_control_that_needs_actions_says_so():
    config = strangers.experiment()
    params = init(config, jax.random.key(0))
    rng = np.random.default_rng(0)
    state = pewm_jax.start(config, params, random_frames(rng, 3, 16, 16))
    camera = random_camera(rng, 3, 16, 16)
    with pytest.raises(UserError, match=r"control \(push\) is steered by actions of 3 numbers"):
        pewm_jax.imagine(config, params, state, camera, jax.random.key(0))
    control = Control(camera, np.zeros((3, 7), np.float32))
    with pytest.raises(UserError, match="got actions of 7 numbers"):
        pewm_jax.imagine(config, params, state, control, jax.random.key(0))
    clip = dataclasses.replace(strangers.clip(config), actions_TA=None)
    stage = worlds.stages(config)[0]
    with pytest.raises(UserError, match="the loss got cameras without actions"):
        stage.loss(config.model, config.train, params, clip, jax.random.key(0))


def test_many_candidates_share_one_memory():
    config = strangers.experiment()
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


def test_eight_devices_by_their_own_rules_give_the_losses_of_one(measured):
    np.testing.assert_allclose(measured["eight"], measured["one"], rtol=1e-5)
    assert measured["split"] == {"spec": "P(None, 'fsdp', 'tensor')", "part": 1 / 8}


@pytest.mark.parametrize("stage", [0, 1])
def test_a_plan_counts_their_flops(measured, stage):
    compiled, expected = measured["flops"][stage]
    assert expected == pytest.approx(compiled, rel=0.02)


def test_their_settings_travel_through_json_and_flags():
    config = strangers.experiment()
    values = json.loads(json.dumps(configuration.to_dict(config)))
    assert values["model"]["backbone"] == {"kind": "perceptron", "depth": 2, "width": 32}
    assert configuration.from_dict(Config, values) == config
    chosen, rest = flags.take_kinds(["--model.noise.kind", "cosine", "--x"], Config())
    assert (type(chosen.model.noise), rest) == (type(config.model.noise), ["--x"])


def test_a_parameter_that_no_rule_places_is_named():
    rules = worlds.sharding(strangers.experiment().model)
    with pytest.raises(tree.TreeError, match="backbone/extra"):
        tree.assign(rules, {"backbone": {"extra": np.zeros(1)}}, "sharding rules")
