"""Killed with −9, again and again: what comes out is what comes out without disturbance."""

import json
import os
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pewm_jax.data.collect import collect
from pewm_jax.data.make_episode import CollectConfig
from tests.train import kills

ROOT = Path(__file__).parents[2]
CPU = {**os.environ, "JAX_PLATFORMS": "cpu"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("kills")
    out = path / "data"
    collect(CollectConfig(out=out, train=2, validation=0, test=0, frames=24, size=16, workers=1))
    return path


def logged(run):
    entries = map(json.loads, (run / "metrics.jsonl").read_text().splitlines())
    return [(e["stage"], e["step"], e["loss"], e["grad_norm"]) for e in entries]


@pytest.mark.slow
def test_kills_at_random_moments_change_no_bit(folder):
    outcome = subprocess.run(
        [sys.executable, kills.__file__, folder, "21", "0"],
        env={**CPU, "PYTHONPATH": f"{ROOT}{os.pathsep}{Path(kills.__file__).parent}"},
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    assert outcome.returncode == 0, outcome.stderr
    found = json.loads(outcome.stdout.splitlines()[-1])
    words = (folder / "killed.txt").read_text()
    assert found["codes"] == [0, 0], (found, words)
    assert [moment["code"] for moment in found["moments"]] == [-9] * 21, (found, words)
    assert sum(moment["saves"] > 0 for moment in found["moments"]) >= 5
    for moment in found["moments"]:
        (stage, step), (stage_saved, saved) = moment["told"], moment["newest"]
        lost = step - saved if stage == stage_saved else step
        assert lost <= kills.EVERY, (moment, found)
    assert "damaged" not in words
    assert "Traceback" not in words, words
    killed, undisturbed = folder / "killed", folder / "undisturbed"
    assert logged(killed) == logged(undisturbed), found
    assert len(logged(killed)) == 2 * kills.STEPS
    whole = [(run / "weights.safetensors").read_bytes() for run in (killed, undisturbed)]
    assert whole[0] == whole[1], found
    assert not list(killed.rglob("*.writing*"))


def start(folder, run):
    argv = ["tiny", "--data.path", folder / "data", "--train.run", folder / "runs" / run]
    argv += ["--train.stage1.steps", "30", "--train.stage2.steps", "0", "--train.save_every", "5"]
    return subprocess.Popen(
        [sys.executable, "-W", "error", "train.py", *map(str, argv)],
        cwd=ROOT,
        env=CPU,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process):
    out, err = process.communicate(timeout=300)
    assert (process.returncode, err) == (0, "")
    return out


@pytest.mark.slow
def test_the_real_program_killed_as_it_saves_goes_on_and_ends_the_same(folder):
    finish(start(folder, "undisturbed"))
    run, dice = folder / "runs" / "killed", random.Random()
    process = start(folder, "killed")
    while process.poll() is None and not list(run.glob("checkpoints/stage1/1[05]*")):
        time.sleep(0.001)
    time.sleep(dice.uniform(0, 0.1))
    process.kill()
    process.communicate()
    assert process.returncode == -9
    (_, step), (_, saved) = kills.told(run), kills.newest(run)
    assert 5 <= saved <= step <= saved + 10  # 5 where the disk is not slow
    out = finish(start(folder, "killed"))
    assert f"stage 1: resuming after step {saved}" in out
    assert logged(run) == logged(folder / "runs" / "undisturbed")
    whole = [folder / "runs" / name / "weights.safetensors" for name in ("killed", "undisturbed")]
    assert whole[0].read_bytes() == whole[1].read_bytes()
