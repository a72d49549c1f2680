"""Collecting: the files depend on the settings alone, and nothing half-made counts."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh

from pewm_jax.config import ConfigError, UserError
from pewm_jax.data import collect as engines
from pewm_jax.data.checks import check_episode
from pewm_jax.data.collect import collect
from pewm_jax.data.dataset import EpisodeSource, write_shard
from pewm_jax.data.episodes import read_episode
from pewm_jax.data.make_episode import (
    CollectConfig,
    house_seed,
    make_episode,
    scenes_of,
    settings_of,
)
from pewm_jax.data.validate import ValidateConfig, validate
from pewm_jax.geometry.actions import FORWARD

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def mesh(tmp_path_factory):
    """A room with two boxes in it, as a file; y up inside a GLB."""
    room = trimesh.creation.box([5, 4, 2.5])
    room.invert()
    room.apply_translation([0, 0, 1.25])
    boxes = [trimesh.creation.box([0.6, 0.8, 0.9]) for _ in range(2)]
    boxes[0].apply_translation([1.2, 0.5, 0.45])
    boxes[1].apply_translation([-1.5, -1, 0.45])
    for k, part in enumerate((room, *boxes)):
        part.visual.face_colors = np.random.default_rng(k).integers(0, 255, (len(part.faces), 4))
    turned = trimesh.Scene([room, *boxes])
    turned.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    path = tmp_path_factory.mktemp("mesh") / "room.glb"
    turned.export(path)
    return path


def settings(out, mesh, **options):
    default = {"train": 4, "validation": 1, "test": 1, "frames": 40, "size": 16}
    default |= {"shard_episodes": 1, "workers": 1, "scene": (mesh,)}
    return CollectConfig(out, **{**default, **options})


def fingerprints(folder):
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    digest = {p: hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
    return {str(path.relative_to(folder)): value for path, value in digest.items()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory, mesh):
    """A collection made in one go by one process, and what its files hash to."""
    out = tmp_path_factory.mktemp("collect") / "whole"
    collect(settings(out, mesh))
    return out, fingerprints(out)


def copy(whole, tmp_path):
    return Path(shutil.copytree(whole[0], tmp_path / "copy"))


def test_what_is_collected_is_valid(whole):
    out, files = whole
    assert set(files) == {
        *(f"train/shard-{k:05d}-of-00004.array_record" for k in range(4)),
        *(f"{s}/shard-00000-of-00001.array_record" for s in ("validation", "revisit")),
        *(f"{s}/dataset.json" for s in ("train", "validation", "revisit")),
    }
    verdict = validate(ValidateConfig(out), lambda _: None)
    assert (verdict.episodes, verdict.frames, verdict.problems) == (6, 240, [])
    episodes = list(EpisodeSource(out / "train"))
    assert len({e.record for e in episodes}) == 4
    assert EpisodeSource(out / "revisit")[0].info["return_frame"] > 12
    heights = np.concatenate([e.world_from_camera[:, 2, 3] for e in episodes])
    np.testing.assert_allclose(heights, 1.25, atol=0.01)


@pytest.mark.slow
def test_the_number_of_processes_leaves_no_trace(whole, tmp_path, mesh):
    collect(settings(tmp_path / "two", mesh, workers=2))
    assert fingerprints(tmp_path / "two") == whole[1]


def test_a_complete_collection_is_left_alone(whole, tmp_path, mesh):
    out = copy(whole, tmp_path)
    said = []
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    collect(settings(out, mesh), said.append)
    assert said == [f"{out} is complete with these settings: nothing to do."]
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == before


def test_a_resumed_collection_makes_only_what_is_missing(whole, tmp_path, mesh):
    out = copy(whole, tmp_path)
    train = out / "train"
    (train / "dataset.json").rename(train / "collecting.json")
    config = settings(out, mesh)
    manifest = json.loads((train / "collecting.json").read_text())
    (train / "collecting.json").write_text(json.dumps(manifest["settings"]))
    lost, cut, kept, other = (train / f"shard-{k:05d}-of-00004.array_record" for k in range(4))
    lost.unlink()
    write_shard(other, [make_episode(config, "train", k) for k in (3, 4)])
    cut.write_bytes(cut.read_bytes()[:5000])
    (train / "shard-00003-of-00004.array_record.123.partial").write_bytes(b"half")
    made = kept.stat().st_mtime_ns
    said = []
    collect(config, said.append)
    assert said[1] == "resuming: 1 files exist, 3 are missing."
    assert fingerprints(out) == whole[1]
    assert kept.stat().st_mtime_ns == made


def test_a_shard_cut_short_afterwards_is_made_again(whole, tmp_path, mesh):
    out = copy(whole, tmp_path)
    shard = out / "train" / "shard-00002-of-00004.array_record"
    shard.write_bytes(shard.read_bytes()[:-10])
    collect(settings(out, mesh))
    assert fingerprints(out) == whole[1]


def test_other_settings_are_refused_and_named(whole, tmp_path, mesh):
    out = copy(whole, tmp_path)
    with pytest.raises(ConfigError, match="frames was 40, now 41"):
        collect(settings(out, mesh, frames=41))
    with pytest.raises(ConfigError, match=r"turn-around was 0\.5, now 0\.0"):
        collect(settings(out, mesh, turn_around=0.0))
    with pytest.raises(ConfigError, match="episodes was 4, now 5"):
        collect(settings(out, mesh, train=5))
    assert fingerprints(out) == whole[1]
    collect(settings(out, mesh, frames=41, overwrite=True))
    assert EpisodeSource(out / "train")[0].length == 41
    assert len(EpisodeSource(out / "train")) == 4


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_killed_collection_goes_on(tmp_path, mesh, how):
    """Killed, or interrupted by Ctrl-C, while workers write: the result is that of a calm run."""
    options = {"train": 12, "validation": 0, "test": 0, "frames": 150, "size": 32}
    collect(settings(tmp_path / "calm", mesh, **options))
    out = tmp_path / "killed"
    flags = [f"--{k}={v}" for k, v in {**options, "workers": 2, "shard-episodes": 1}.items()]
    process = subprocess.Popen(
        [sys.executable, "-m", "pewm_jax", "data", "collect", str(out), f"--scene={mesh}", *flags],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    limit = time.monotonic() + 60
    while not list(out.glob("train/*.array_record")) and time.monotonic() < limit:
        time.sleep(0.005)
    if how == signal.SIGKILL:
        process.kill()  # the workers live on until they notice
    else:
        os.killpg(process.pid, how)  # as a terminal does: parent and workers
    told = process.communicate(timeout=60)[1]
    if how == signal.SIGINT:
        assert process.returncode == 130
        assert told == "Interrupted; run the same command again to resume.\n"
    assert not (out / "train" / "dataset.json").exists()
    with pytest.raises(UserError, match="did not finish"):
        EpisodeSource(out / "train")
    said = []
    collect(settings(out, mesh, **options), said.append)
    assert said[0].startswith("resuming: ")
    assert fingerprints(out) == fingerprints(tmp_path / "calm")


def test_workers_ignore_ctrl_c_from_their_start(monkeypatch):
    class Job:
        run = functools.partial(signal.getsignal, signal.SIGINT)

    monkeypatch.setattr("pewm_jax.data.collect._start_worker", os.getpid)  # it comes too late
    before = signal.getsignal(signal.SIGINT)
    heard = [handler for _, handler in engines.on_processes([Job(), Job()], workers=2)]
    assert heard == [signal.SIG_IGN] * 2
    assert signal.getsignal(signal.SIGINT) is before


def test_no_house_serves_two_splits():
    seeds = {split: set() for split in ("train", "validation", "revisit")}
    for seed in range(3):
        for per in (1, 3):
            config = CollectConfig(Path("x"), seed=seed, episodes_per_house=per)
            for split, found in seeds.items():
                found |= {house_seed(config, split, i) for i in range(400)}
    assert all(len(found) == 3 * 400 for found in seeds.values())
    assert not set.intersection(seeds["train"], seeds["validation"] | seeds["revisit"])
    assert not seeds["validation"] & seeds["revisit"]


def test_meshes_are_shared_out_over_the_splits():
    meshes = tuple(Path(f"{k}.glb") for k in range(6))
    config = CollectConfig(Path("x"), scene=meshes)
    parts = [set(scenes_of(config, split)) for split in ("train", "validation", "revisit")]
    assert [len(part) for part in parts] == [4, 1, 1]
    assert set.union(*parts) == set(meshes)
    single = dataclasses.replace(config, scene=meshes[:1])
    assert scenes_of(single, "revisit") == meshes[:1]


def test_an_episode_in_a_made_house_is_valid_and_reproducible():
    config = CollectConfig(Path("x"), frames=30, size=32, ids=True)
    record = make_episode(config, "train", 0)
    assert record == make_episode(config, "train", 0)
    episode = read_episode(record)
    assert check_episode(episode, "here") == []
    assert episode.scene == "house-000000"
    assert len(np.unique(episode.ids())) > 3
    assert np.median(episode.frames().depth_THW) > 0.5


def test_test_scenes_are_revisited_or_walked_as_asked():
    config = CollectConfig(Path("x"), frames=64, size=8, turn_deg=10, step_m=0.12, turn_around=0)
    walked = dataclasses.replace(config, test_policy="follow")
    there, through = (read_episode(make_episode(c, "revisit", 0)) for c in (config, walked))
    assert there.scene == through.scene
    assert (there.info["policy"], through.info["policy"]) == ("revisit", "follow")
    assert "return_frame" in there.info
    assert "return_frame" not in through.info
    forward = [np.mean(one.action_ids == FORWARD) for one in (there, through)]
    assert forward[0] < 0.2
    assert forward[1] > 0.5
    # Datasets collected before there was a choice are complete, and other splits do not change.
    assert "test_policy" not in settings_of(config, "revisit")
    assert settings_of(walked, "revisit")["test_policy"] == "follow"
    for split in ("train", "validation"):
        assert settings_of(walked, split) == settings_of(config, split)


@pytest.mark.parametrize("index", [1, 5])
def test_edges_of_tiny_pictures_are_no_disagreement(index):
    config = CollectConfig(Path("x"), frames=60, size=16)
    assert check_episode(read_episode(make_episode(config, "train", index)), "here") == []


def test_continuous_actions_have_no_ids(mesh, tmp_path):
    config = settings(tmp_path, mesh, continuous=True)
    episode = read_episode(make_episode(config, "train", 0))
    assert episode.action_ids is None
    assert len(np.unique(np.round(episode.actions, 4), axis=0)) > 10
    assert check_episode(episode, "here") == []


@pytest.mark.parametrize("content", ["missing", "points", "broken"])
def test_a_mesh_that_cannot_be_walked_in_is_refused(tmp_path, content):
    path = tmp_path / "scene.ply"
    if content == "points":
        trimesh.PointCloud(np.random.default_rng(0).normal(size=(50, 3))).export(path)
    elif content == "broken":
        path.write_bytes(b"ply\nnonsense")
    with pytest.raises(UserError, match=r"scene\.ply"):
        collect(settings(tmp_path / "out", path))
    assert not list((tmp_path / "out").rglob("dataset.json"))


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"frames": 1}, "frames"),
        ({"size": 0}, "--size is 0"),
        ({"turn_around": 1.5}, "probability"),
        ({"hfov": 180.0}, "hfov"),
        ({"train": 0, "validation": 0, "test": 0}, "nothing to collect"),
        ({"train": -1}, "--train is -1"),
        ({"step_m": 0.0}, "step_m"),
        ({"shard_episodes": 0}, "--shard-episodes is 0"),
    ],
)
def test_settings_that_cannot_work_are_refused(wrong, says):
    with pytest.raises(ConfigError, match=says):
        CollectConfig(Path("x"), **wrong)
