"""The mirror test, and the features of whole clips, of a model that knows the room."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pewm_jax.config import ConfigError, UserError
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.eval import mirror, results, runner
from pewm_jax.eval.clips import long_choices
from pewm_jax.eval.long_rollouts import LongRollouts
from pewm_jax.eval.metrics import VideoDistance, selection
from pewm_jax.eval.reproject import ReprojectSettings
from pewm_jax.eval.runner import Methods, ModelRunner
from pewm_jax.eval.scoring import Scored, score_table
from pewm_jax.geometry.actions import integrate
from pewm_jax.io.store import ResultCache
from pewm_jax.models.i3d import convert as i3d_weights
from pewm_jax.report.labels import format_fvd
from tests.eval.scene import knowing_rollout, tiny, write_split

SAMPLED = {"memory", "empty"}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Settings, episodes and a model that knows them, compiled once."""
    folder = tmp_path_factory.mktemp("scene")
    config = tiny(folder, mirror=8, clips=4)
    episodes = EpisodeSource(write_split(folder / "data" / "revisit", episodes=3))
    params = {"offset": np.float32(0)}
    model = ModelRunner(config, params, 2, config.data.context, lambda _: None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "rollout", knowing_rollout)
        model.prepare([True, False])
    return config, episodes, Methods(model, ReprojectSettings())


@pytest.mark.slow
def test_who_knows_the_way_comes_back_to_what_was_left(scene, tmp_path, monkeypatch):
    config, episodes, methods = scene
    partials, rollouts = (
        ResultCache.for_weights(tmp_path, "e" * 64, "f" * 64),
        long_choices(config, episodes),
    )
    visits = selection.select_revisits(("off",), None, 16, 16)[0]
    back = mirror.mirror_test(config, episodes, methods, partials, rollouts, visits, print)
    assert back.distances == [2, 4, 6, 8, 10, 12, 14, 16]
    assert set(back.pairs) == SAMPLED
    for pair in mirror.PAIRS:
        known = back.pairs["memory"][pair]
        assert known.shape == (3, 8)
        assert np.nanmin(known) > 45  # only the rounding of the observed frame and of poses
        assert np.nanmax(back.pairs["empty"][pair]) < 20
    assert np.isnan(back.pairs["memory"]["out"]).sum(0).tolist() == [0] * 7 + [3]
    assert set(back.values["memory"]) == {"mirror[psnr]", "mirror[ssim]"}
    np.testing.assert_allclose(back.values["truth"]["mirror[psnr]"], 100)
    assert (back.values["memory"]["mirror[psnr]"] > 45).all()
    assert (back.floor["mirror[psnr]"] < 30).all()
    assert (back.values["empty"]["mirror[psnr]"] < 10).all()

    found = mirror.facts(back)
    assert len(found["by_distance"]["memory"]["again"]["mean"]) == 8
    assert found["margins"]["empty"]["again"]["low"][0] > 20
    assert found["ceiling"]["mirror[psnr]"]["mean"] == pytest.approx(100)
    monkeypatch.setattr(ModelRunner, "run", None)
    again = mirror.mirror_test(config, episodes, methods, partials, rollouts, visits, print)
    assert mirror.facts(again) == found


@pytest.mark.parametrize("cameras", [False, True])
def test_the_way_back_leads_through_the_same_places(scene, cameras):
    config, episodes, _ = scene
    choice = long_choices(config, episodes)[0]
    batch = mirror._there_and_back(config, episodes, [choice] * 2, 0, cameras)
    poses = np.asarray(batch.targets.camera.world_from_camera[0])
    present = np.asarray(batch.context.camera.world_from_camera[0, -1:])
    whole = np.concatenate([present, poses])
    np.testing.assert_array_equal(whole, whole[::-1])
    assert np.abs(np.diff(whole, axis=0)).max() > 0.1
    rgb = np.asarray(batch.targets.rgb_THWC[0])
    np.testing.assert_array_equal(rgb[:-1], rgb[:-1][::-1])
    if cameras:
        driven = batch.control.world_from_camera[0]
    else:
        driven = np.asarray(integrate(whole[0], batch.control[0]))[1:]
    np.testing.assert_allclose(driven, poses, atol=1e-3)


def test_the_mirror_test_is_there_where_rollouts_are_long_or_it_is_asked_for(scene):
    config, episodes, _ = scene

    def way(asked, frames=8):
        rollouts = [dataclasses.replace(long_choices(config, episodes)[0], targets_N=(1,) * frames)]
        evaluate = dataclasses.replace(config.evaluate, mirror=asked)
        return mirror.way_out(dataclasses.replace(config, evaluate=evaluate), rollouts)

    assert way(-1)[0] == 0
    assert "8 frames, fewer than 64" in way(-1)[1]
    assert way(-1, 64)[0] == way(-1, 112)[0] == 32
    assert way(0, 64) == (0, "The mirror test is disabled (evaluate.mirror).")
    assert [way(asked)[0] for asked in (8, 7, 99)] == [8, 6, 8]  # whole clips of 4
    assert "do not fill a clip" in way(1)[1]
    with pytest.raises(ConfigError, match=r"evaluate\.mirror is -2"):
        tiny(Path("unused"), mirror=-2)


