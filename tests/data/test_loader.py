"""The loader: position is one integer, clips fit their episodes, the past is the past."""

import itertools

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.config import ActionConfig, ClipConfig, Config, ConfigError, DataConfig, UserError
from pewm_jax.data import clips as clipping
from pewm_jax.data import loader
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.geometry.cameras import unproject
from pewm_jax.worlds.pewm.world import PEWM
from tests.data.two_rooms import clip_at, split
from tests.properties import examples


def config(path="", **data):
    return Config(
        model=PEWM(clip=ClipConfig(frames=5, height=16, width=16)),
        data=DataConfig(path=str(path), **{"stride_max": 3, "context": 6, **data}),
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    split(root / "train", episodes=6, frames=24)
    return root


def same(one, two):
    return jax.tree.all(jax.tree.map(np.array_equal, one, two))


def test_a_jump_gives_what_iteration_gives(folder):
    batches = list(itertools.islice(loader.clips(config(folder), seed=1, batch=4), 6))
    for k in (0, 2, 5):
        assert same(next(loader.clips(config(folder), seed=1, batch=4, start_step=k)), batches[k])
        assert same(loader.dataset(config(folder), "train", seed=1, batch=4)[k], batches[k])
    assert not same(batches[0], batches[1])
    assert not same(next(loader.clips(config(folder), seed=2, batch=4)), batches[0])


def test_the_number_of_threads_changes_nothing(folder):
    one = itertools.islice(loader.clips(config(folder), seed=1, batch=4), 5)
    two = itertools.islice(loader.clips(config(folder, workers=3), seed=1, batch=4), 5)
    assert all(same(a, b) for a, b in zip(one, two, strict=True))


def test_batches_have_the_shapes_and_types_that_training_expects(folder):
    batch = next(loader.clips(config(folder), seed=0, batch=3))
    assert batch.frames.rgb_THWC.shape == (3, 5, 16, 16, 3)
    assert batch.frames.rgb_THWC.dtype == np.uint8
    assert batch.frames.depth_THW.dtype == np.float32
    assert batch.frames.camera.intrinsics_4.shape == (3, 5, 4)
    assert batch.context.depth_THW.shape == (3, 6, 16, 16)
    assert batch.context.camera.world_from_camera.shape == (3, 6, 4, 4)
    assert batch.context_valid_S.dtype == bool


def test_an_epoch_visits_every_episode_once(folder):
    batches = loader.dataset(config(folder), "train", seed=3, batch=6)
    episode_of = {
        pose.tobytes(): episode.name
        for episode in EpisodeSource(folder / "train")
        for pose in episode.world_from_camera
    }
    orders = []
    for k in range(4):
        poses = batches[k].frames.camera.world_from_camera[:, 0]
        orders.append(tuple(episode_of[pose.tobytes()] for pose in poses))
        assert len(set(orders[-1])) == 6
    assert len(set(orders)) > 1  # and not always in the same order


def test_batches_of_one_are_clips_of_the_same_order(folder):
    ones = loader.dataset(config(folder), "train", seed=3, batch=1).slice(slice(5, None))
    pairs = loader.dataset(config(folder), "train", seed=3, batch=2)
    for k in (0, 1):
        np.testing.assert_array_equal(ones[1 + k].frames.rgb_THWC[0], pairs[3].frames.rgb_THWC[k])


def test_the_last_valid_context_frame_is_the_first_of_the_clip(folder):
    batch = next(loader.clips(config(folder), seed=0, batch=16))
    for i, valid in enumerate(batch.context_valid_S):
        count = int(valid.sum())
        assert valid[:count].all()
        np.testing.assert_array_equal(
            batch.context.rgb_THWC[i, count - 1], batch.frames.rgb_THWC[i, 0]
        )
        assert not batch.context.depth_THW[i, count:].any()
        assert np.isfinite(batch.context.camera.world_from_camera[i]).all()
    assert not batch.context_valid_S.all()
    assert batch.context_valid_S.all(1).any()


def test_context_and_clip_see_one_world(folder):
    """Frames keep their own cameras: points of clip and context lie on the walls of the box."""
    batch = next(loader.clips(config(folder), seed=0, batch=8))
    for frames in (batch.frames, batch.context):
        points = np.asarray(unproject(frames.depth_THW, frames.camera))[frames.depth_THW > 0]
        low, high = np.zeros(3), np.array([6.0, 4.0, 2.5])
        off = np.minimum(np.abs(points - low), np.abs(points - high)).min(-1)
        assert off.max() < 5e-3


@examples(60)
@given(
    length=st.integers(5, 60),
    seed=st.integers(0, 10_000),
    slots=st.integers(1, 9),
    most=st.integers(1, 4),
)
def test_any_choice_fits_its_episode(length, seed, slots, most):
    chosen = clipping.choose(
        config(context=slots, stride_max=most), length, np.random.default_rng(seed)
    )
    stride = set(np.diff(chosen.frames_T))
    assert len(stride) == 1
    assert 1 <= stride.pop() <= most
    assert chosen.frames_T[0] >= 0
    assert chosen.frames_T[-1] < length
    start, past = chosen.frames_T[0], chosen.context_S
    assert past[-1] == start
    assert (np.diff(past) > 0).all()
    assert len(past) <= slots
    if start < slots:
        np.testing.assert_array_equal(past, np.arange(start + 1))
    elif slots > 1:
        assert past[-2] == start - 1
        edges = np.linspace(0, start, slots)
        assert past[0] <= edges[1]


def test_all_strides_and_all_starts_occur():
    rng = np.random.default_rng(0)
    drawn = [clipping.choose(config(), 13, rng).frames_T for _ in range(400)]
    seen = {(int(f[1] - f[0]), int(f[0])) for f in drawn}
    assert seen == {(s, k) for s in (1, 2, 3) for k in range(13 - 4 * s)}


def test_a_certain_clip_is_always_the_same(folder):
    episode = EpisodeSource(folder / "train")[1]
    one = clip_at(config(), episode, start=10, stride=2)
    assert same(one, clip_at(config(), episode, start=10, stride=2))
    np.testing.assert_array_equal(
        one.frames.camera.world_from_camera, episode.world_from_camera[10:19:2]
    )


def test_what_does_not_fit_is_refused_before_training(folder):
    with pytest.raises(UserError, match="16×16 pixels, the configuration needs 64×64"):
        loader.clips(config(folder).with_model(clip=ClipConfig()), seed=0, batch=2)
    long = config(folder).with_model(clip=ClipConfig(frames=25, height=16, width=16))
    with pytest.raises(UserError, match="has 24 frames, a clip of 25 frames at stride 1 needs 25"):
        loader.clips(long, seed=0, batch=2)
    with pytest.raises(UserError, match="does not exist"):
        loader.clips(config(folder), "nowhere", seed=0, batch=2)


@pytest.mark.parametrize(("name", "made"), [("step_m", 0.1), ("turn_deg", 15.0)])
def test_actions_other_than_the_collected_ones_are_refused(tmp_path, name, made):
    split(tmp_path / "train", frames=24, info={"step_m": 0.25, "turn_deg": 30.0, name: made})
    with pytest.raises(ConfigError, match=rf"set --actions\.{name} {made:g}\.$"):
        loader.clips(config(tmp_path), seed=0, batch=2)
    fits = config(tmp_path).with_model(actions=ActionConfig(**{name: made}))
    assert next(loader.clips(fits, seed=0, batch=2)).frames.rgb_THWC.shape[0] == 2


BATCH = 6


@pytest.fixture(scope="module")
def rows_config(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    split(root / "train", episodes=4, frames=16)
    clip = ClipConfig(frames=5, height=16, width=16)
    return Config(model=PEWM(clip=clip), data=DataConfig(path=str(root), stride_max=3, context=3))


@given(st.integers(0, BATCH - 1), st.integers(1, BATCH), st.integers(0, 9))
@examples(20)
def test_rows_are_those_of_the_whole_batch_at_every_step(rows_config, first, count, step):
    rows = slice(first, min(first + count, BATCH))
    whole = next(loader.clips(rows_config, seed=5, batch=BATCH, start_step=step))
    part = next(loader.clips(rows_config, seed=5, batch=BATCH, start_step=step, rows=rows))
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[rows], b), whole, part)


def test_only_the_rows_asked_for_are_decoded(rows_config):
    decoded = []

    def features(episode, frames):
        decoded.append(episode.name)
        return np.zeros((len(frames), 1, 1, 1))

    batches = loader.dataset(rows_config, "train", 5, BATCH, features, rows=slice(2, 4))
    for step in (0, 7):
        decoded.clear()
        assert len(batches[step].context_valid_S) == len(decoded) == 2
