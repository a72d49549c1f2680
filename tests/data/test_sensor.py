"""Hand-held recordings have errors of the stated sizes, and are functions of their seed."""

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest

from pewm_jax.data import sensor
from pewm_jax.data.checks import check_episode
from pewm_jax.data.episodes import read_episode
from pewm_jax.data.make_episode import CollectConfig, make_episode, settings_of
from pewm_jax.errors import ConfigError, UserError
from tests.data import two_rooms


@pytest.fixture(scope="module")
def walk():
    return two_rooms.arrays(frames=16, size=32)


def record(walk, seed=0):
    rng = None if seed is None else np.random.default_rng(seed)
    pose = np.asarray(walk.world_from_camera)
    return sensor.record(rng, walk.rgb_THWC, walk.depth_THW, pose), pose


def test_without_a_seed_the_truth_is_recorded(walk):
    made, pose = record(walk, None)
    np.testing.assert_array_equal(made.rgb_THWC, walk.rgb_THWC)
    np.testing.assert_array_equal(made.depth_THW, walk.depth_THW)
    np.testing.assert_array_equal(made.pose_T44, pose)


def test_errors_have_the_stated_sizes_and_come_from_the_seed(walk):
    again = record(walk, 3)[0]
    assert all(
        np.array_equal(getattr(again, field.name), getattr(record(walk, 3)[0], field.name))
        for field in dataclasses.fields(again)
    )
    moved, turned, noise, holes = [], [], [], []
    for seed in range(12):
        made, pose = record(walk, seed)
        assert made.rgb_THWC.dtype == np.uint8
        off = np.linalg.inv(pose.astype(np.float64)) @ made.pose_T44
        np.testing.assert_allclose(made.pose_T44[:, 3], pose[:, 3])
        np.testing.assert_allclose(np.linalg.det(made.pose_T44[:, :3, :3]), 1, atol=1e-5)
        moved.append(np.abs(off[:, :3, 3]).max())
        turned.append(np.degrees(np.arccos(np.clip((np.trace(off[:, :3, :3].T) - 1) / 2, -1, 1))))
        there = (made.depth_THW > 0) & (walk.depth_THW < min(sensor.RANGE_M))
        relative = (made.depth_THW - walk.depth_THW) / walk.depth_THW**2
        noise.append(np.median(np.abs(relative[there])))
        holes.append(1 - np.mean(made.depth_THW > 0))
    assert 0.001 < np.mean(moved) < 5 * sensor.DRIFT_M
    assert 0.05 < np.mean(turned) < 5 * sensor.DRIFT_DEG
    assert 1e-4 < np.mean(noise) < sensor.QUADRATIC
    assert 0 < np.mean(holes) < 0.6


def test_a_kind_of_error_alone_changes_only_what_it_concerns(walk):
    pose = np.asarray(walk.world_from_camera)
    whole = record(walk, 3)[0]
    fields = {"exposure": "rgb_THWC", "grain": "rgb_THWC", "poses": "pose_T44"}
    truth = sensor.record(None, walk.rgb_THWC, walk.depth_THW, pose)
    for kind in sensor.ERRORS:
        rng = np.random.default_rng(3)
        made = sensor.record(rng, walk.rgb_THWC, walk.depth_THW, pose, (kind,))
        for field in dataclasses.fields(made):
            arrays = [getattr(one, field.name) for one in (made, truth, whole)]
            concerned = field.name == fields.get(kind, "depth_THW")
            assert concerned or np.array_equal(arrays[0], arrays[1])
            if kind == "poses" and concerned:
                np.testing.assert_array_equal(arrays[0], arrays[2])
                assert not np.array_equal(arrays[0], arrays[1])
    changed = dict.fromkeys(sensor.ERRORS, False)
    # Displacements round to whole pixels: none in an image of 32.
    rgb, depth = (x.repeat(4, 1).repeat(4, 2) for x in (walk.rgb_THWC, walk.depth_THW))
    truth = sensor.record(None, rgb, depth, pose)
    for kind, seed in itertools.product(sensor.ERRORS, range(6)):
        made = sensor.record(np.random.default_rng(seed), rgb, depth, pose, (kind,))
        name = fields.get(kind, "depth_THW")
        changed[kind] |= not np.array_equal(getattr(made, name), getattr(truth, name))
    assert all(changed.values())
    lost = [
        sensor.record(np.random.default_rng(3), walk.rgb_THWC, walk.depth_THW, pose, kinds)
        for kinds in (("edges",), ("range",), ("edges", "range"))
    ]
    holes = [one.depth_THW == 0 for one in lost]
    np.testing.assert_array_equal(holes[0] | holes[1], holes[2])


def test_an_unknown_kind_of_error_is_refused(walk):
    rng, pose = np.random.default_rng(0), np.asarray(walk.world_from_camera)
    with pytest.raises(UserError, match="errors has 'blur': use some of exposure, grain"):
        sensor.record(rng, walk.rgb_THWC, walk.depth_THW, pose, ("blur",))


def test_slow_noise_has_deviation_one_and_is_correlated():
    noise = sensor.slow_noise(np.random.default_rng(0), 20000, 2)
    np.testing.assert_allclose(noise.std(0), 1, atol=0.1)
    assert np.corrcoef(noise[:-1, 0], noise[1:, 0])[0, 1] > 0.95


def test_a_share_of_the_training_episodes_is_filmed_by_hand_and_the_others_are_as_before():
    plain = CollectConfig(Path("x"), frames=28, size=32)
    config = dataclasses.replace(plain, handheld=0.5)
    made = [(make_episode(config, "train", i), make_episode(plain, "train", i)) for i in range(5)]
    by_hand = [read_episode(one).info.get("handheld", False) for one, _ in made]
    assert 0 < sum(by_hand) < 5
    fields = set()
    for hand, (one, other) in zip(by_hand, made, strict=True):
        assert hand == (one != other)
        episode = read_episode(one)
        assert check_episode(episode, "here") == []
        fields |= {round(float(episode.intrinsics_4[0]), 3)} if hand else set()
        tilt = np.abs(np.asarray(episode.world_from_camera)[:, 2, 0]).max()
        assert (tilt > 1e-3) == hand
    assert len(fields) == sum(by_hand)
    for split in ("validation", "revisit"):
        assert settings_of(config, split) == settings_of(plain, split)
        assert make_episode(config, split, 1) == make_episode(plain, split, 1)
    assert settings_of(config, "train")["handheld"] == 0.5
    assert "handheld" not in settings_of(plain, "train")
    with pytest.raises(ConfigError, match="--handheld is 2: use a probability"):
        CollectConfig(Path("x"), handheld=2)
