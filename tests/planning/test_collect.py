"""An environment of one's own becomes a data set that passes validation."""

import dataclasses
import hashlib
import json
import re

import numpy as np
import pytest

from pewm_jax.cli import main as program
from pewm_jax.config import ConfigError, UserError
from pewm_jax.data.collect_env import CollectEnvConfig, collect_env, open_env
from pewm_jax.data.collect_env import make as make_record
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.episodes import read_episode
from pewm_jax.data.validate import ValidateConfig, validate
from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw
from tests.data.two_rooms import CAMERA_Z, box_views

HOUSE = "pewm_jax.planning:pewm_jax/House-v0"
SIZE = '{"height": 16, "width": 16}'


class Box:
    """A box seen analytically, with actions of its own kind: an angle to turn by.

    It follows Gymnasium's API and needs no Gymnasium.
    """

    class Angles:
        def seed(self, seed):
            self.rng = np.random.default_rng(seed)

        def sample(self):
            return self.rng.uniform(-1, 1)

    def __init__(self, lacks=(), length=50, scale=1.0, **changes):
        self.action_space = self.Angles()
        self.lacks, self.length, self.scale, self.changes = lacks, length, scale, changes
        self.closed = False
        self.unwrapped = self
        if "intrinsics" not in lacks:
            self.intrinsics_4 = intrinsics_from_fov(12, 16, 90.0)

    def reset(self, *, seed):
        self.yaw, self.count = seed % 3, 1
        return self.look(), {}

    def step(self, action):
        self.yaw, self.count = self.yaw + action, self.count + 1
        return self.look(), 0.0, False, self.count >= self.length, {}

    def look(self):
        pose = pose_from_yaw(np.array([2.0, 1.5, CAMERA_Z]), self.yaw)
        rgb, depth = box_views(pose[None], intrinsics_from_fov(12, 16, 90.0), 12, 16)
        seen = {"rgb": rgb[0], "depth": depth[0] * np.float32(self.scale), "pose": pose}
        seen |= self.changes
        return {name: value for name, value in seen.items() if name not in self.lacks}

    def close(self):
        self.closed = True


def make(**arguments):
    return Box(**arguments)


def short():
    return Box(length=4)


def bare():
    return object()


def broken():
    raise RuntimeError("no such\nrobot")


def turn_a_little(observation):
    return 0.25 if observation["depth"].min() > 0 else 9.0


ENV = f"{__name__}:make"


def settings(out, **options):
    default = {"env": ENV, "train": 3, "validation": 0, "test": 1, "frames": 12}
    return CollectEnvConfig(out, **{**default, "shard_episodes": 2, **options})


def hashes(folder):
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*.*"))
    }


def test_the_command_walks_a_registered_house(tmp_path, capsys):
    arguments = ["collect", str(tmp_path), "--env", HOUSE, "--env_args", SIZE]
    counts = ["--train", "2", "--validation", "1", "--test", "0", "--frames", "20"]
    assert program.main(["data", *arguments, *counts]) == 0
    assert program.main(["data", "validate", str(tmp_path)]) == 0
    assert "3 episodes, 60 frames, no problems" in capsys.readouterr().out
    assert program.main(["data", *arguments, *counts]) == 0
    assert "nothing to do" in capsys.readouterr().out
    episode = EpisodeSource(tmp_path / "train")[0]
    moved = np.linalg.norm(episode.actions[:, :2], axis=1)
    turned = np.abs(episode.actions[:, 2])
    assert ((np.abs(moved - 0.25) < 1e-4) | (moved < 1e-4)).all()
    assert ((moved > 0.2) | (turned > 0.5)).mean() > 0.6, "the agent walked"
    assert episode.scene == "house-000000"  # as it says in info


def test_an_environment_and_a_policy_of_ones_own(tmp_path):
    collect_env(settings(tmp_path, policy=f"{__name__}:turn_a_little"), log=lambda _: None)
    verdict = validate(ValidateConfig(tmp_path), log=lambda _: None)
    assert (verdict.episodes, verdict.frames, verdict.problems) == (4, 48, [])
    source = EpisodeSource(tmp_path / "train")
    np.testing.assert_allclose(source[1].actions, np.tile([0, 0, 0.25], (11, 1)), atol=1e-5)
    np.testing.assert_array_equal(source[0].intrinsics_4, intrinsics_from_fov(12, 16, 90.0))
    assert source[0].info["policy"].endswith("turn_a_little")
    frame = source[0].frames([5])
    rgb, depth = box_views(frame.camera.world_from_camera, source[0].intrinsics_4, 12, 16)
    assert np.abs(frame.rgb_THWC.astype(int) - rgb).max() <= 1
    np.testing.assert_allclose(frame.depth_THW, depth, atol=1e-3)


