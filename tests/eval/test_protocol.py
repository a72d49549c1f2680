"""What is scored: deterministic, on the way back, with the right actions and context."""

from __future__ import annotations

import dataclasses
import functools

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax import worlds
from pewm_jax.config import UserError
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.episodes import read_episode
from pewm_jax.eval.clips import (
    choose,
    context_frames,
    fingerprint,
    load_clip,
    return_start,
    stack,
)
from pewm_jax.eval.reproject import CANDIDATES, reproject
from pewm_jax.geometry.actions import integrate
from pewm_jax.io.store import file_hash
from pewm_jax.memory.images import ImagesConfig
from pewm_jax.memory.points import PointsConfig
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.memory.voxel_map import Map2DConfig, VoxelConfig
from tests.eval.scene import record, tiny, write_split


@pytest.fixture(scope="module")
def episodes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "revisit"
    return EpisodeSource(write_split(folder, episodes=3))


@given(st.integers(0, 200), st.integers(1, 40))
def test_context_is_the_past_and_ends_in_the_present(start, count):
    frames = context_frames(start, count)
    assert len(frames) == count
    assert frames[-1] == start
    assert list(frames) == sorted(frames)
    assert min(frames) >= 0
    if count > 2 and start > 2 * count:  # spread over the whole past
        assert frames[0] < start / (count - 1)
    if start + 1 >= count:
        assert len(set(frames)) == count


@given(clips=st.integers(1, 20), chain=st.integers(1, 2), stride=st.integers(1, 2))
def test_choices_are_distinct_and_on_the_way_back(episodes, tmp_path_factory, clips, chain, stride):
    config = tiny(tmp_path_factory.getbasetemp(), stride=stride)
    length = chain * (config.model.clip.frames - 1) * stride
    if length > 23:
        return
    choices = choose(config, episodes, clips, chain)
    assert choices == choose(config, episodes, clips, chain)
    assert len({(c.episode, c.start) for c in choices}) == len(choices) <= clips
    for choice in choices:
        assert choice.context_S[-1] == choice.start
        assert choice.targets_N[0] == choice.start + stride
        assert choice.targets_N[-1] == choice.start + length <= 23
        assert choice.start >= min(12, 23 - length)
    # The first starts of all episodes come before the second start of any.
    assert [c.episode for c in choices[: len(episodes)]] == list(range(len(episodes)))[:clips]


def test_the_middle_is_the_way_back_where_none_is_recorded(episodes):
    assert return_start(episodes[0]) == 12
    assert return_start(dataclasses.replace(episodes[0], info={})) == episodes[0].length // 2
    assert return_start(dataclasses.replace(episodes[0], info={"return_frame": 0})) == 0


def test_actions_lead_through_the_targets(episodes, tmp_path):
    config = tiny(tmp_path, stride=2)
    choice = choose(config, episodes, 2, 1)[1]
    context, targets, actions = load_clip(config, episodes, choice)
    assert context.rgb_THWC.shape[0] == config.data.context
    episode = episodes[choice.episode]
    poses = np.asarray(integrate(episode.world_from_camera[choice.start], actions))
    np.testing.assert_allclose(poses[1:], targets.camera.world_from_camera, atol=1e-4)
    np.testing.assert_array_equal(context.rgb_THWC[-1], episode.frames([choice.start]).rgb_THWC[0])
    np.testing.assert_array_equal(targets.rgb_THWC, episode.frames(list(choice.targets_N)).rgb_THWC)


def test_actions_that_disagree_with_poses_are_refused(tmp_path):
    good = read_episode(record(0))
    shifted = dataclasses.replace(good, actions=np.roll(good.actions, 1, 0))
    config = tiny(tmp_path)
    with pytest.raises(UserError, match="recorded actions and the recorded pose disagree"):
        load_clip(config, [shifted], choose(config, [shifted], 1, 1)[0])
    tilt = np.eye(4, dtype=np.float32)
    tilt[:3, :3] = [[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]]
    poses = good.world_from_camera.copy()
    poses[14:] = poses[14:] @ tilt
    nodding = dataclasses.replace(good, world_from_camera=poses, actions=None)
    with pytest.raises(UserError, match="planar motion"):
        load_clip(config, [nodding], choose(config, [nodding], 1, 1)[0])


