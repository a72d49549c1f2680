"""The episode format and the split folder: what goes in comes out, and damage is noticed."""

from __future__ import annotations

import dataclasses
import json
import pickle
import resource
import struct

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.config import UserError
from pewm_jax.data.dataset import EpisodeSource, count_records, describe_shard, write_shard
from pewm_jax.data.episodes import EpisodeArrays, read_episode, to_millimetres, write_episode
from tests.data.two_rooms import arrays, split
from tests.properties import examples


def random_arrays(frames, height, width, seed, extras):
    rng = np.random.default_rng(seed)
    shape = (frames, height, width)
    return EpisodeArrays(
        rgb_THWC=rng.integers(0, 256, (*shape, 3), np.uint8),
        depth_THW=rng.uniform(0, 60, shape) * (rng.random(shape) > 0.2),
        intrinsics_4=rng.uniform(1, 9, 4).astype(np.float32),
        world_from_camera=rng.normal(size=(frames, 4, 4)).astype(np.float32),
        actions=rng.normal(size=(frames - 1, 3)).astype(np.float32) if extras else None,
        action_ids=rng.integers(0, 3, frames - 1) if extras else None,
        ids_THW=rng.integers(-1, 65535, shape) if extras else None,
    )


@examples(25)
@given(
    frames=st.integers(1, 5),
    height=st.integers(1, 9),
    width=st.integers(1, 9),
    seed=st.integers(0, 999),
    extras=st.booleans(),
)
def test_what_goes_in_comes_out(frames, height, width, seed, extras):
    given_ = random_arrays(frames, height, width, seed, extras)
    episode = read_episode(write_episode(given_, "näme", "scene", {"return_frame": 3}))
    seen = episode.frames()
    np.testing.assert_array_equal(seen.rgb_THWC, given_.rgb_THWC)
    assert np.abs(seen.depth_THW - given_.depth_THW).max() <= 0.5e-3 + 1e-5
    assert seen.depth_THW.dtype == np.float32
    np.testing.assert_array_equal((given_.depth_THW == 0) & (seen.depth_THW != 0), False)
    np.testing.assert_array_equal(episode.world_from_camera, given_.world_from_camera)
    np.testing.assert_array_equal(seen.camera.intrinsics_4, [given_.intrinsics_4] * frames)
    assert (episode.name, episode.scene, episode.length) == ("näme", "scene", frames)
    assert episode.info["return_frame"] == 3
    if extras:
        np.testing.assert_array_equal(episode.actions, given_.actions)
        np.testing.assert_array_equal(episode.action_ids, given_.action_ids)
        np.testing.assert_array_equal(episode.ids(), given_.ids_THW)
    else:
        assert episode.actions is None
        assert episode.action_ids is None
        with pytest.raises(UserError, match="no instance ids"):
            episode.ids()


def test_frames_come_in_the_order_asked_for_and_alone():
    given_ = arrays()
    record = bytearray(write_episode(given_, "a", "b"))
    for stream in read_episode(bytes(record)).header["streams"].values():
        for k, (offset, size) in enumerate(stream["spans"]):
            if k not in (2, 7):
                record[offset : offset + size] = bytes(size)
    episode = read_episode(bytes(record))
    seen = episode.frames([7, 2, 7])
    np.testing.assert_array_equal(seen.rgb_THWC, given_.rgb_THWC[[7, 2, 7]])
    np.testing.assert_array_equal(
        seen.camera.world_from_camera, episode.world_from_camera[[7, 2, 7]]
    )
    with pytest.raises(UserError, match="frame 3, rgb"):
        episode.frames([3])


def test_the_same_episode_gives_the_same_bytes():
    assert write_episode(arrays(), "a", "b") == write_episode(arrays(), "a", "b")


def test_depth_is_millimetres_and_what_does_not_fit_is_missing():
    depth = np.array([0.0, 0.0004, 0.0006, 1.2345678, 65.534, 65.535, 70, np.inf, np.nan, -1.0])
    np.testing.assert_array_equal(to_millimetres(depth), [0, 0, 1, 1235, 65534, 0, 0, 0, 0, 0])
    fine = to_millimetres(np.linspace(65.53, 65.54, 1001))
    assert 65535 not in fine


