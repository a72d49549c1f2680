"""The baseline without a network: what was seen is shown again, and its settings are chosen."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

from pewm_jax.config import ConfigError
from pewm_jax.data.dataset import MANIFEST
from pewm_jax.data.episodes import read_episode
from pewm_jax.eval import reproject as baseline
from pewm_jax.eval.metrics.images import unit_colours
from pewm_jax.eval.reproject import CANDIDATES, ReprojectSettings, draw, reproject, reproject_batch
from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw
from pewm_jax.io.store import ResultCache, file_hash
from pewm_jax.types import Camera, Frames
from tests.eval.scene import look, record, tiny, write_split


@pytest.fixture(scope="module")
def seen():
    """Frames of an episode that looks all around."""
    return read_episode(record(0, size=24)).frames(range(14))


def some(frames, rows):
    return jax.tree.map(lambda leaf: leaf[np.asarray(rows)], frames)


@pytest.mark.parametrize("settings", CANDIDATES, ids=lambda settings: settings.name)
def test_the_camera_that_saw_it_sees_it_again(seen, settings):
    one, number = some(seen, [3]), np.arange(len(seen.depth_THW))
    alone = dataclasses.replace(seen, depth_THW=seen.depth_THW * (number == 3)[:, None, None])
    made = reproject(settings, alone, one.camera)
    colours = np.asarray(unit_colours(one.rgb_THWC))
    tolerance = 0.08 if settings.footprint > 1 and settings.width > 1 else 1e-3
    off = np.abs(np.asarray(unit_colours(made.rgb_THWC)) - colours)
    assert np.quantile(off, 0.9) < tolerance
    np.testing.assert_allclose(np.median(made.depth_THW / one.depth_THW), 1, atol=1e-3)


@pytest.mark.parametrize("settings", CANDIDATES, ids=lambda settings: settings.name)
def test_another_camera_sees_the_room_that_was_seen(seen, settings):
    pose = pose_from_yaw(np.array([-0.3, 0.15, 1.25]), 0.8)
    intrinsics = intrinsics_from_fov(24, 24, 90.0)
    colour, depth = look(pose, intrinsics, size=24)
    camera = Camera(np.asarray(intrinsics)[None], np.asarray(pose)[None])
    made = reproject(settings, seen, camera)
    assert np.median(np.abs(np.asarray(made.depth_THW[0]) - depth)) < 0.08
    assert np.median(np.abs((np.asarray(made.rgb_THWC[0]) + 1) / 2 - colour)) < 0.06


@pytest.mark.slow
def test_a_wall_seen_from_behind_is_not_shown_and_hides_what_is_behind_it():
    """A red wall, seen from its other side; beyond it, a green one, seen from its front."""
    intrinsics = np.array([[12.0, 12.0, 12.0, 12.0]] * 2)
    ahead, there = pose_from_yaw(np.zeros(3), 0.0), pose_from_yaw(np.array([3.0, 0, 0]), np.pi)
    depth = np.stack([np.full((24, 24), 4.0), np.full((24, 24), 5.0)])
    depth[0, :, :12] = 0  # of the red one half was seen
    colour = np.stack([np.full((24, 24, 3), [1.0, -1, -1]), np.full((24, 24, 3), [-1.0, 1, -1])])
    context = Frames(colour, depth, Camera(intrinsics, np.stack([ahead, there])))
    back = np.asarray(pose_from_yaw(np.array([6.0, 0.0, 0.0]), np.pi))[None]
    camera = Camera(intrinsics[:1], back)

    def green(settings, context):
        points = draw(settings, context, camera)
        return np.asarray(points.seen_THW & (points.features_THWF[..., 1] > 0.5))

    alone = jax.tree.map(lambda x: x[1:], context)
    for backs in (True, False):
        settings = ReprojectSettings(footprint=3, backs=backs)
        red = np.asarray(draw(settings, context, camera).features_THWF[..., 0] > 0.5)
        assert red.any() == backs  # shown from behind, or not
        hidden = green(settings, alone) & ~green(settings, context)
        assert 0.2 < hidden.sum() / green(settings, alone).sum() < 0.8  # by its half


@pytest.mark.slow
def test_frames_without_depth_do_not_count(seen):
    blank = some(seen, [0, 1])
    blank = Frames(blank.rgb_THWC * 0, blank.depth_THW * 0, blank.camera)
    padded = jax.tree.map(lambda a, b: np.concatenate([a, b]), some(seen, [2, 3]), blank)
    alone = reproject(ReprojectSettings(), some(seen, [2, 3]), seen.camera)
    both = reproject(ReprojectSettings(), padded, seen.camera)
    np.testing.assert_allclose(alone.rgb_THWC, both.rgb_THWC, atol=1e-6)
    nothing = reproject(ReprojectSettings(), blank, blank.camera)
    assert not np.asarray(nothing.depth_THW).any()


def test_a_batch_is_its_clips(seen):
    context, target = some(seen, [[0, 1, 2], [5, 6, 7]]), some(seen, [[3, 4], [8, 9]])
    made = reproject_batch(ReprojectSettings(), context, target.camera)
    assert made.rgb_THWC.shape == (2, 2, 24, 24, 3)
    for row in range(2):
        one = jax.tree.map(lambda leaf, row=row: leaf[row], (context, target.camera))
        single = reproject(ReprojectSettings(), *one)
        np.testing.assert_allclose(made.rgb_THWC[row], single.rgb_THWC, atol=1e-3)


def test_settings_have_distinct_names_and_are_checked():
    assert len({item.name for item in CANDIDATES}) == len({str(item) for item in CANDIDATES}) == 8
    assert CANDIDATES[0] == ReprojectSettings(average=False)  # the plain z-buffer is among them
    with pytest.raises(ConfigError, match="footprint is 0"):
        ReprojectSettings(footprint=0)


@pytest.mark.slow
def test_the_best_on_validation_is_taken_and_kept(tmp_path, monkeypatch):
    config = tiny(tmp_path)
    write_split(tmp_path / "data" / "validation", episodes=2)
    partials, said = ResultCache.for_weights(tmp_path / "partial", "e" * 64, "f" * 64), []
    found = baseline.choose_settings(config, partials, said.append)
    assert len(said) == 1, found.why
    assert found.scores[found.settings.name] == max(found.scores.values())
    assert len(found.scores) == len(CANDIDATES)
    assert found.clips == baseline.CLIPS
    facts = found.facts()
    assert facts["split"] == "validation"
    assert facts["chosen"] in [item["settings"] for item in facts["candidates"]]
    assert facts["dataset_sha256"] == file_hash(tmp_path / "data" / "validation" / MANIFEST)
    monkeypatch.setattr(baseline, "_score", None)
    assert baseline.choose_settings(config, partials, said.append) == found
    assert len(said) == 1


def test_without_fitting_validation_data_the_default_is_taken_and_said(tmp_path):
    partials = ResultCache.for_weights(tmp_path / "partial", "e" * 64, "f" * 64)
    found = baseline.choose_settings(tiny(tmp_path), partials, print)
    assert found.settings == ReprojectSettings()
    assert "does not exist" in found.why
    assert (found.facts()["split"], found.facts()["dataset_sha256"]) == (None, "")
    write_split(tmp_path / "data" / "validation", episodes=1, size=24)
    found = baseline.choose_settings(tiny(tmp_path), partials, print)
    assert (found.settings, found.scores) == (ReprojectSettings(), {})
    assert "24×24" in found.why


def test_other_clips_are_other_scores(tmp_path):
    config = tiny(tmp_path)
    more = dataclasses.replace(config, data=dataclasses.replace(config.data, context=7))
    assert baseline._piece(config, "a") != baseline._piece(config, "b")
    assert baseline._piece(config, "a") != baseline._piece(more, "a")
