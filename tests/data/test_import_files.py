"""An import that is interrupted goes on, and shows nothing before it is complete."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from pewm_jax.config import UserError
from pewm_jax.data import dataset
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.formats import seven_scenes
from pewm_jax.data.import_files import PIXELS, plan
from pewm_jax.data.importer import ImportConfig, import_recording
from tests.data import layouts

FOCAL = (52.5, 52.5, 32, 24)


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    walk = layouts.hand_held(23, focal=FOCAL)
    return layouts.seven_scenes(tmp_path_factory.mktemp("scan") / "chess", walk), walk


def config(scan, out, **options):
    return ImportConfig(scan[0], out, format="7scenes", **{"episode_frames": 8, **options})


def quiet(_):
    """Print nothing."""


def test_a_long_sequence_becomes_episodes_of_almost_equal_length(tmp_path, scan):
    import_recording(config(scan, tmp_path), quiet)
    source = EpisodeSource(tmp_path / "train")
    assert [episode.length for episode in source] == [7, 8, 8]
    assert [episode.name for episode in source] == [f"chess/part-00{k}" for k in range(3)]
    assert {episode.scene for episode in source} == {"chess"}
    poses = np.concatenate([episode.world_from_camera for episode in source])
    np.testing.assert_allclose(poses, scan[1].pose, atol=1e-4)
    assert source.manifest.frames == 23


def killed_after(monkeypatch, files):
    """Interrupt the import after some files are written; count those that are."""
    real, made = dataset.write_shard, []

    def write(path, records):
        if len(made) == files:
            raise KeyboardInterrupt
        made.append(path.name)
        return real(path, records)

    monkeypatch.setattr(dataset, "write_shard", write)
    return made


def test_a_killed_import_is_not_shown_and_goes_on(tmp_path, scan, monkeypatch):
    import_recording(config(scan, tmp_path / "whole"), quiet)
    with monkeypatch.context() as patch:
        killed_after(patch, 2)
        with pytest.raises(KeyboardInterrupt):
            import_recording(config(scan, tmp_path / "out"), quiet)
    with pytest.raises(UserError, match=r"no dataset\.json"):
        EpisodeSource(tmp_path / "out" / "train")
    with monkeypatch.context() as patch:
        made = killed_after(patch, 9)
        import_recording(config(scan, tmp_path / "out"), quiet)
        assert made == ["recording-chess-00002-of-00003.array_record"]
    for path in (tmp_path / "whole" / "train").iterdir():
        assert path.read_bytes() == (tmp_path / "out" / "train" / path.name).read_bytes()


def test_other_settings_or_a_damaged_file_are_made_again(tmp_path, scan, monkeypatch):
    for damage in (False, True):
        out = tmp_path / str(damage)
        with monkeypatch.context() as patch:
            killed_after(patch, 2)
            with pytest.raises(KeyboardInterrupt):
                import_recording(config(scan, out), quiet)
        first = min((out / "train").iterdir())
        if damage:
            first.write_bytes(first.read_bytes()[:-9])
        with monkeypatch.context() as patch:
            made = killed_after(patch, 9)
            import_recording(config(scan, out, **({} if damage else {"max_depth": 3.0})), quiet)
        assert len(made) == (2 if damage else 3)
        assert len(EpisodeSource(out / "train")) == 3


def test_a_part_of_another_killed_import_is_not_taken_for_whole(tmp_path, scan, monkeypatch):
    with monkeypatch.context() as patch:
        killed_after(patch, 2)
        with pytest.raises(KeyboardInterrupt):
            import_recording(config(scan, tmp_path, name="a"), quiet)
    import_recording(config(scan, tmp_path, name="b"), quiet)
    assert {episode.scene for episode in EpisodeSource(tmp_path / "train")} == {"b"}
    import_recording(config(scan, tmp_path, name="a"), quiet)
    assert {episode.scene for episode in EpisodeSource(tmp_path / "train")} == {"a", "b"}


def test_replacing_removes_the_files_of_the_former_import(tmp_path, scan):
    import_recording(config(scan, tmp_path), quiet)
    with pytest.raises(UserError, match="already has an episode named chess"):
        import_recording(config(scan, tmp_path), quiet)
    import_recording(config(scan, tmp_path, overwrite=True, episode_frames=100), quiet)
    files = [path.name for path in (tmp_path / "train").glob("*.array_record")]
    assert files == ["recording-chess.array_record"]
    assert [episode.length for episode in EpisodeSource(tmp_path / "train")] == [23]


def test_a_refused_import_leaves_a_split_as_it_was(tmp_path, scan):
    import_recording(config(scan, tmp_path, name="a"), quiet)
    before = (tmp_path / "train" / dataset.MANIFEST).read_bytes()
    with pytest.raises(UserError, match="unit is wrong"):
        import_recording(config(scan, tmp_path, name="b", depth_scale=10.0), quiet)
    assert (tmp_path / "train" / dataset.MANIFEST).read_bytes() == before
    assert len(EpisodeSource(tmp_path / "train")) == 3


def test_colours_of_7scenes_may_be_jpeg(tmp_path):
    src = layouts.seven_scenes(tmp_path / "src", layouts.hand_held(3, focal=FOCAL))
    for file in sorted(src.rglob("*.color.png")):
        assert cv2.imwrite(str(file.with_suffix(".jpg")), cv2.imread(str(file)))
        file.unlink()
    import_recording(ImportConfig(src, tmp_path / "out", format="auto"), quiet)
    assert EpisodeSource(tmp_path / "out" / "train")[0].length == 3


def test_short_sequences_share_files_and_large_pictures_make_short_episodes(tmp_path):
    walk = layouts.hand_held(5, focal=FOCAL)
    for k in range(4):
        layouts.seven_scenes(tmp_path / "src", walk, f"seq-{k:02d}")
    options = ImportConfig(tmp_path / "src", tmp_path / "out", format="7scenes")
    import_recording(options, quiet)
    source = EpisodeSource(tmp_path / "out" / "train")
    assert len(source.manifest.shards) == 1
    assert len(source) == 4
    wide = ImportConfig(tmp_path / "src", tmp_path, format="7scenes", size=(4000, 3000))
    entry = seven_scenes.SevenScenes().entries(wide)[0]
    parts = plan([dataclasses.replace(entry, frames=100)], wide)
    longest = max(len(part.frames) for group in parts.values() for part in group)
    assert longest <= max(16, PIXELS // (4000 * 3000))
