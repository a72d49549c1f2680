"""The protocol's file: its hash follows from the choices alone, and it is found in any data set."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from pewm_jax import presets
from pewm_jax.config import ConfigError, UserError
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.episodes import read_episode
from pewm_jax.eval import loaded_run
from pewm_jax.eval import protocol as protocols
from pewm_jax.eval.clips import choose, fingerprint, long_choices
from tests.eval.scene import record, tiny, write_split


@pytest.fixture(scope="module")
def episodes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "revisit"
    return EpisodeSource(write_split(folder, episodes=3))


def protocol(config, episodes):
    return protocols.make_protocol(config, episodes, *protocols.choose_clips(config, episodes))


def test_it_finds_the_clips_that_it_was_made_of(episodes, tmp_path):
    config = tiny(tmp_path)
    made = protocol(config, episodes)
    clips, rollouts = protocols.find_clips(made, episodes, "data")
    assert clips == choose(config, episodes, 4, 1)
    assert rollouts == long_choices(config, episodes)
    assert (made.horizon, made.long_horizon, made.control) == (4, 8, "actions")
    # In another order and among others, the same clips of the same episodes.
    mixed = [read_episode(record(7)), *(episodes[i] for i in (2, 0, 1))]
    moved, _ = protocols.find_clips(made, mixed, "data")
    assert [clip.name for clip in moved] == [clip.name for clip in clips]
    assert [mixed[clip.episode].name for clip in moved] == [clip.name for clip in clips]


def test_every_choice_changes_the_hash(episodes, tmp_path):
    config = tiny(tmp_path)
    base = protocol(config, episodes)

    def with_(**changes):
        return dataclasses.replace(config, evaluate=dataclasses.replace(config.evaluate, **changes))

    settings = [
        with_(clips=3),
        with_(seeds=(0, 2)),
        with_(chain=2),
        with_(stride=2),
        with_(video_clips=1),
        with_(split="validation"),
        dataclasses.replace(config, data=dataclasses.replace(config.data, context=5)),
    ]
    others = [protocol(changed, episodes) for changed in settings]
    first = base.clips[0]
    later = dataclasses.replace(first, start=first.start + 1)
    others += [
        dataclasses.replace(base, control="cameras"),
        dataclasses.replace(base, clips=(later, *base.clips[1:])),
        dataclasses.replace(base, clips=base.clips[::-1]),
        dataclasses.replace(base, rollouts=base.rollouts[:1]),
        dataclasses.replace(base, scoring=base.scoring + 1),
    ]
    assert len({item.sha256 for item in (base, *others)}) == 1 + len(others)
    assert all(protocols.difference(base, other) for other in others)
    assert {item.pieces_sha256 for item in (base, others[1])} == {base.pieces_sha256}
    assert others[0].pieces_sha256 != base.pieces_sha256


def test_rollouts_shorter_than_asked_are_said(episodes, tmp_path):
    config = tiny(tmp_path)
    made = protocol(config, episodes)
    assert protocols.describe_shortened(config, made) == ""
    more = dataclasses.replace(config.evaluate, video_clips=1000)
    asked = dataclasses.replace(config, evaluate=more)
    again = protocol(asked, episodes)
    assert f"have {again.long_horizon} frames instead of the " in protocols.describe_shortened(
        asked, again
    )


def test_what_is_not_chosen_does_not_change_the_hash(episodes, tmp_path):
    config = tiny(tmp_path)
    evaluate = dataclasses.replace(config.evaluate, batch=3, videos=2, lpips="off", none="runs/x")
    other = dataclasses.replace(config, evaluate=evaluate).with_model(
        noise=dataclasses.replace(config.model.noise, sample_steps=7)
    )
    copy = [episodes[index] for index in range(3)]
    assert protocol(other, copy).sha256 == protocol(config, episodes).sha256
    assert protocols.difference(protocol(other, copy), protocol(config, episodes)) == ""


def test_the_content_of_an_episode_is_part_of_it(episodes, tmp_path):
    config = tiny(tmp_path)
    made = protocol(config, episodes)
    changed = list(episodes)
    last = read_episode(record(2, nod=0.2))
    changed[2] = last
    assert protocol(config, changed).sha256 != made.sha256
    with pytest.raises(UserError, match="has another one of that name"):
        protocols.find_clips(made, changed, "data/mine")
    with pytest.raises(UserError, match=r"room-0/revisit .*does not have it; give the folder"):
        protocols.find_clips(made, changed[1:], "data/mine")


def test_motion_is_that_between_start_and_targets(episodes, tmp_path):
    choice = choose(tiny(tmp_path), episodes, 1, 1)[0]
    episode = episodes[choice.episode]
    base = protocols.motion_hash(episode, choice)
    for where, same in ((choice.start, False), (choice.targets_N[-1], True), (0, True)):
        actions = episode.actions.copy()
        actions[where] += 0.01
        moved = dataclasses.replace(episode, actions=actions)
        assert (protocols.motion_hash(moved, choice) == base) == same
    poses = np.array(episode.world_from_camera)
    poses[choice.targets_N[1], 0, 3] += 0.01
    assert (
        protocols.motion_hash(dataclasses.replace(episode, world_from_camera=poses), choice) != base
    )


def test_a_file_gives_back_what_was_written(episodes, tmp_path):
    made = protocol(tiny(tmp_path), episodes)
    path = tmp_path / "kept" / "protocol.json"
    protocols.save_protocol(path, made, {"data": "somewhere"})
    assert protocols.load_protocol(path) == made
    assert protocols.load_protocol(path).sha256 == json.loads(path.read_text())["sha256"]
    value = json.loads(path.read_text())
    value["notes"] = {}
    path.write_text(json.dumps(dict(reversed(value.items()))))
    assert protocols.load_protocol(path).sha256 == made.sha256


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda value: value["protocol"]["clips"].pop(), "was changed after it was written"),
        (lambda value: value["protocol"].update(seeds=[9]), "was changed after it was written"),
        (lambda value: value.update(version=9), "versions 9 .file."),
        (lambda value: value["protocol"].update(scoring=1), "and 1 .scoring."),
        (lambda value: value.update(format="other"), "is not a protocol"),
        (lambda value: value.pop("protocol"), "is not a protocol"),
        (lambda value: value.update(protocol=[]), "is not a protocol"),
    ],
)
def test_a_file_that_cannot_be_trusted_is_refused(episodes, tmp_path, change, said):
    path = tmp_path / "protocol.json"
    protocols.save_protocol(path, protocol(tiny(tmp_path), episodes), {})
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))
    with pytest.raises(UserError, match=said):
        protocols.load_protocol(path)


def test_a_file_that_is_absent_or_no_json_is_refused(tmp_path):
    with pytest.raises(UserError, match="cannot be read"):
        protocols.load_protocol(tmp_path / "gone.json")
    (tmp_path / "x.json").write_text("{")
    with pytest.raises(UserError, match="is not JSON"):
        protocols.load_protocol(tmp_path / "x.json")


@pytest.mark.parametrize(
    ("path", "said"),
    [("/dev/zero", "is not a regular file"), ("/dev/full", "is not a regular"), (".", "a folder")],
)
def test_what_is_no_file_is_refused_unread(path, said):
    """A device may have no end."""
    with pytest.raises(UserError, match=said):
        protocols.load_protocol(Path(path))


def test_it_stands_above_the_settings(episodes, tmp_path):
    made = protocol(tiny(tmp_path, seeds=(3, 4), chain=2, clips=3), episodes)
    path = tmp_path / "protocol.json"
    protocols.save_protocol(path, made, {})
    plain = tiny(tmp_path)
    named = dataclasses.replace(
        plain, evaluate=dataclasses.replace(plain.evaluate, protocol=str(path))
    )
    config, found = protocols.apply_protocol_file(named, {"clips": None})
    assert found == made
    settings = config.evaluate
    assert (settings.seeds, settings.chain, settings.clips) == ((3, 4), 2, 3)
    assert protocol(config, episodes) == made
    assert protocols.apply_protocol_file(named, {"split": "theirs"})[0].evaluate.split == "theirs"
    assert protocols.apply_protocol_file(plain, {}) == (plain, None)
    off = dataclasses.replace(plain, evaluate=dataclasses.replace(plain.evaluate, protocol="off"))
    assert protocols.apply_protocol_file(off, {"clips": 2})[1] is None
    with pytest.raises(ConfigError, match="--clips and --seeds cannot be combined with"):
        protocols.apply_protocol_file(named, {"clips": 2, "seeds": (1,)})
    longer = named.with_model(clip=dataclasses.replace(plain.model.clip, frames=13))
    with pytest.raises(UserError, match="8 imagined frames but this model imagines 12 at once"):
        protocols.apply_protocol_file(longer, {})
    taller = named.with_model(clip=dataclasses.replace(plain.model.clip, height=32))
    with pytest.raises(UserError, match="16×16 but this model makes 32×16"):
        protocols.apply_protocol_file(taller, {})


def test_another_protocol_is_not_written_over(episodes, tmp_path):
    config = tiny(tmp_path)
    config = dataclasses.replace(
        config, data=dataclasses.replace(config.data, path=str(episodes.path.parent))
    )
    path, said = tmp_path / "protocol.json", []
    made = protocols.write_protocol(config, path, said.append)
    assert made.sha256 in said[-1]
    before = path.stat().st_mtime_ns
    protocols.write_protocol(config, path, said.append)
    assert path.stat().st_mtime_ns == before
    assert "already contains this protocol" in said[-2]
    fewer = dataclasses.replace(config, evaluate=dataclasses.replace(config.evaluate, clips=2))
    with pytest.raises(UserError, match=r"another protocol \(4 and 2 clips\)"):
        protocols.write_protocol(fewer, path, said.append)


def test_reports_of_8_bit_weights_have_a_folder_and_a_fingerprint_of_their_own():
    config = presets.load("tiny")
    small = dataclasses.replace(
        config, evaluate=dataclasses.replace(config.evaluate, quantize="int8")
    )
    run = loaded_run.LoadedRun(Path("run"), Path("run"), config, {}, "hash")
    assert loaded_run.report_folder(run, config) == Path("run/report")
    assert loaded_run.report_folder(run, small) == Path("run/report-int8")
    assert fingerprint(config, "hash", "data") != fingerprint(small, "hash", "data")
