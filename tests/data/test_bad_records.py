"""Records that do not decode: named, counted, done without; batch k stays the same batch k."""

from __future__ import annotations

import itertools

import jax
import numpy as np
import pytest

from pewm_jax.config import ClipConfig, Config, DataConfig, UserError
from pewm_jax.data import loader
from pewm_jax.data.dataset import (
    EpisodeSource,
    Manifest,
    describe_shard,
    read_manifest,
    write_manifest,
    write_shard,
)
from pewm_jax.data.episodes import read_episode
from pewm_jax.data.loader import BadRecords
from pewm_jax.worlds.pewm.world import PEWM
from tests.data.two_rooms import split

SHARD = "shard-00000-of-00002.array_record"


def config(root, **data):
    return Config(
        model=PEWM(clip=ClipConfig(frames=5, height=16, width=16)),
        data=DataConfig(path=str(root), **{"stride_max": 3, "context": 6, **data}),
    )


def flip(folder, record, stream="rgb", frame=4):
    """Change one byte of a record where it lies in its shard, whose size stays the same."""
    path = folder / SHARD
    before, held = EpisodeSource(folder)[record].record, path.read_bytes()
    episode = read_episode(before)
    offset, size = episode.header["streams"][stream]["spans"][frame]
    place = held.index(before) + offset + size // 2
    path.write_bytes(held[:place] + bytes([held[place] ^ 1]) + held[place + 1 :])


def cut_short(folder, record):
    """Write a shard again in which every picture of one record ends in zeros, as a whole file."""
    episodes = [one.record for one in EpisodeSource(folder)[:3]]
    damaged = bytearray(episodes[record])
    for offset, size in read_episode(episodes[record]).header["streams"]["rgb"]["spans"]:
        damaged[offset + size // 2 : offset + size] = bytes(size - size // 2)
    episodes[record] = bytes(damaged)
    write_shard(folder / SHARD, episodes)
    old = read_manifest(folder, check_files=False)
    shards = (describe_shard(folder / SHARD), *old.shards[1:])
    write_manifest(folder, Manifest(old.split, shards, old.settings, old.frames))


@pytest.fixture
def folder(tmp_path):
    return split(tmp_path / "train", episodes=6, frames=24)


def first(count, *args, **kwargs):
    return list(itertools.islice(loader.clips(*args, **kwargs), count))


def same(one, two):
    return jax.tree.all(jax.tree.map(np.array_equal, one, two))


@pytest.mark.parametrize("damage", [flip, cut_short])
def test_a_damaged_record_is_named_once_and_another_clip_comes_in_its_place(folder, damage):
    whole = first(6, config(folder.parent), seed=1, batch=4)
    damage(folder, 1)
    said = []
    bad = BadRecords(1, said.append)
    batches = first(6, config(folder.parent), seed=1, batch=4, bad=bad)
    assert bad.names == (f"train/{SHARD} record 1",)
    (line,) = said
    assert line.startswith(f"bad record 1 of 1 allowed, skipped: train/{SHARD} record 1: ")
    changed = 0
    for before, now in zip(whole, batches, strict=True):
        for row in range(4):
            one, two = (jax.tree.map(lambda x, row=row: x[row], b) for b in (before, now))
            changed += not same(one, two)
    assert changed == 4  # 24 clips of 6 episodes


def test_replacements_depend_on_nothing_but_the_place(folder):
    flip(folder, 0)
    flip(folder, 2)
    allowed = config(folder.parent, bad_records=2)
    batches = first(6, allowed, seed=1, batch=4)
    assert same(first(1, allowed, seed=1, batch=4, start_step=5)[0], batches[5])
    threads = config(folder.parent, bad_records=2, workers=3)
    assert all(same(a, b) for a, b in zip(first(6, threads, seed=1, batch=4), batches, strict=True))


def test_beyond_the_budget_training_stops_with_their_names(folder):
    flip(folder, 1)
    with pytest.raises(UserError, match=r"record 1 cannot be read .* with --data\.bad_records 1\."):
        first(6, config(folder.parent), seed=1, batch=4)
    flip(folder, 2)
    with pytest.raises(UserError, match=r"2 records do not decode and .* allows 1: ") as refused:
        first(12, config(folder.parent, bad_records=1), seed=1, batch=4)
    for record in (1, 2):
        assert f"train/{SHARD} record {record}" in str(refused.value)


def test_data_of_which_nothing_decodes_are_refused(tmp_path):
    folder = split(tmp_path / "train", episodes=2, frames=24)
    for shard in folder.glob("*.array_record"):
        held = shard.read_bytes()
        at = held.index(b"PEWMEPIS")
        shard.write_bytes(held[:at] + b"X" + held[at + 1 :])
    with pytest.raises(UserError, match="none of its records"):
        loader.clips(config(tmp_path, bad_records=9), seed=1, batch=2)


def test_records_that_all_fail_in_their_pictures_are_refused_without_looping(tmp_path):
    folder = split(tmp_path / "train", episodes=3, shards=1, frames=24)
    (folder / "shard-00000-of-00001.array_record").rename(folder / SHARD)
    old = read_manifest(folder, check_files=False)
    write_manifest(folder, Manifest("train", (describe_shard(folder / SHARD),), {}, old.frames))
    for record in range(3):
        cut_short(folder, record)
    with pytest.raises(UserError, match="none of its 3 records decodes"):
        first(1, config(tmp_path, bad_records=9), seed=1, batch=2)


def test_a_batch_names_the_clips_that_it_was_made_of(folder):
    flip(folder, 1)
    allowed = config(folder.parent, bad_records=1)
    source = EpisodeSource(folder)
    for step, batch in enumerate(first(4, allowed, seed=1, batch=4)):
        names = loader.records(allowed, seed=1, batch=4, step=step)
        for row, name in enumerate(names):
            place, _, frames = name.partition(" (episode ")
            shard, record = place.split(" record ")
            number = 3 * ("00001-of" in shard) + int(record)
            episode, _, frames = frames.partition(") frames ")
            assert episode == f"episode-{number}" == source[number].name
            start, _, rest = frames.partition("–")
            end, _, stride = rest.partition(" by ")
            chosen = slice(int(start), int(end) + 1, int(stride or 1))
            np.testing.assert_array_equal(
                batch.frames.camera.world_from_camera[row], source[number].world_from_camera[chosen]
            )
