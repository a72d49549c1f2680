"""The validator: it passes what is right and names what is wrong, with file, frame and field."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pewm_jax.config import UserError
from pewm_jax.data.checks import action_errors, check_episode
from pewm_jax.data.dataset import Manifest, describe_shard, write_manifest, write_shard
from pewm_jax.data.episodes import read_episode, write_episode
from pewm_jax.data.validate import ValidateConfig, validate
from pewm_jax.geometry.actions import integrate
from tests.data.two_rooms import arrays, split


def problems(made):
    return check_episode(read_episode(write_episode(made, "a", "b")), "file, record 0")


def changed(**fields):
    """A walk of 60 frames with some of its arrays put through functions."""
    made = arrays(frames=60, size=32, policy="revisit")
    return dataclasses.replace(
        made, **{name: change(np.array(getattr(made, name))) for name, change in fields.items()}
    )


def put(index, value):
    def change(array):
        array[index] = value
        return array

    return change


@pytest.mark.parametrize("policy", ["follow", "walk", "revisit"])
@pytest.mark.parametrize("seed", range(4))
def test_what_is_right_passes(policy, seed):
    assert problems(arrays(frames=60, size=32, seed=seed, policy=policy, turn_around=0.5)) == []
    assert problems(arrays(frames=60, size=24, width=40, seed=seed, policy=policy)) == []


WRONG = {
    "metres as millimetres": ({"depth_THW": lambda d: d / 1000}, None, "depth", "unit is wrong"),
    "too far": ({"depth_THW": lambda d: d * 40}, None, "depth", "unit is wrong"),
    "beyond 16 bits": ({"depth_THW": lambda d: d * 1000}, None, "depth", "unit is wrong"),
    "one frame too near": (
        {"depth_THW": lambda d: put(7, d[7] / 1000)(d)},
        7,
        "depth",
        "of this frame",
    ),
    "no depth": ({"depth_THW": lambda d: d * 0}, None, "depth", "100% of the pixels"),
    "depth twice": ({"depth_THW": lambda d: d * 2}, ..., "depth", "disagrees with the poses"),
    "depth by 1.3": ({"depth_THW": lambda d: d * 1.3}, ..., "depth", "disagrees with the poses"),
    "focal length": (
        {"intrinsics_4": lambda k: k * [1.3, 1.3, 1, 1]},
        ...,
        "depth",
        "disagrees with the poses",
    ),
    "principal point": (
        {"intrinsics_4": lambda k: k * 4},
        None,
        "intrinsics",
        "another image size",
    ),
    "no camera": ({"intrinsics_4": put(0, np.nan)}, None, "intrinsics", "must be finite"),
    "NaN pose": (
        {"world_from_camera": put((17, 0, 3), np.nan)},
        17,
        "world_from_camera",
        "NaN",
    ),
    "scaled rotation": (
        {"world_from_camera": put((5, slice(3), slice(3)), 1.1 * np.eye(3))},
        5,
        "world_from_camera",
        "not orthonormal",
    ),
    "mirror": (
        {"world_from_camera": put((5, slice(3), slice(3)), np.diag([1.0, 1, -1]))},
        5,
        "world_from_camera",
        "mirror image",
    ),
    "last row": (
        {"world_from_camera": put((9, 3), [0, 0, 1, 1])},
        9,
        "world_from_camera",
        "last row",
    ),
    "NaN action": ({"actions": put((8, 2), np.nan)}, 8, "actions", "NaN"),
    "action and pose": ({"actions": put((31, 0), 0.1)}, 31, "actions", "frame 32"),
    "turned too little": (
        {"actions": lambda a: a * [1, 1, 0.9]},
        0,
        "actions",
        "actions and poses disagree",
    ),
    "actions one late": (
        {"actions": lambda a: np.roll(a, 1, 0)},
        ...,
        "actions",
        "actions and poses disagree",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_named(name):
    changes, frame, field, says = WRONG[name]
    found = problems(changed(**changes))
    assert found
    first = found[0]
    assert first.field == field
    assert says in first.what
    assert str(first).startswith("file, record 0")
    if frame is not ...:
        assert frame is None or first.frame == frame


def test_saturated_depth_is_named_with_its_frame_and_what_to_do(monkeypatch):
    """Records of other writers, or of an older version of ours, may hold the value 65535."""
    made = changed(depth_THW=put((slice(5, None), slice(4)), 65.535))
    monkeypatch.setattr(
        "pewm_jax.data.episodes.to_millimetres",
        lambda depth: np.rint(depth.astype(np.float64) * 1000).astype(np.uint16),
    )
    (found,) = problems(made)
    assert (found.frame, found.field) == (5, "depth")
    assert "65535" in found.what
    assert "import the recording again with --overwrite" in found.what
    assert ". " not in found.what, "one sentence"


@pytest.mark.parametrize("axes", ["opengl", "inverse", "shifted"])
def test_other_conventions_do_not_pass(axes):
    def change(pose):
        if axes == "opengl":
            return pose @ np.diag([1.0, -1, -1, 1])
        return np.linalg.inv(pose) if axes == "inverse" else np.roll(pose, 3, 0)

    made = dataclasses.replace(changed(world_from_camera=change), actions=None, action_ids=None)
    assert [p.field for p in problems(made)] == ["depth"]


def test_the_comparison_of_actions_is_that_of_the_geometry_chapter():
    rng = np.random.default_rng(0)
    actions = rng.normal(size=(20, 3)).astype(np.float32)
    pose = np.asarray(integrate(arrays().world_from_camera[0], actions))
    metres, radians = action_errors(pose, actions)
    assert max(metres.max(), radians.max()) < 1e-5
    metres, radians = action_errors(pose, actions + np.array([0.3, 0.4, 0.01]))
    np.testing.assert_allclose(metres, 0.5, atol=1e-5)
    np.testing.assert_allclose(radians, 0.01, atol=1e-5)


def test_a_whole_dataset_is_walked_through(tmp_path):
    split(tmp_path / "train", frames=20)
    split(tmp_path / "validation", episodes=2, frames=20)
    said = []
    verdict = validate(ValidateConfig(tmp_path), said.append)
    assert (verdict.episodes, verdict.frames, verdict.problems) == (6, 120, [])
    assert said == [f"{tmp_path}: 6 episodes, 120 frames, no problems."]
    single = tmp_path / "train" / "shard-00000-of-00002.array_record"
    assert validate(ValidateConfig(single), said.append).episodes == 2


@pytest.mark.parametrize("left", ["collecting.json", "shard-00000-of-00002.array_record"])
def test_an_unfinished_split_beside_a_finished_one_is_named(tmp_path, left):
    split(tmp_path / "train", frames=20)
    (tmp_path / "revisit").mkdir()
    (tmp_path / "pictures").mkdir()
    (tmp_path / "revisit" / left).write_bytes(b"")
    said = []
    found = validate(ValidateConfig(tmp_path), said.append).problems
    assert [(p.where, p.field) for p in found] == [(str(tmp_path / "revisit"), "dataset.json")]
    assert "unfinished" in said[0]
    assert "no problems" not in said[-1]


def test_a_bad_record_is_found_among_good_ones(tmp_path):
    records = [write_episode(arrays(seed=i, frames=20), f"e{i}", "box") for i in range(3)]
    bad = dataclasses.replace(arrays(frames=20))
    bad.world_from_camera[4, 0, 0] = np.nan
    records.insert(1, write_episode(bad, "bad", "box"))
    path = tmp_path / "train" / "s.array_record"
    write_shard(path, records)
    write_manifest(tmp_path / "train", Manifest("train", (describe_shard(path),), {}, 80))
    said = []
    verdict = validate(ValidateConfig(tmp_path / "train"), said.append)
    assert len(verdict.problems) == 1
    assert said == [f"{path}, record 1, frame 4, world_from_camera: contains NaN or infinity."]


def test_a_file_that_was_changed_is_found_by_its_hash(tmp_path):
    folder = split(tmp_path / "train", frames=20)
    shard = folder / "shard-00001-of-00002.array_record"
    content = bytearray(shard.read_bytes())
    content[content.index(b"PEWMEPIS") + 9000] ^= 1
    shard.write_bytes(content)
    found = validate(ValidateConfig(folder), lambda _: None).problems
    assert (found[0].where, found[0].field) == (str(shard), "sha256")
    assert "record 0" in str(found[1])


def test_truncated_shards_and_absent_paths_are_refused(tmp_path):
    folder = split(tmp_path / "train", frames=20)
    shard = folder / "shard-00001-of-00002.array_record"
    shard.write_bytes(shard.read_bytes()[:-1])
    with pytest.raises(UserError, match=r"shard-00001-of-00002\.array_record .* truncated"):
        validate(ValidateConfig(tmp_path))
    shard.write_bytes(shard.read_bytes()[:3000])
    with pytest.raises(UserError, match="truncated or damaged"):
        validate(ValidateConfig(shard))
    with pytest.raises(UserError, match="does not exist"):
        validate(ValidateConfig(tmp_path / "nowhere"))
