"""Every metric by the weights that users have: equal is best, what is spoilt more is worse."""

import numpy as np
import pytest

from pewm_jax.eval import metrics
from pewm_jax.eval.metrics import Revisit, VideoDistance
from pewm_jax.io import weights
from tests.eval.metrics.test_perceptual import blurred, clips, noisy

WITHOUT = ("dreamsim", "src")
"""No package has their weights: tests/models and test_revisits have random ones."""
HIGHER = ("psnr", "ssim", "src", "mirror[psnr]", "mirror[ssim]")


def walks(count, places, size=48):
    """Walks out and back, (count, 2 × places, size, size, 3): each place is seen twice."""
    out = clips(count, places, (size, size))
    return np.concatenate([out, out[:, ::-1]], 1)


def spoilt(truth, distort, size):
    """Spoil the way back, and leave the way out, which the way back is compared with."""
    half = truth.shape[1] // 2
    return np.concatenate([truth[:, :half], distort(truth, size)[:, half:]], 1)


PER_CLIP = [name for name in metrics.NAMES if name not in (*WITHOUT, "fvd", "kvd")]


@pytest.mark.slow
@pytest.mark.parametrize("name", PER_CLIP)
def test_a_known_distortion_is_ordered_rightly(name):
    metric = metrics.load(name)
    sizes = (0.5, 2, 8)
    truth = walks(2, 2)[..., :1] + 2 if name.startswith("depth") else walks(2, 2)
    higher = name.split("[")[0] in HIGHER or name in HIGHER
    for distort in (noisy, blurred):
        given = [truth, *(spoilt(truth, distort, size) for size in sizes)]
        if name.startswith("depth"):
            given = [truth, *(truth + np.float32(size) for size in sizes)]
        found = np.asarray([np.asarray(metric(one, truth)) for one in given], np.float64)
        best = {"psnr": 100, "mirror[psnr]": 100, "ssim": 1, "mirror[ssim]": 1}.get(name)
        best = 100 if name.startswith("src") else best or 0
        np.testing.assert_allclose(found[0], best, atol=1e-3)
        steps = np.diff(found, axis=0)
        assert (steps < 0).all() if higher else (steps > 0).all()


@pytest.mark.slow(only=("vgg", "src", "mirror"))
@pytest.mark.parametrize("name", ["lpips_vgg", "src[alex]", "src[vgg]", "mirror[lpips_alex]"])
def test_batches_of_any_size_give_the_same_mean(name):
    metric = metrics.load(name)
    truth = walks(3, 1)
    guess = spoilt(truth, noisy, 4)
    whole = np.asarray(metric(guess, truth))
    parts = [np.asarray(metric(guess[i:j], truth[i:j])) for i, j in ((0, 1), (1, 3))]
    np.testing.assert_allclose(np.concatenate(parts).mean(), whole.mean(), rtol=1e-4)
    assert isinstance(metric, Revisit) or metric.sha256
    assert getattr(metric, "name", name) == name  # the package's weights go without a mark


@pytest.mark.slow
def test_sets_of_clips_are_further_from_the_truth_the_more_they_are_spoilt():
    fvd, kvd = metrics.load("fvd"), metrics.load("kvd")
    assert isinstance(fvd, VideoDistance)
    assert isinstance(kvd, VideoDistance)
    assert (fvd.name(9, 48), kvd.name(17, 8)) == ("FVD-9f@48", "KVD-17f@8")
    truth = clips(4, 9, (48, 48))
    true = fvd.features(truth)
    assert float(fvd.distance(true, true)) == pytest.approx(0, abs=1e-3)
    for distort in (noisy, blurred):
        made = [fvd.features(distort(truth, size)) for size in (0.5, 8)]
        for metric in (fvd, kvd):
            found = [float(metric.distance(one, true)) for one in (true, *made)]
            assert found[0] < found[1] < found[2]


@pytest.mark.slow
def test_the_fvd_of_two_halves_of_true_clips_falls_with_their_number_as_the_floor_says():
    fvd = metrics.load("fvd")
    assert isinstance(fvd, VideoDistance)
    features = fvd.features(clips(16, 9, (32, 32)))
    floors = [fvd.score(features[:count], features[:count]).floor for count in (4, 8, 16)]
    means = [floor.mean for floor in floors if floor is not None]
    assert len(means) == 3
    assert means[0] > means[1] > means[2]
    apart = fvd.distance(features[::2], features[1::2])
    assert apart == pytest.approx(means[2], rel=0.3)


def test_the_same_weights_in_another_file_have_the_same_name(tmp_path):
    alex, fvd = metrics.load("lpips_alex"), metrics.load("fvd")
    weights.save(tmp_path / "alex.safetensors", alex.params)
    weights.save(tmp_path / "i3d.safetensors", fvd.params)
    again = metrics.load("lpips_alex", tmp_path / "alex.safetensors")
    assert (again.encoder, again.sha256 == alex.sha256) == ("alex", False)
    assert metrics.load("fvd", tmp_path / "i3d.safetensors").name(9, 48) == "FVD-9f@48"