def test_random_actions_persist_and_an_interrupted_collection_goes_on(tmp_path):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    for out in (whole, cut):
        collect_env(settings(out, persistence=0.8, frames=40), log=lambda _: None)
    assert hashes(whole) == hashes(cut)
    turns = np.concatenate([one.actions[:, 2] for one in EpisodeSource(whole / "train")[:]])
    assert 0.65 < (np.abs(np.diff(turns)) < 1e-4).mean() < 0.92
    names = sorted(path.name for path in (cut / "train").glob("*.array_record"))
    assert len(names) == 2
    (cut / "train" / names[0]).unlink()
    kept = (cut / "train" / names[1]).stat().st_mtime_ns
    collect_env(settings(cut, persistence=0.8, frames=40), log=lambda _: None)
    assert hashes(whole) == hashes(cut)
    assert (cut / "train" / names[1]).stat().st_mtime_ns == kept
    with pytest.raises(ConfigError, match="made with other settings"):
        collect_env(settings(cut, frames=30), log=lambda _: None)


def test_random_actions_that_have_no_effect_are_not_repeated(tmp_path):
    """Forward into the wall of the house, for ever, is no data."""
    name = CollectEnvConfig(tmp_path, env=HOUSE, env_args=SIZE, persistence=1.0, frames=20)
    env = open_env(name)
    found = [read_episode(make_record(env, None, name, "train", index)) for index in range(4)]
    env.close()
    for one in found:
        still = np.abs(one.actions).max(1) < 1e-6
        assert not still.all()


def test_episodes_that_end_early_keep_their_length(tmp_path):
    collect_env(
        settings(tmp_path, env_args='{"length": 10}', frames=30, min_frames=5),
        log=lambda _: None,
    )
    verdict = validate(ValidateConfig(tmp_path), log=lambda _: None)
    assert (verdict.episodes, verdict.frames, verdict.problems) == (4, 40, [])
    assert json.loads((tmp_path / "train/dataset.json").read_text())["frames"] == 30


@pytest.mark.parametrize(
    ("options", "says"),
    [
        *(
            (
                {"env_args": json.dumps({"lacks": [name]})},
                f"provides no {name}: provide rgb (H, W, 3)",
            )
            for name in ("rgb", "depth", "pose", "intrinsics")
        ),
        ({"env_args": '{"depth": [[1.0, 2.0]]}'}, "provides rgb (12, 16, 3) uint8: provide"),
        ({"env_args": '{"pose": [0, 0, 0]}'}, "provides pose (3,) int64: provide"),
        ({"env_args": '{"scale": 1000.0}'}, "the unit is wrong"),
        ({"env_args": '{"scale": 0.0}'}, "have no depth"),
        ({"env": f"{__name__}:short"}, "ended 20 episodes in a row after at most 4 frames"),
        ({"env": f"{__name__}:bare"}, "returns a object without reset"),
        ({"env": f"{__name__}:broken"}, "cannot be created (RuntimeError: no such robot)"),
        ({"env": f"{__name__}:nothing"}, "the module has no 'nothing'"),
        ({"env": "no_such_module:make"}, "the module no_such_module cannot be imported"),
        ({"policy": f"{__name__}:ENV"}, "has no function ENV"),
    ],
)
def test_what_is_no_source_of_episodes_is_refused_and_nothing_is_written(tmp_path, options, says):
    with pytest.raises(UserError, match=re.escape(says)) as caught:
        collect_env(settings(tmp_path / "out", **options), log=lambda _: None)
    told = str(caught.value)
    assert told.endswith(".")
    assert "\n" not in told
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"env": "make"}, "--env is 'make': give MODULE:NAME"),
        ({"env": "a b:make"}, "--env is 'a b:make'"),
        ({"policy": "x"}, "--policy is 'x'"),
        ({"env_args": "[1]"}, "--env-args is '[1]': give a JSON object."),
        ({"env_args": "{"}, "--env-args is"),
        ({"train": -1}, "--train is -1"),
        ({"train": 0, "test": 0}, "nothing to collect"),
        ({"frames": 1}, "--min-frames is 9 and --frames 1"),
        ({"min_frames": 1}, "--min-frames is 1"),
        ({"persistence": 2.0}, "--persistence is 2.0"),
        ({"shard_episodes": 0}, "--shard-episodes is 0"),
    ],
)
def test_settings_that_cannot_work_are_refused(tmp_path, options, says):
    with pytest.raises(ConfigError, match=re.escape(says)):
        settings(tmp_path, **options)


def test_help_explains_every_flag(tmp_path, capsys):
    with pytest.raises(SystemExit):
        program.main(["data", "collect", "--env", "--help"])
    text = capsys.readouterr().out
    for field in dataclasses.fields(CollectEnvConfig):
        assert field.name == "out" or f"--{field.name}" in text
    assert program.main(["data", "collect", str(tmp_path), "--env=x"]) == 2
    assert "give MODULE:NAME" in capsys.readouterr().err
