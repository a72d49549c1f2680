"""Means, margins and standard errors on numbers whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.eval.metrics.images import MASKS, SUMS
from pewm_jax.eval.statistics import (
    METRICS,
    drift,
    margin,
    margins,
    per_frame,
    scores,
    seen_share,
    summary,
    table,
)
from tests.properties import examples


def sums_of(error_SCT, pixels=(60, 40, 100)):
    """Sums whose colour error under every mask is the given one."""
    sums = np.zeros((*np.shape(error_SCT), 3, len(SUMS)))
    for k, count in enumerate(pixels):
        for name, value in {
            "squared": np.asarray(error_SCT) * 3 * count,
            "colours": 3 * count,
            "ssim": 0.5 * count,
            "windows": count,
            "depth_abs": np.asarray(error_SCT) * count,
            "depth_rel": 0.1 * count,
            "depths": count,
        }.items():
            sums[..., k, SUMS.index(name)] = value
    return sums


def test_scores_of_known_sums():
    got = scores(sums_of([0.01, 0.1]))
    np.testing.assert_allclose(got["seen"]["psnr"], [20, 10])
    np.testing.assert_allclose(got["unseen"]["ssim"], 0.5)
    np.testing.assert_allclose(got["all"]["depth_mae"], [0.01, 0.1])


def test_masks_that_cover_next_to_nothing_have_no_score():
    got = scores(sums_of(0.01, pixels=(0, 1, 1000)))
    assert np.isnan(got["seen"]["psnr"])
    assert np.isnan(got["unseen"]["psnr"])
    assert got["all"]["psnr"] == pytest.approx(20)


@examples(30)
@given(st.lists(st.floats(-50, 50), min_size=2, max_size=30))
def test_one_clip_per_episode_is_the_textbook_standard_error(values):
    got = summary(np.array(values), np.arange(len(values)))
    assert got["mean"] == pytest.approx(np.mean(values), abs=1e-9)
    assert got["stderr"] == pytest.approx(np.std(values, ddof=1) / np.sqrt(len(values)), abs=1e-6)
    assert got["n"] == len(values)


def test_clips_copied_within_an_episode_add_no_certainty():
    values = np.array([1.0, 4.0, 2.0])
    once = summary(values, np.arange(3))
    five = summary(np.repeat(values, 5), np.repeat(np.arange(3), 5))
    assert five["stderr"] == pytest.approx(once["stderr"])
    assert five["n"] == 15


def test_clustering_is_as_wide_as_it_should_be():
    rng = np.random.default_rng(0)
    means, stderrs = [], []
    for _ in range(400):
        place = rng.standard_normal(12)
        values = np.repeat(place, 4) + 0.3 * rng.standard_normal(48)
        got = summary(values, np.repeat(np.arange(12), 4))
        means.append(got["mean"])
        stderrs.append(got["stderr"])
    assert np.mean(stderrs) == pytest.approx(np.std(means), rel=0.1)


def test_clips_without_a_score_are_left_out():
    got = summary(np.array([1.0, np.nan, 3.0]), np.array([0, 1, 2]))
    assert (got["mean"], got["n"]) == (2.0, 2)
    assert summary(np.array([np.nan]), np.array([0])) == {"mean": None, "stderr": None, "n": 0}
    assert summary(np.array([1.0, 2.0]), np.array([5, 5]))["stderr"] is None


def test_margin_is_paired():
    # Clips differ wildly; the gain is 3 dB on each: the margin is certain.
    rng = np.random.default_rng(1)
    base = 10.0 ** rng.uniform(-3, -1, (1, 10, 1))
    base = np.repeat(base, 3, 0)
    episodes = np.repeat(np.arange(5), 2)
    got = margin(sums_of(base / 10**0.3), sums_of(base), episodes)
    gain = got["seen"]["psnr"]
    assert gain["mean"] == pytest.approx(3)
    assert gain["stderr"] == pytest.approx(0, abs=1e-6)
    assert gain["per_seed"] == pytest.approx([3, 3, 3])
    assert gain["stderr_over_seeds"] == pytest.approx(0, abs=1e-6)
    assert (gain["n"], gain["clusters"]) == (10, 5)
    reverse = margin(sums_of(base), sums_of(base / 10**0.3), episodes)
    assert reverse["seen"]["psnr"]["mean"] == pytest.approx(-3)
    assert got["all"]["depth_mae"]["mean"] < 0


def test_margin_is_the_difference_of_the_table():
    rng = np.random.default_rng(2)
    episodes = np.array([0, 0, 0, 1, 2, 2])
    a, b = (sums_of(rng.uniform(0.001, 0.1, (3, 6, 4))) for _ in range(2))
    results = table({"memory": a, "empty": b}, episodes)
    gain = margin(a, b, episodes)
    for mask in MASKS:
        for metric in METRICS:
            difference = (
                results["memory"][mask][metric]["mean"] - results["empty"][mask][metric]["mean"]
            )
            assert gain[mask][metric]["mean"] == pytest.approx(difference, abs=1e-9)
    assert np.mean(gain["all"]["psnr"]["per_seed"]) == pytest.approx(gain["all"]["psnr"]["mean"])


def test_every_rival_gets_a_margin_also_where_it_has_one_seed():
    error = np.full((3, 4, 2), 0.01)
    sums = {"memory": sums_of(error), "empty": sums_of(10 * error), "copy": sums_of(error[:1])}
    got = margins(sums, np.arange(4))
    assert got["empty"]["all"]["psnr"]["mean"] == pytest.approx(10)
    assert got["copy"]["all"]["psnr"]["mean"] == pytest.approx(0)
    assert len(got["copy"]["all"]["psnr"]["per_seed"]) == 3


def test_drift_compares_the_ends_of_a_rollout():
    error = np.concatenate([np.full(20, 0.001), np.full(20, 0.01)])
    got = drift({"memory": sums_of(np.broadcast_to(error, (1, 3, 40)))}, np.arange(3))["memory"]
    assert [part["mean"] for part in got["quarters"]] == pytest.approx([30, 30, 20, 20])
    assert got["first16"]["mean"] == pytest.approx(30)
    assert got["difference"]["mean"] == pytest.approx(-10)
    short = drift({"memory": sums_of(np.full((1, 3, 31), 0.1))}, np.arange(3))["memory"]
    assert (short["first16"], short["difference"]) == (None, None)


def test_per_frame_keeps_frames_apart():
    error = np.broadcast_to([0.001, 0.01, 0.1], (2, 4, 3))
    got = per_frame({"memory": sums_of(error)}, np.arange(4))
    assert got["memory"]["seen"]["psnr"]["mean"] == pytest.approx([30, 20, 10])
    assert got["memory"]["seen"]["psnr"]["n"] == [4, 4, 4]


def test_seen_share_counts_pixels_with_depth():
    assert seen_share(sums_of(np.full((2, 3, 4), 0.1), (30, 10, 100))) == pytest.approx(0.75)
