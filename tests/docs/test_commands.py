"""Run the commands of the README and of the how-to pages, and the README's example, as written.

They run in a small copy of a user's folder, with flags that make them small.
"""

import importlib.util
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from pewm_jax import config as configuration
from pewm_jax import presets
from pewm_jax.data.scenes import load_scene
from pewm_jax.houses.generate import generate_house

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
PAGES = ("tutorial", "data", "export", "conversion", "training")
"""Pages of docs/ whose commands are run, in this order, after those of the README."""
ICL = ROOT.parent / "shared" / "data" / "icl_livingroom"
COLLECT = ["--train", "2", "--validation", "1", "--test", "1", "--frames", "40"]
EVALUATE = shlex.split("--clips 2 --seeds 0 1 --videos 1 --video_clips 1 --batch 2")
STEPS = 3
"""Steps of a stage if a command names their number."""
SMALLER = {
    "python -m pewm_jax data collect ": COLLECT,
    "python -m pewm_jax train demo": ["--config", "small.json"],
    "python -m pewm_jax train world": shlex.split(
        "--train.stage1.steps 1 --train.stage1.batch 2 --train.stage2.steps 0 "
        "--train.preview_every 0 --train.mesh.fsdp 1"
    ),
    "python -m pewm_jax convert import cogvideox CogVideoX-2b world": shlex.split(
        "--height 64 --width 64 --config small_memory.json"
    ),
    "python -m pewm_jax memory cache": ["--size", "28"],
    "python -m pewm_jax convert export stablehlo": ["--what", "denoise", "--no_check"],
    "python -m pewm_jax evaluate ": EVALUATE,
    "python -m pewm_jax show ": ["--frames", "8"],
}
"""Beginnings of commands, and flags that make them small enough for a test."""
NOT_RUN = re.compile(
    r"make |pip |python3 -m venv|\.venv/bin/pip|WANDB_|wandb |.*--log |.*[ =](zai-org|myself)/"
)
"""Installation, programs of others, and the targets of make, which have tests of their own."""


def blocks(text, language):
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def commands(text):
    """Return the commands of the bash blocks of a page as ``python -m pewm_jax …``."""
    lines = [line for block in blocks(text, "bash") for line in block.splitlines()]
    found = []
    for line in re.sub(r"\\\n\s*", "", "\n".join(lines)).splitlines():
        command = line.split("  #")[0].strip()
        if not command or NOT_RUN.match(command):
            continue
        for script in ("train", "evaluate"):
            command = re.sub(rf"^python {script}\.py", f"python -m pewm_jax {script}", command)
        found.append(re.sub(r"^pewm-jax ", "python -m pewm_jax ", command))
    return list(dict.fromkeys(found))


def smaller(command):
    """Return a command's arguments without ``python``, made small enough for a test."""
    command = re.sub(r"(--train\.stage\d\.steps)[ =]\S+", rf"\1 {STEPS}", command)
    arguments = shlex.split(command)[1:]
    if "--help" in arguments:
        return arguments
    start = max((start for start in SMALLER if command.startswith(start)), key=len, default=None)
    return arguments + SMALLER.get(start, [])


