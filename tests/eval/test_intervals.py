"""Means over houses and their bootstrap, against direct loops; training seeds apart."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from pewm_jax.eval import statistics
from pewm_jax.eval.statistics import (
    DRAWS,
    SEED,
    entry,
    holm,
    house_table,
    over_houses,
    over_seeds,
    p_over_houses,
    p_over_seeds,
)
from tests.eval.test_statistics import sums_of
from tests.properties import examples


def looped(values, houses):
    """The bootstrap as one would say it: draw houses, average the means within them, sort."""
    names = np.unique(houses)
    means = []
    for house in names:
        mine = [v for v, h in zip(values, houses, strict=True) if h == house and np.isfinite(v)]
        means.append(np.mean(mine) if mine else np.nan)
    rng = np.random.default_rng(SEED)
    found = []
    for draw in rng.integers(len(names), size=(DRAWS, len(names))):
        picked = [means[i] for i in draw if np.isfinite(means[i])]
        if picked:
            found.append(np.mean(picked))
    return np.quantile(found, [0.025, 0.975])


def test_it_is_the_bootstrap_of_a_direct_loop():
    rng = np.random.default_rng(0)
    houses = rng.integers(0, 6, 20)
    values = rng.standard_normal(20) + houses
    values[[3, 7]] = np.nan
    values[houses == 0] = np.nan  # a house without any
    got = entry(values, houses)
    low, high = looped(values, houses)
    assert got["low"] == pytest.approx(low)
    assert got["high"] == pytest.approx(high)
    assert got["houses"] == len(np.unique(houses)) - 1


def test_every_house_counts_once_however_many_clips_it_has():
    values, houses = np.array([1.0, 1.0, 1.0, 1.0, 5.0]), np.array([0, 0, 0, 0, 1])
    assert entry(values, houses)["mean"] == pytest.approx(3)
    again = entry(np.repeat(values, 7), np.repeat(houses, 7))
    assert again == entry(values, houses)


@examples(20)
@given(st.integers(0, 2**31), st.floats(-5, 5), st.floats(0.1, 9))
def test_intervals_move_and_stretch_with_the_values(seed, shift, scale):
    rng = np.random.default_rng(seed)
    values, houses = rng.standard_normal(12), np.repeat(np.arange(6), 2)
    one, two = entry(values, houses), entry(shift + scale * values, houses)
    assert one["low"] <= one["mean"] <= one["high"]
    for name in ("mean", "low", "high"):
        assert two[name] == pytest.approx(shift + scale * one[name], abs=1e-9)


def test_it_holds_the_truth_about_as_often_as_it_says(monkeypatch):
    monkeypatch.setattr(statistics, "DRAWS", 400)
    statistics.drawn.cache_clear()
    rng, held = np.random.default_rng(1), 0
    for _ in range(300):
        houses = np.repeat(np.arange(24), 3)
        values = rng.standard_normal(24)[houses] + 0.5 * rng.standard_normal(72)
        got = entry(values, houses)
        held += got["low"] < 0 < got["high"]
    statistics.drawn.cache_clear()
    assert 0.88 < held / 300 < 0.98


def test_many_numbers_at_once_are_each_on_its_own():
    rng = np.random.default_rng(2)
    values, houses = rng.standard_normal((9, 4)), np.arange(9) // 2
    values[houses == 0, 1] = np.nan
    values[houses > 0, 2] = np.nan  # one house alone
    values[:, 3] = np.nan
    together = entry(values, houses)
    for t in range(4):
        assert {name: found[t] for name, found in together.items()} == entry(values[:, t], houses)
    assert together["low"][2] is None
    assert together["mean"][2] is not None
    assert (together["mean"][3], together["houses"][3]) == (None, 0)
    assert over_houses(values, houses)["mean"].shape == (4,)


def test_differences_are_paired():
    # Clips differ wildly; the gain is 3 dB on each: the difference is certain, the scores are not.
    base = np.repeat(10.0 ** np.random.default_rng(3).uniform(-3, -1, (1, 10, 1)), 2, 0)
    sums = {"memory": sums_of(base / 10**0.3), "empty": sums_of(base), "copy": sums_of(base[:1])}
    got = house_table(sums, np.repeat(np.arange(5), 2))
    for method in ("empty", "copy"):
        gain = got["margins"][method]["seen"]["psnr"]
        assert [gain[name] for name in ("mean", "low", "high")] == pytest.approx([3, 3, 3])
    score = got["results"]["memory"]["seen"]["psnr"]
    assert score["high"] - score["low"] > 1
    frames = got["per_frame_margins"]["empty"]["seen"]["psnr"]["mean"]
    assert frames == pytest.approx([3])
    assert "memory" not in got["margins"]


def test_training_seeds_have_students_interval():
    got = over_seeds([1.0, 2.0, 3.0])
    assert got["mean"] == pytest.approx(2)
    assert got["high"] - got["mean"] == pytest.approx(4.303 / np.sqrt(3), rel=1e-3)
    assert over_seeds([1.0]) == {"mean": 1.0, "low": None, "high": None}
    assert over_seeds([1.0, 2.0], [0.0])["low"] is None
    # Equal spread and number: Welch's are the textbook's 2n − 2 degrees of freedom.
    pair = over_seeds([1.0, 2.0, 3.0], [0.0, 1.0, 2.0])
    assert pair["high"] - pair["mean"] == pytest.approx(2.776 * np.sqrt(2 / 3), rel=1e-3)
    assert over_seeds([1.0, 1.0])["low"] == 1.0


@examples(30)
@given(st.integers(0, 2**31), st.integers(2, 6))
def test_students_interval_is_symmetric_and_swaps_its_sign(seed, count):
    rng = np.random.default_rng(seed)
    one, two = rng.standard_normal(count).tolist(), rng.standard_normal(3).tolist()
    there, back = over_seeds(one, two), over_seeds(two, one)
    assert there["mean"] == pytest.approx(-back["mean"])
    assert there["low"] == pytest.approx(-back["high"])
    assert there["high"] - there["mean"] == pytest.approx(there["mean"] - there["low"])


@examples(50)
@given(st.lists(st.one_of(st.none(), st.floats(0, 1)), min_size=1, max_size=12))
def test_holms_correction_rejects_what_its_steps_reject(p_values):
    """The steps: the k-th smallest of m is compared with α / (m − k + 1), until one fails."""
    adjusted = holm(p_values)
    known = sorted(p for p in p_values if p is not None)
    for alpha in (0.01, 0.05, 0.3):
        rejected = 0
        while rejected < len(known) and known[rejected] * (len(known) - rejected) < alpha:
            rejected += 1
        threshold = known[rejected - 1] if rejected else -1.0
        expected = [p is not None and p <= threshold for p in p_values]
        assert [p is not None and p < alpha for p in adjusted] == expected
    for before, after in zip(p_values, adjusted, strict=True):
        assert (before is None) == (after is None)
        assert before is None or before <= after <= 1


def test_holms_correction_of_a_textbook_example():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []


@examples(30)
@given(st.integers(0, 2**31), st.integers(2, 9), st.floats(-0.6, 0.6))
def test_p_values_over_houses_agree_with_the_interval(seed, count, shift):
    rng = np.random.default_rng(seed)
    houses = np.repeat(np.arange(count), 3)
    values = rng.standard_normal(3 * count) + shift
    interval, p = over_houses(values, houses), p_over_houses(values, houses)
    if p < 0.045:
        assert interval["low"] > 0 or interval["high"] < 0
    if p > 0.055:
        assert interval["low"] <= 0 <= interval["high"]
    assert p_over_houses(-values, houses) == pytest.approx(p, abs=2e-3)
    assert p_over_houses(values[:3], houses[:3]) is None


def test_p_values_over_seeds_are_students():
    values = [1.0, 2.0, 4.0]
    assert p_over_seeds(values) == pytest.approx(stats.ttest_1samp(values, 0).pvalue)
    assert p_over_seeds([1.0]) is None
    assert p_over_seeds([0.0, 0.0]) == 1
    assert p_over_seeds([1.0, 1.0]) == 0
