"""Worlds of a user's own go through every command, in a folder that holds nothing but their file.

``examples/world.py`` has depth and a memory of its own kind. ``odd_world.py`` has neither, keeps
its parameters in a list, trains in two stages and is steered by actions alone.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

import pewm_jax
from pewm_jax import registry, worlds
from pewm_jax.cli import plugins
from pewm_jax.config import ConfigError
from pewm_jax.planning import costs
from pewm_jax.planning.candidates import CandidateCost, ImaginedRollout
from pewm_jax.planning.imagined_env import WorldModelEnv
from pewm_jax.planning.plan import plan
from pewm_jax.planning.settings import CEM, PlanConfig
from pewm_jax.play import engine, places, session
from pewm_jax.play.settings import Start

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
FILES = {"keyframes": ROOT / "examples" / "world.py", "odd-1": HERE / "odd_world.py"}
SIZE = ["--clip.height", "16", "--clip.width", "16"]
SHORT = {
    "keyframes": ["--data.context", "6", "--train.fit.steps", "400", "--train.fit.batch", "4"],
    "odd-1": ["--Lambda", "0.25", "--no_bias", "--steps", "4", "--train.then_2.steps", "400"],
}
LAST = {"keyframes": "fit", "odd-1": "then_2"}
"""The last stage of each, in which it is killed."""
REPORT = ["--evaluate.clips", "2", "--evaluate.videos", "1", "--evaluate.video_clips", "2"]
QUICK = ["--lpips", "off", "--fvd", "off", "--scs", "off", "--mirror", "0", "--batch", "2"]


def command(folder, *words):
    return subprocess.Popen(
        [sys.executable, "-m", "pewm_jax", *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.environ.get("PYTHONPATH", str(ROOT))},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def run(folder, *words):
    """Run a command of the package as a user does; returns what it prints."""
    process = command(folder, *words)
    said, _ = process.communicate(timeout=600)
    assert process.returncode == 0, said
    return said


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    walks = ["--train", "2", "--validation", "1", "--test", "2", "--frames", "30"]
    run(folder, "data", "collect", "walks", *walks, "--size", "16")
    return folder / "walks"


@pytest.fixture(scope="module", params=sorted(FILES))
def trained(request, data, tmp_path_factory):
    """A folder with a world's file and its run, which was killed once and resumed."""
    kind = request.param
    folder = tmp_path_factory.mktemp("world")
    shutil.copy(FILES[kind], folder / "mine.py")
    words = ["train", kind, "--plugin", "mine.py", "--data.path", str(data), *SIZE, *SHORT[kind]]
    words += [
        *REPORT,
        "--train.run",
        "run",
        "--train.preview_every",
        "0",
        "--train.save_every",
        "20",
    ]
    killed = command(folder, *words)
    until = time.monotonic() + 300
    while not any(path.name.isdigit() for path in folder.glob(f"run/checkpoints/{LAST[kind]}/*")):
        assert time.monotonic() < until
        assert killed.poll() is None
        time.sleep(0.02)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    said = run(folder, *words)
    assert "after step" in said
    return kind, folder, words


def load(trained, run_folder="run"):
    kind, folder, _ = trained
    if kind not in registry.names("world"):
        plugins.run(["--plugin", str(folder / "mine.py")])
    return pewm_jax.load(folder / run_folder)


@pytest.mark.slow
def test_it_is_evaluated_and_compared(trained):
    kind, folder, _ = trained
    said = run(folder, "evaluate", "run", "--plugin", "mine.py", *QUICK)
    metrics = json.loads((folder / "run" / "report" / "metrics.json").read_text())
    own = {"keyframes": {"memory", "empty"}, "odd-1": {"model"}}[kind]
    assert metrics["results"].keys() == own | {"reproject", "copy"}
    assert "seen before" in said
    assert "never seen" in said
    assert "sampling steps" not in said
    said = run(folder, "compare", "run", "run", "--plugin", "mine.py")
    assert "a and b are the same weights" in said


@pytest.mark.slow
def test_it_is_planned_for_absent_hardware(trained):
    _, folder, words = trained
    said = run(folder, *words, "--plan", "--devices", "2", "--chip", "h100")
    assert "2 × h100" in said


@pytest.mark.slow
def test_it_is_exported(trained):
    _, folder, _ = trained
    run(folder, "convert", "export", "inference", "run", "small", "--plugin", "mine.py")
    flags = ["--plugin", "mine.py", "--platforms", "cpu"]
    said = run(folder, "convert", "export", "stablehlo", "run", "programs", *flags)
    assert "largest difference from the library" in said
    one, two = (load(trained, name)[1] for name in ("run", "small"))
    assert jax.tree.structure(one) == jax.tree.structure(two)
    assert "imagines what the agent will see" in (folder / "small" / "README.md").read_text()


@pytest.mark.slow
def test_it_is_driven_searched_and_walked_in(trained):
    config, params = load(trained)
    place = places.open_place(Start(house=2), 16, 16)
    driven = engine.open_engine("mine", config, params)
    now = session.begin(driven, place)
    for event in (session.Drive((0.25, 0.0, 0.0)), session.Drive((0.0, 0.0, 0.5))):
        now = session.catch_up(driven, session.apply(driven, now, event))
    assert now.steps == 2
    assert not driven.editable
    assert len(driven.points(now.world)[0]) == 0

    state, goal = now.world, jax.tree.map(np.asarray, now.world.frame)
    keys = jax.random.split(jax.random.key(0), 3)
    actions = np.random.default_rng(0).normal(0, 0.3, (3, 2, 3)).astype(np.float32)
    after, frames = worlds.imagine_many(config, params, state, actions, keys)
    assert frames.rgb_THWC.shape == (3, 2, 16, 16, 3)
    jax.tree.map(np.testing.assert_array_equal, after.map, state.map)
    _, alone = worlds.imagine(config, params, state, actions[1], keys[1])
    np.testing.assert_allclose(frames.rgb_THWC[1], alone.rgb_THWC, atol=1e-5)
    cost = CandidateCost(
        ImaginedRollout(config, params, state, jax.random.key(0)), costs.Pixels(), goal
    )
    settings = PlanConfig(horizon=2, candidates=4, elites=2, rounds=2)
    assert np.isfinite(plan(CEM(), settings, cost, jax.random.key(1)).cost)

    env = WorldModelEnv(config, params)
    env.reset(seed=0)
    seen = env.step(0)[0]
    assert seen["rgb"].shape == (16, 16, 3)


@pytest.mark.slow
def test_the_memory_of_the_example_matters(trained):
    kind, _, _ = trained
    config, params = load(trained)
    if kind != "keyframes":
        assert not config.model.capabilities.memory
        return
    from tests.helpers import random_frames

    state = pewm_jax.start(config, params, random_frames(np.random.default_rng(0), 3, 16, 16))
    key = jax.random.key(0)
    with_it, without = (
        worlds.imagine(config, params, state, [0, 1], key, memory=memory)[1].rgb_THWC
        for memory in (True, False)
    )
    assert not np.array_equal(with_it, without)


def test_the_example_is_short_and_a_wrong_file_is_refused(tmp_path):
    assert len(FILES["keyframes"].read_text().splitlines()) <= 90
    with pytest.raises(ConfigError, match=r"--plugin needs the path of a Python file .* 'absent"):
        plugins.run(["--plugin", "absent.py"])
    wrong = tmp_path / "mine_wrong_world.py"
    wrong.write_text("raise ValueError('two\\nlines')")
    with pytest.raises(ConfigError, match="ValueError: two lines"):
        plugins.run(["--plugin", str(wrong)])
