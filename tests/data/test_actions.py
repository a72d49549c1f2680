"""Actions of clips: action k leads from frame k to frame k + 1 of the clip, at any stride."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

from pewm_jax.config import ClipConfig, Config, DataConfig, UserError
from pewm_jax.data import clips, loader
from pewm_jax.data.checks import check_episode
from pewm_jax.data.episodes import read_episode, write_episode
from pewm_jax.geometry.actions import compose, integrate
from pewm_jax.worlds.pewm.world import PEWM
from tests.data.two_rooms import arrays, clip_at, split, write_split

T = 5


def episode(**options):
    """A walk through the box; ``actions`` replace what was recorded."""
    other = {name: options.pop(name) for name in ("actions",) if name in options}
    made = dataclasses.replace(arrays(frames=30, policy="walk", **options), **other)
    return read_episode(write_episode(made, "a", "b"))


def config(path="", **data):
    return Config(
        model=PEWM(clip=ClipConfig(frames=T, height=16, width=16)),
        data=DataConfig(path=str(path), **{"context": 3, **data}),
    )


@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.parametrize("stride", [1, 2, 3])
def test_following_the_actions_of_a_clip_from_its_first_pose_gives_its_other_poses(
    stride, continuous
):
    walk = episode(continuous=continuous, turn_around=1.0, seed=3)
    off = []
    for start in range(0, 30 - (T - 1) * stride, 4):
        clip = clip_at(config(), walk, start, stride)
        poses = clip.frames.camera.world_from_camera
        assert clip.actions_TA.shape == (T - 1, 3)
        assert clip.actions_TA.dtype == np.float32
        np.testing.assert_allclose(integrate(poses[0], clip.actions_TA), poses, atol=2e-5)
        late = integrate(poses[0], np.roll(clip.actions_TA, 1, 0))
        off.append(np.abs(late - poses).max())
    assert max(off) > 0.05, "actions that come one frame late are noticed"


def test_single_actions_arrive_as_they_were_recorded():
    walk = episode(continuous=True)
    clip = clip_at(config(), walk, 6)
    np.testing.assert_array_equal(clip.actions_TA, walk.actions[6:10])


def test_composed_actions_are_planar_motions_whatever_the_order_of_joining():
    rng = np.random.default_rng(0)
    steps = rng.normal(size=(7, 6, 3))
    halves = np.stack([compose(steps[:, :2]), compose(steps[:, 2:])], 1)
    np.testing.assert_allclose(compose(halves), compose(steps), atol=1e-5)
    np.testing.assert_allclose(compose(np.tile([0, 0, np.pi / 2], (4, 1))), [0, 0, 2 * np.pi])
    np.testing.assert_allclose(
        compose(np.array([[0, 0, np.pi / 2], [1, 0, 0]]))[:2], [0, 1], atol=1e-6
    )


def test_actions_of_another_kind_are_kept_and_laid_end_to_end():
    other = np.arange(29 * 4, dtype=np.float32).reshape(29, 4)
    walk = episode(actions=other)
    np.testing.assert_array_equal(walk.actions, other)
    assert check_episode(walk, "here") == []
    clip = clip_at(config(), walk, 2, stride=3)
    assert clip.actions_TA.shape == (T - 1, 12)
    np.testing.assert_array_equal(clip.actions_TA.ravel(), other[2:14].ravel())
    with pytest.raises(
        UserError, match=r"actions_TA of different shapes \(\(4, 12\) and \(4, 4\)\)"
    ):
        clips.stack([clip, clip_at(config(), walk, 2)])


def test_one_frame_has_no_action():
    assert clip_at(config(), episode(), 3, frames=1).actions_TA.shape == (0, 3)


def test_what_was_not_recorded_leaves_no_trace():
    walk = dataclasses.replace(episode(), actions=None)
    clip = clip_at(config(), walk, 3)
    assert (clip.actions_TA, clip.extras) == (None, {})
    batch = clips.stack([clip, clip])
    assert len(jax.tree.leaves(batch)) == 9
    with pytest.raises(UserError, match=r"one batch have actions_TA .*\(4, 3\) and none"):
        clips.stack([clip, clip_at(config(), episode(), 3)])


def test_the_loader_keeps_what_is_recorded(tmp_path):
    split(tmp_path / "train", frames=24)
    batch = next(loader.clips(config(tmp_path, stride_max=3), seed=0, batch=8))
    poses = batch.frames.camera.world_from_camera
    for pose, actions in zip(poses, batch.actions_TA, strict=True):
        np.testing.assert_allclose(integrate(pose[0], actions), pose, atol=2e-5)


@pytest.mark.parametrize("listed", [True, False])
@pytest.mark.parametrize("first", [True, False])
def test_an_imported_split_of_both_kinds_has_clips_without_actions(tmp_path, first, listed):
    made = arrays(frames=24)
    still = dataclasses.replace(made, actions=None, action_ids=None)
    records = [write_episode(one, "a", "b") for one in ((made, still) if first else (still, made))]
    settings = {"made_by": "import", "actions": {"one": first, "two": not first}}
    if not listed:
        del settings["actions"]
    write_split(tmp_path / "train", records, settings)
    assert next(loader.clips(config(tmp_path), seed=0, batch=4)).actions_TA is None


def test_actions_that_cannot_be_composed_need_one_stride(tmp_path):
    made = dataclasses.replace(arrays(frames=24), actions=np.zeros((23, 7), np.float32))
    write_split(tmp_path / "train", [write_episode(made, "a", "b")], {})
    with pytest.raises(UserError, match=r"actions of width 7.*data.stride_min .* data.stride_max"):
        loader.clips(config(tmp_path, stride_max=3), seed=0, batch=2)
    batch = next(loader.clips(config(tmp_path, stride_min=2, stride_max=2), seed=0, batch=2))
    assert batch.actions_TA.shape == (2, T - 1, 14)