class Colours(VideoDistance):
    """FVD of mean colours by frame; what a clip is made of is counted."""

    def features(self, video_BTHWC):
        """Return the mean colour of every frame, in a space of more than the clips are."""
        return np.asarray(video_BTHWC).mean((2, 3)).reshape(len(video_BTHWC), -1)


@pytest.mark.slow
def test_videos_are_compared_as_wholes_and_their_features_kept(scene, tmp_path, monkeypatch):
    config, episodes, methods = scene
    i3d, partials = (
        Colours("fvd", {}, "c" * 64),
        ResultCache.for_weights(tmp_path, "e" * 64, "f" * 64),
    )
    plain = score_table(config, episodes, methods, partials, print)
    assert plain.features == {}
    calls, run = [], ModelRunner.run
    monkeypatch.setattr(
        ModelRunner, "run", lambda *args, **named: calls.append(1) or run(*args, **named)
    )
    scored = score_table(config, episodes, methods, partials, print, i3d=i3d)
    assert len(calls) == 2 * 2  # the first seed again, of two batches
    assert set(scored.features) == {*methods.names, "truth"}
    assert set(scored.composites) == {"seen", "unseen"}
    assert all(set(found) == set(methods.names) for found in scored.composites.values())
    assert scored.features["copy"].shape == (4, 5 * 3)  # the observed frame with the imagined
    copied = scored.features["copy"].reshape(4, 5, 3)
    np.testing.assert_allclose(copied, copied[:, :1].repeat(5, 1), atol=1e-6)
    np.testing.assert_allclose(scored.features["memory"], scored.features["truth"], atol=5e-3)
    for method in plain.sums:
        np.testing.assert_array_equal(plain.sums[method], scored.sums[method])
    monkeypatch.setattr(ModelRunner, "run", None)
    monkeypatch.setattr(Colours, "features", None)
    again = score_table(config, episodes, methods, partials, print, i3d=i3d)

    found = results.videos(config, again, i3d)
    assert found["names"] == {"fvd": "FVD-5f@4", "kvd": "KVD-5f@4"}
    values = {method: found["results"][method]["fvd"]["value"] for method in methods.names}
    assert values["memory"] < 1e-3 < values["empty"]
    assert found["results"]["copy"]["fvd"]["floor"]["mean"] > 0
    for mask, table in found["masks"].items():
        assert set(table) == set(methods.names)
        within = {method: entry["fvd"]["value"] for method, entry in table.items()}
        assert within["memory"] < min(1e-3, within["empty"]), mask
        assert table["memory"]["kvd"]["value"] == pytest.approx(0, abs=1e-2)
        assert table["copy"]["kvd"]["floor"] == found["results"]["copy"]["kvd"]["floor"]
    said = format_fvd({"videos": found, "protocol": {}})
    assert "KVD-5f@4 over pixels never seen, with the truth elsewhere: with its map" in said
    one = Scored(again.choices[:1], {n: x[:1] for n, x in again.features.items()})
    one = Scored(one.choices, {}, {n: x[:1] for n, x in again.features.items()})
    assert results.videos(config, one, i3d) is None


def test_the_map_grows_by_what_is_counted(scene):
    config, episodes, _ = scene
    choices = long_choices(config, episodes)
    held = np.array([[10, 14, 18], [20, 20, 28], [0, 8, 8]])
    long = LongRollouts(Scored(choices, {}), 2, 1, {"memory": {"occupied": held}})
    found = results.growth(config, long)
    assert found["frames"] == [0, 4, 8]
    assert found["occupied"]["mean"] == pytest.approx([10, 14, 18])
    assert found["per_frame"]["mean"] == pytest.approx(1)
    assert found["capacity"] == 256
    assert results.growth(config, dataclasses.replace(long, kept={"model": {}})) is None


def test_measures_that_cost_are_left_out_in_a_sentence(monkeypatch):
    monkeypatch.setattr(i3d_weights, "installed", lambda: None)
    assert "no weights of I3D are installed" in selection.select_fvd("", 9, accelerator=True)[1]
    monkeypatch.setattr(i3d_weights, "installed", lambda: "there")
    assert (
        "I3D needs 9 frames, but a clip has 5" in selection.select_fvd("", 5, accelerator=True)[1]
    )
    assert "--fvd on enables them" in selection.select_fvd("", 9, accelerator=False)[1]
    assert selection.select_fvd("off", 9, accelerator=True)[0] is None
    with pytest.raises(UserError, match=r"too short for I3D.*--chain"):
        selection.select_fvd("on", 5, accelerator=True)
    assert set(selection.select_revisits((), None, 10, 64)[0]) == {"mirror[psnr]"}
    assert "no encoder" in selection.select_revisits((), None, 64, 64)[1]
    with pytest.raises(UserError, match="alex needs images of at least 31 pixels"):
        selection.select_revisits(("alex",), None, 16, 16)