def run(arguments, cwd):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "100"}
    for name in (
        "MAKEFLAGS",
        "MAKELEVEL",
        "MFLAGS",
    ):  # as a person calls it, also under `make test`
        environment.pop(name, None)
    done = subprocess.run(
        arguments,
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, f"{arguments}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    return done.stdout


def small_settings():
    demo = presets.load("demo")
    tiny = presets.load("tiny")
    stage = {"steps": 2, "batch": 2, "warmup": 1}
    return {
        "model": {
            "backbone": configuration.to_dict(tiny.model.backbone),
            "memory": {"capacity": 8192, "tokens": 64, "reader": {"picture_width": 16}},
            "noise": {"snr_shift": demo.model.noise.snr_shift, "sample_steps": 2},
        },
        "data": {"context": 4, "prepared": 4},
        "train": {"stage1": stage, "stage2": stage, "preview_every": 2},
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder that looks like a clone, with a mesh and a recording of the user's in it."""
    path = tmp_path_factory.mktemp("clone with spaces")
    for name in ("train.py", "evaluate.py", "configs", "pewm_jax"):
        (path / name).symlink_to(ROOT / name)
    house = generate_house(4)  # z up, and a GLB is y up
    house.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    house.export(path / "path.glb")
    (path / "recordings").mkdir()
    if ICL.is_dir():
        (path / "recordings" / "livingroom").symlink_to(ICL)
    (path / "small.json").write_text(json.dumps(small_settings()))
    save_checkpoints(path)
    return path


def save_checkpoints(path):
    """Write a tiny CogVideoX and a tiny DINOv2, as diffusers and transformers do."""
    from transformers import Dinov2Config, Dinov2Model

    from tests.convert import pipelines as convert_pipelines

    convert_pipelines.save(path / "CogVideoX-2b", "2b", shard="60KB")
    network = Dinov2Config(
        hidden_size=16, num_hidden_layers=1, num_attention_heads=2, image_size=28
    )
    Dinov2Model(network).save_pretrained(path / "dinov2-small")
    memory = {"tokens": 32, "capacity": 256, "cells": [16, 16, 4], "encoder": {"size": 28}}
    (path / "small_memory.json").write_text(json.dumps({"model": {"memory": memory}}))


def runnable(command):
    """Tell whether a command's inputs and packages are there."""
    if "recordings/livingroom" in command or "data/living" in command:
        return ICL.is_dir()
    return "stablehlo" not in command or importlib.util.find_spec("flatbuffers") is not None


@pytest.mark.slow
def test_the_commands_of_the_readme_and_its_example_work_as_written(folder):
    found = commands(README)
    assert len(found) >= 2
    for command in found:
        run([sys.executable, *smaller(command)], folder)
    (example,) = blocks(README, "python")
    assert len([line for line in example.splitlines() if line.strip()]) <= 15
    out = run([sys.executable, "-c", example], folder)
    assert out.startswith("(8, 64, 64, 3) (8, 64, 64)\n")
    assert "occupied cells" in out


@pytest.mark.slow
def test_the_commands_of_the_pages_work_as_written(folder):
    found = [c for page in PAGES for c in commands((ROOT / "docs" / f"{page}.md").read_text())]
    found = list(dict.fromkeys(found))
    assert len(found) >= 20
    for start in SMALLER:
        known = [*found, *commands(README)]
        assert any(command.startswith(start) for command in known), f"no page says {start}"
    for command in found:
        if runnable(command):
            run([sys.executable, *smaller(command)], folder)
    assert (folder / "runs/demo/report/index.html").stat().st_size > 10_000
    assert (folder / "episode.png").is_file()
    assert (folder / "CogVideoX-mine/transformer/config.json").is_file()


REWRITTEN = {".lock", "config.json"}
"""Files of a run that every start writes: the lock, and the settings it has checked."""


@pytest.mark.slow
def test_make_demo_runs_all_of_it_and_does_nothing_twice(tmp_path):
    settings = {
        "PY": sys.executable,
        "PRESET": "tiny",
        "DATA": str(tmp_path / "data"),
        "RUN": str(tmp_path / "run"),
        "COLLECT": "--size 16 " + " ".join(COLLECT),
    }
    make = ["make", "-o", ".venv/installed", "demo", *(f"{k}={v}" for k, v in settings.items())]
    out = run(make, ROOT)
    page = tmp_path / "run" / "report" / "index.html"
    assert out.strip().splitlines()[-1] == f"report: {page}"
    before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.is_file()}
    run(make, ROOT)
    changed = [p for p, at in before.items() if p.exists() and p.stat().st_mtime_ns != at]
    again = [p for p in changed if ".cache" not in p.parts and p.name not in REWRITTEN]
    assert not again, "everything was done already"


def test_make_test_runs_the_suite():
    out = run(
        [
            "make",
            "-o",
            ".venv/installed-dev",
            "test",
            f"PY={sys.executable}",
            "ARGS=tests/io/test_tree.py",
        ],
        ROOT,
    )
    assert re.search(r"\d+ passed", out)


def test_every_file_the_readme_names_exists():
    for name in re.findall(r"\]\((?!http)([^)#]+)[^)]*\)", README):
        assert (ROOT / name).exists(), name


def test_the_readme_is_short_and_names_two_commands_for_all_setup():
    assert len(README.splitlines()) <= 150
    assert "make demo\nmake test\n" in blocks(README, "bash")[0]


def test_the_mesh_of_the_test_stands_upright(folder):
    extent = np.ptp(load_scene(folder / "path.glb").vertices_V3, axis=0)
    np.testing.assert_allclose(extent, generate_house(4).extents, atol=1e-3)


def test_commands_become_small():
    longer = smaller("python -m pewm_jax train demo --train.stage2.steps 2000 --train.run runs/x")
    assert longer[:4] == ["-m", "pewm_jax", "train", "demo"]
    assert longer[4:] == [
        *["--train.stage2.steps", str(STEPS), "--train.run", "runs/x", "--config", "small.json"]
    ]
    world = smaller("python -m pewm_jax train world --data.path data/mine")
    assert "small.json" not in world
    assert "--train.mesh.fsdp" in world
    assert smaller("python -m pewm_jax train demo --help")[-1] == "--help"
    page = "```bash\npip install x\npewm-jax train demo  # all\npython evaluate.py small\n```"
    assert commands(page) == ["python -m pewm_jax train demo", "python -m pewm_jax evaluate small"]


def test_every_target_of_make_in_the_readme_exists():
    targets = re.findall(r"^make \S+", "\n".join(blocks(README, "bash")), re.MULTILINE)
    assert {"make demo", "make test"} <= set(targets)
    for command in targets:
        run(["make", "-n", *shlex.split(command)[1:]], ROOT)