def test_frames_of_another_size_are_refused(tmp_path):
    other = [read_episode(record(0, size=24))]
    config = tiny(tmp_path)
    with pytest.raises(UserError, match=r"24×24.*16×16"):
        load_clip(config, other, choose(config, other, 1, 1)[0])


def test_episodes_that_are_too_short_are_refused(tmp_path):
    short = [read_episode(record(0, length=14))]
    with pytest.raises(UserError, match="need 17 frames and the longest has 14"):
        choose(tiny(tmp_path), short, 4, 4)


def test_stack_pads_with_the_last():
    stacked = stack([{"a": np.zeros(2)}, {"a": np.ones(2)}], 4)
    np.testing.assert_array_equal(stacked["a"][:, 0], [0, 1, 1, 1])


def test_fingerprint_names_what_the_numbers_depend_on(tmp_path):
    config = tiny(tmp_path)
    base = fingerprint(config, "w", "d")
    more_seeds = dataclasses.replace(
        config, evaluate=dataclasses.replace(config.evaluate, seeds=(0, 1, 2, 3))
    )
    steps = config.with_model(noise=dataclasses.replace(config.model.noise, sample_steps=3))
    context = dataclasses.replace(config, data=dataclasses.replace(config.data, context=5))
    assert fingerprint(more_seeds, "w", "d") == base
    others = [
        fingerprint(steps, "w", "d"),
        fingerprint(context, "w", "d"),
        fingerprint(config, "other", "d"),
        fingerprint(config, "w", "other"),
        fingerprint(config, "w", "d", "lpips"),
    ]
    assert len({base, *others}) == 6


def test_file_hash_is_sha256(tmp_path):
    (tmp_path / "f").write_bytes(b"abc")
    assert file_hash(tmp_path / "f").startswith("ba7816bf8f01cfea")


MEMORIES = {
    "voxel": VoxelConfig(cells=(64, 64, 16), capacity=512, tokens=16),
    "map2d": Map2DConfig(tokens=16),
    "points": PointsConfig(cells=(64, 64, 16), capacity=512, tokens=16),
    "images": ImagesConfig(tokens=16, snapshots=2),
    "mean": SurfelConfig(cells=(64, 64, 16), capacity=2048, tokens=16, keep="mean"),
    "newest": SurfelConfig(cells=(64, 64, 16), capacity=2048, tokens=16, keep="newest"),
}


@pytest.mark.slow(but="voxel")
@pytest.mark.parametrize("kind", MEMORIES)
def test_padding_of_a_short_context_is_not_remembered(episodes, tmp_path, kind):
    """A context of 4 frames, padded to 6, makes the memory of the 4 frames alone."""
    config = tiny(tmp_path).with_model(memory=MEMORIES[kind])
    (choice,) = choose(config, episodes, 1, 1)
    choice = dataclasses.replace(choice, context_S=context_frames(3, 6))
    assert choice.context_S == (0, 0, 0, 1, 2, 3)
    padded, _, _ = load_clip(config, episodes, dataclasses.replace(choice, start=3, targets_N=(4,)))
    alone = jax.tree.map(lambda x: x[2:], padded)
    assert not padded.depth_THW[:2].any()
    assert (alone.depth_THW.max((1, 2)) > 0).all()
    np.testing.assert_array_equal(padded.rgb_THWC[0], alone.rgb_THWC[0])
    params = jax.jit(functools.partial(worlds.init, config.model))(jax.random.key(0))
    start = jax.jit(functools.partial(worlds.start, config.model))
    one, other = (start(params, frames).map for frames in (padded, alone))
    for a, b in zip(*map(jax.tree.leaves, (one, other)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


@pytest.mark.slow(but="points of 1 pixel each, the mean of those at the front")
@pytest.mark.parametrize("settings", CANDIDATES, ids=str)
def test_padding_of_a_short_context_is_not_reprojected_twice(episodes, tmp_path, settings):
    config = tiny(tmp_path)
    (choice,) = choose(config, episodes, 1, 1)
    choice = dataclasses.replace(choice, context_S=(0, 0, 0, 1, 2, 3), start=3, targets_N=(4, 5))
    padded, targets, _ = load_clip(config, episodes, choice)
    alone = jax.tree.map(lambda x: x[2:], padded)
    one, other = (reproject(settings, frames, targets.camera) for frames in (padded, alone))
    np.testing.assert_allclose(one.rgb_THWC, other.rgb_THWC, atol=1e-5)
    np.testing.assert_allclose(one.depth_THW, other.depth_THW, atol=1e-5)