def test_the_record_is_laid_out_as_documented():
    given_ = arrays(frames=5)
    record = write_episode(given_, "a", "b")
    assert record[:8] == b"PEWMEPIS"
    (length,) = struct.unpack("<I", record[8:12])
    header, payload = json.loads(record[12 : 12 + length]), record[12 + length :]
    assert (header["format"], header["version"]) == ("pewm-episode", 1)
    place = header["arrays"]["actions"]
    assert (place["dtype"], place["shape"]) == ("<f4", [4, 3])
    np.testing.assert_array_equal(
        np.frombuffer(payload, "<f4", 12, place["offset"]).reshape(4, 3),
        given_.actions.astype(np.float32),
    )
    offset, size = header["streams"]["depth"]["spans"][3]
    image = cv2.imdecode(
        np.frombuffer(payload[offset : offset + size], np.uint8), cv2.IMREAD_UNCHANGED
    )
    assert image.dtype == np.uint16
    np.testing.assert_array_equal(image, np.rint(given_.depth_THW[3].astype(float) * 1000))
    offset, size = header["streams"]["depth"]["spans"][-1]
    assert offset + size == len(payload)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda b: b[:10], "not a pewm episode"),
        (lambda b: b"X" + b[1:], "not a pewm episode"),
        (lambda b: b[:100], "does not parse"),
        (lambda b: b.replace(b'"streams"', b'"steams!"'), "does not parse"),
        (lambda b: b[:-1], "truncated"),
        (lambda b: b.replace(b'"version":1', b'"version":9'), "format version 9"),
        (lambda b: b.replace(b'"frames":12', b'"frames":13'), "counts do not match"),
    ],
)
def test_a_damaged_record_is_refused(damage, says):
    record = write_episode(arrays(), "a", "b")
    with pytest.raises(UserError, match=says) as error:
        read_episode(damage(record), "file, record 3")
    assert "file, record 3" in str(error.value)


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("world_from_camera", np.zeros((3, 4, 4)), "world_from_camera"),
        ("actions", np.zeros((12, 3)), "actions"),
        ("intrinsics_4", np.zeros(3), "intrinsics"),
        ("rgb_THWC", np.zeros((12, 16, 16, 3), np.float32), "uint8"),
        ("rgb_THWC", np.zeros((12, 8, 16, 3), np.uint8), "rgb"),
    ],
)
def test_arrays_that_do_not_fit_are_not_written(field, value, says):
    with pytest.raises(UserError, match=says):
        write_episode(dataclasses.replace(arrays(), **{field: value}), "a", "b")


def test_a_split_reads_in_order_through_pickle_and_by_slice(tmp_path):
    source = EpisodeSource(split(tmp_path / "train", episodes=5))
    names = [f"episode-{i}" for i in range(5)]
    assert [episode.name for episode in source] == names
    assert [e.name for e in pickle.loads(pickle.dumps(source))] == names
    assert [e.name for e in source[1:4]] == names[1:4]
    assert source[-1].name == "episode-4"
    assert source.where(4).endswith("shard-00001-of-00002.array_record, record 2")
    with pytest.raises(IndexError):
        source[5]


def test_an_empty_image_is_named():
    episode = read_episode(write_episode(arrays(), "a", "b"))
    spans = list(episode.header["streams"]["depth"]["spans"])
    spans[3] = (spans[3][0], 0)
    streams = {**episode.header["streams"], "depth": {"codec": "png", "spans": spans}}
    damaged = dataclasses.replace(episode, header={**episode.header, "streams": streams})
    with pytest.raises(UserError, match="episode a, frame 3, depth: the image does not decode"):
        damaged.frames()


def test_a_disk_that_is_full_ends_in_one_sentence(tmp_path):
    record = write_episode(arrays(), "a", "b")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(record) // 2, before[1]))
    try:
        with pytest.raises(UserError, match=r"s\.array_record cannot be written .* MB are free"):
            write_shard(tmp_path / "s.array_record", [record] * 3)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


def test_an_unfinished_split_is_not_read(tmp_path):
    folder = split(tmp_path / "train")
    with pytest.raises(UserError, match="contains the splits train"):
        EpisodeSource(tmp_path)
    (folder / "dataset.json").unlink()
    with pytest.raises(UserError, match="did not finish"):
        EpisodeSource(folder)
    with pytest.raises(UserError, match="does not exist"):
        EpisodeSource(tmp_path / "nowhere")


def test_a_truncated_shard_is_named(tmp_path):
    folder = split(tmp_path / "train")
    shard = folder / "shard-00001-of-00002.array_record"
    shard.write_bytes(shard.read_bytes()[:-1])
    with pytest.raises(UserError, match=r"shard-00001-of-00002.array_record has .* truncated"):
        EpisodeSource(folder)
    shard.unlink()
    with pytest.raises(UserError, match=r"shard-00001-of-00002.array_record is missing"):
        EpisodeSource(folder)


def test_a_changed_byte_is_noticed_when_read(tmp_path):
    folder = split(tmp_path / "train", episodes=2, shards=1)
    shard = folder / "shard-00000-of-00001.array_record"
    content = bytearray(shard.read_bytes())
    where = content.index(b"PEWMEPIS") + 4000
    content[where] ^= 1
    shard.write_bytes(content)
    with pytest.raises(UserError, match="record 0 cannot be read"):
        EpisodeSource(folder)[0]


def test_a_manifest_that_does_not_parse_is_refused(tmp_path):
    folder = split(tmp_path / "train")
    (folder / "dataset.json").write_text('{"format": ')
    with pytest.raises(UserError, match="does not parse"):
        EpisodeSource(folder)


def test_a_shard_is_whole_or_absent(tmp_path):
    def broken():
        yield b"first"
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_shard(tmp_path / "x.array_record", broken())
    assert list(tmp_path.iterdir()) == []
    write_shard(tmp_path / "x.array_record", [b"first", b"second"])
    write_shard(tmp_path / "y.array_record", iter([b"first", b"second"]))
    one, two = (
        describe_shard(tmp_path / "x.array_record"),
        describe_shard(tmp_path / "y.array_record"),
    )
    assert (one.records, one.sha256) == (2, two.sha256)


@pytest.mark.parametrize("content", [b"", b"hello", b"\0" * 70000])
def test_what_is_no_array_record_is_refused(tmp_path, content):
    path = tmp_path / "x.array_record"
    path.write_bytes(content)
    with pytest.raises(UserError, match="truncated or damaged"):
        count_records(path)
