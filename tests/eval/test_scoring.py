"""Scoring end to end with a model that knows the answer, and resuming it."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest

from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.episodes import read_episode
from pewm_jax.eval import long_rollouts, runner, scoring
from pewm_jax.eval.clips import choose
from pewm_jax.eval.metrics.structure import Consistency, average, first_visible, overlaps
from pewm_jax.eval.reproject import ReprojectSettings
from pewm_jax.eval.results import structure
from pewm_jax.eval.runner import Methods, ModelRunner
from pewm_jax.eval.statistics import margin, table
from pewm_jax.io.store import ResultCache
from tests.eval.scene import knowing_rollout, record, tiny, write_split

PARAMS = {"offset": np.float32(0)}


@pytest.fixture(scope="module")
def episodes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "revisit"
    return EpisodeSource(write_split(folder, episodes=2))


@pytest.fixture(scope="module")
def knowing_model(tmp_path_factory):
    """Make models that know the room; each kind is compiled once."""

    @functools.cache
    def make(batch=2, late=0):
        config = tiny(tmp_path_factory.getbasetemp(), batch=batch)
        model = ModelRunner(config, PARAMS, batch, config.data.context, lambda _: None)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(runner, "rollout", functools.partial(knowing_rollout, late=late))
            model.prepare([True, False])
        return Methods(model, ReprojectSettings())

    return make


def test_a_model_that_remembers_wins_by_a_mile(knowing_model, episodes, tmp_path):
    config = tiny(tmp_path, clips=3)
    model = knowing_model()
    scored = scoring.score_table(
        config, episodes, model, ResultCache.for_weights(tmp_path, "e" * 64, "f" * 64), print
    )
    assert scored.sums["memory"].shape == (2, 3, 4, 3, 9)
    assert scored.sums["copy"].shape == (1, 3, 4, 3, 9)
    results = table(scored.sums, scored.clusters)
    # Only rounding of colours to 8 bits and of depth to millimetres is left.
    assert results["memory"]["all"]["psnr"]["mean"] > 50
    assert results["memory"]["all"]["ssim"]["mean"] > 0.999
    assert results["memory"]["all"]["depth_mae"]["mean"] < 1e-3
    assert results["empty"]["all"]["psnr"]["mean"] < 15
    assert results["empty"]["all"]["depth_mae"]["mean"] == pytest.approx(1, abs=0.01)
    assert results["copy"]["all"]["psnr"]["mean"] < 25
    # Without a network: better than standing still where something was seen, worse than knowing.
    seen = {method: results[method]["seen"]["psnr"]["mean"] for method in results}
    assert seen["memory"] > seen["reproject"] > seen["copy"] + 3
    assert results["reproject"]["seen"]["depth_mae"]["mean"] < 0.1
    gain = margin(scored.sums["memory"], scored.sums["empty"], scored.clusters)["seen"]["psnr"]
    assert gain["mean"] > 10 * gain["stderr"]
    assert gain["mean"] > 35


def test_a_composite_shows_the_truth_outside_its_mask(knowing_model, episodes, tmp_path):
    config = tiny(tmp_path, clips=2)
    some = choose(config, episodes, 2, 1)
    batch = scoring.load_batch(config, episodes, some, 0, cameras=False)
    truth = np.asarray(batch.whole(batch.targets.rgb_THWC))
    wrong = -truth[:, 1:]
    for mask, within in (("seen", batch.seen), ("unseen", batch.unseen)):
        found = np.asarray(batch.composite(wrong, mask))
        inside = np.asarray(within)[..., None]
        np.testing.assert_array_equal(found[:, 0], truth[:, 0])  # the observed frame
        wanted = np.where(inside, wrong, truth[:, 1:])
        np.testing.assert_allclose(found[:, 1:], wanted, atol=1e-6)
        # An error outside the mask alone is no error.
        outside = np.where(inside, truth[:, 1:], wrong)
        np.testing.assert_allclose(batch.composite(outside, mask), truth, atol=1e-6)


def test_a_model_that_is_one_frame_late_is_noticed(knowing_model, episodes, tmp_path):
    config = tiny(tmp_path, clips=2)
    model = knowing_model(late=1)
    scored = scoring.score_table(
        config, episodes, model, ResultCache.for_weights(tmp_path, "e" * 64, "f" * 64), print
    )
    assert table(scored.sums, scored.clusters)["memory"]["all"]["psnr"]["mean"] < 25


@pytest.mark.slow
def test_batches_do_not_change_the_numbers(knowing_model, episodes, tmp_path):
    sums = []
    for batch in (2, 3):
        config = tiny(tmp_path, clips=3, batch=batch)
        model = knowing_model(batch)
        partials = ResultCache.for_weights(tmp_path / str(batch), "e" * 64, "f" * 64)
        sums.append(scoring.score_table(config, episodes, model, partials, print).sums)
    for method in sums[0]:
        np.testing.assert_allclose(sums[0][method], sums[1][method], rtol=1e-4, atol=1e-4)


def test_scored_pieces_are_not_done_again(monkeypatch, knowing_model, episodes, tmp_path):
    config = tiny(tmp_path, clips=4, chain=2)
    model = knowing_model()
    whole = scoring.score_table(
        config, episodes, model, ResultCache.for_weights(tmp_path / "a", "e" * 64, "f" * 64), print
    )

    calls, run = [], ModelRunner.run

    def failing(self, *args, **kwargs):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return run(self, *args, **kwargs)

    monkeypatch.setattr(ModelRunner, "run", failing)
    with pytest.raises(KeyboardInterrupt):
        scoring.score_table(
            config,
            episodes,
            model,
            ResultCache.for_weights(tmp_path / "b", "e" * 64, "f" * 64),
            print,
        )
    said = []
    resumed = scoring.score_table(
        config,
        episodes,
        model,
        ResultCache.for_weights(tmp_path / "b", "e" * 64, "f" * 64),
        said.append,
    )
    # Two batches × two seeds × two sampled methods, each imagined exactly once (plus the cut one).
    assert len(calls) == 8 + 1
    assert "are reused" in said[0]
    for method in whole.sums:
        np.testing.assert_array_equal(whole.sums[method], resumed.sums[method])


def test_things_are_followed_through_the_clips_of_the_first_seed(
    monkeypatch, knowing_model, tmp_path
):
    episodes = EpisodeSource(write_split(tmp_path / "revisit", episodes=2, ids=True))
    config, model, asked = tiny(tmp_path, clips=3), knowing_model(), []

    def bright(video, first):
        asked.append(first)
        return first[:, None] & (video.mean(-1) > 100)

    measure = Consistency(bright, "bright", "1234")
    partials = ResultCache.for_weights(tmp_path / "partial", "e" * 64, "f" * 64)
    args = config, episodes, model, partials, print
    scored = scoring.score_table(*args, structure=measure)
    assert set(scored.structure) == {"memory", "empty", "reproject", "copy", "truth"}
    assert len(asked) == 5 * 3  # one seed
    for number, choice in enumerate(scored.choices):
        episode, frames = episodes[choice.episode], [choice.start, *choice.targets_N]
        truth = episode.frames(frames)
        ids = episode.ids(frames)
        first = np.unique(ids[0])
        masks = np.stack([ids == thing for thing in first[first > 0]])  # 0 is the room's shell
        np.testing.assert_array_equal(asked[(0, 1, 10)[number]], masks[:, 0])  # 5 of each batch
        visible = first_visible(truth.depth_THW, truth.camera)
        still = np.repeat(truth.rgb_THWC[:1], len(frames), 0)
        for method, video in (("truth", truth.rgb_THWC), ("copy", still)):
            found = overlaps(bright(video, masks[:, 0]), masks, visible)
            values = scored.structure[method][number]
            np.testing.assert_allclose(values[0], average(found))
            np.testing.assert_allclose(values[1:], average(found, 0))
        # This model knows the room: it is scored as the truth is.
        np.testing.assert_allclose(
            scored.structure["memory"][number], scored.structure["truth"][number], atol=3
        )
    monkeypatch.setattr(Consistency, "__call__", None)  # nothing is followed again
    again = scoring.score_table(*args, structure=measure)
    for method, values in scored.structure.items():
        np.testing.assert_array_equal(again.structure[method], values)
    assert scoring.score_table(*args).structure == {}
    facts = structure(config, scored, measure)
    assert facts["name"] == "SCS[bright]"
    assert set(facts["margins"]) == {"empty", "reproject", "copy"}
    assert facts["clips"] == 3


def test_clips_of_one_scene_are_one_cluster(tmp_path):
    two = [read_episode(record(i, scene=f"house-{i // 2}")) for i in range(4)]
    one = [read_episode(record(i, scene="house")) for i in range(3)]
    config = tiny(tmp_path)
    scored = scoring.Scored(choose(config, two, 4, 1), {})
    assert scored.clustered_by == "scene"
    assert scored.clusters.tolist() == [0, 0, 1, 1]
    scored = scoring.Scored(choose(config, one, 3, 1), {})
    assert scored.clustered_by == "episode"
    assert scored.clusters.tolist() == [0, 1, 2]


def test_pieces_of_other_weights_are_dropped_and_broken_ones_ignored(tmp_path):
    old = ResultCache.for_weights(tmp_path, "a" * 64, "f" * 64)
    old.put("piece", {"x": np.arange(3)})
    assert old.get("piece")["x"].tolist() == [0, 1, 2]
    path = old.folder / "piece.npz"
    path.write_bytes(path.read_bytes()[:-30])
    assert old.get("piece") is None
    new = ResultCache.for_weights(tmp_path, "b" * 64, "f" * 64)
    assert new.get("piece") is None
    assert not old.folder.exists()


def test_pieces_of_another_protocol_stay_and_stay_apart(tmp_path):
    full = ResultCache.for_weights(tmp_path, "a" * 64, "f" * 64)
    full.put("piece", {"x": np.arange(3)})
    quick = ResultCache.for_weights(tmp_path, "a" * 64, "c" * 64)
    assert quick.get("piece") is None
    quick.put("piece", {"x": np.zeros(1)})
    again = ResultCache.for_weights(tmp_path, "a" * 64, "f" * 64)
    assert again.get("piece")["x"].tolist() == [0, 1, 2]


@pytest.mark.slow
def test_long_rollouts_keep_pictures_and_the_map(monkeypatch, knowing_model, episodes, tmp_path):
    config = tiny(tmp_path, video_clips=9)
    model = knowing_model()
    partials = ResultCache.for_weights(tmp_path, "e" * 64, "f" * 64)
    long = long_rollouts.roll_long(config, episodes, model, partials, print)
    assert long.chain == 5  # 5 × 4 frames after a start fit into 24 frames; 6 do not
    assert long.shown == 1
    assert long.kept["memory"]["rgb"].shape == (1, 20, 16, 16, 3)
    assert long.kept["memory"]["first_valid"].any()
    episode = episodes[long.scored.choices[0].episode]
    truth = episode.frames(list(long.scored.choices[0].targets_N))
    off = truth.rgb_THWC.astype(int) - long.kept["memory"]["rgb"][0]
    assert np.abs(off).max() <= 3
    monkeypatch.setattr(ModelRunner, "run", None)
    again = long_rollouts.roll_long(config, episodes, model, partials, print)
    np.testing.assert_array_equal(again.kept["empty"]["rgb"], long.kept["empty"]["rgb"])


def test_equal_seeds_draw_equal_noise_whatever_the_batch():
    seeds = np.array([[0, 0], [0, 1], [1, 0]], np.uint32)
    data = jax.random.key_data(runner.clip_keys(seeds))
    one = jax.random.key_data(runner.clip_keys(seeds[1:2]))
    np.testing.assert_array_equal(data[1], one[0])
    assert len({tuple(row) for row in np.asarray(data).tolist()}) == 3
