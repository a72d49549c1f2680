"""SRC and the mirror test: the way back against the way out, between a floor and a ceiling."""

import jax
import numpy as np
import pytest

from pewm_jax.config import UserError
from pewm_jax.convert import dinov2 as convert
from pewm_jax.eval import metrics
from pewm_jax.eval.metrics import revisits
from pewm_jax.io import tree, weights
from pewm_jax.models.dinov2 import model as dinov2
from pewm_jax.models.dinov2.config import DINOv2Config, published, size_name
from pewm_jax.models.i3d import convert as i3d_weights
from pewm_jax.models.lpips import convert as lpips_weights
from pewm_jax.models.lpips import model as lpips


def walks(count=3, places=2, size=(40, 36)):
    """Walks out and back through pictures of waves, each place of its own; the first twice."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[: size[0], : size[1]] / 8
    rate = rng.uniform(-3, 3, (2, count, places, 3, 1, 1))
    waves = np.moveaxis(0.8 * np.sin(rate[0] * v + rate[1] * u + rate[0]), 2, -1)
    return np.concatenate([waves, waves[:, ::-1]], 1).astype(np.float32)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Random weights of AlexNet and of a small DINOv2."""
    folder = tmp_path_factory.mktemp("weights")
    weights.save(folder / "alex.safetensors", lpips.init("alex", jax.random.key(0)))
    config = DINOv2Config(layers=1, heads=1, width=32, patch=56, pretrained_size=224)
    convert.write(
        config, jax.jit(lambda k: dinov2.init(config, k))(jax.random.key(1)), folder / "d"
    )
    return {"src[alex]": folder / "alex.safetensors", "src": folder / "d"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "best"), [("mirror[psnr]", 100), ("mirror[ssim]", 1), ("src[alex]", 100), ("src", 100)]
)
def test_equal_visits_are_best_and_what_is_forgotten_is_worse(name, best, files):
    metric = metrics.load(name, files.get(name))
    assert isinstance(metric, metrics.Revisit)
    truth = walks()
    noise = np.random.default_rng(1).standard_normal(truth.shape).astype(np.float32)
    noise[:, :2] = 0  # what is seen on the way out is as it was
    scores = [metric.score(truth + size * noise, truth) for size in (0, 0.2, 0.8)]
    means = [score.facts() for score in scores]
    assert scores[0].value_B.shape == (3,)
    np.testing.assert_allclose(scores[0].value_B, best, rtol=1e-5)
    np.testing.assert_allclose(scores[2].ceiling_B, best, rtol=1e-5)  # the truth's own
    assert means[0]["value"] > means[1]["value"] > means[2]["value"]
    assert means[0]["floor"] < means[0]["ceiling"]
    np.testing.assert_allclose(metric(truth + 0.2 * noise, truth), scores[1].value_B, rtol=1e-4)
    apart = [metric(x, x)[0] for x in np.split(truth + 0.2 * noise, 3)]
    np.testing.assert_allclose(apart, scores[1].value_B, rtol=1e-4)


def test_the_floor_is_another_place_and_the_middle_belongs_to_neither_way():
    psnr = metrics.load("mirror[psnr]")
    truth = walks()
    found = psnr.score(truth, truth).floor_B
    want = metrics.load("psnr")(np.roll(truth, 1, 0)[:, ::-1][:, :2], truth[:, :2])
    np.testing.assert_allclose(found, want, rtol=1e-5)
    middle = np.full_like(truth[:, :1], 0.3)
    odd = np.concatenate([truth[:, :2], middle, truth[:, 2:]], 1)
    out, back = revisits.ways(odd)
    np.testing.assert_array_equal(out, truth[:, :2])
    np.testing.assert_array_equal(back, truth[:, :2])


def test_a_score_carries_its_encoders_name(files):
    src = metrics.load("src", files["src"])
    assert src.name == "src[dinov2-1x32]"
    assert "class token of DINOv2 (1 layers of width 32)" in src.compare.about
    other = metrics.load("src[alex]", files["src[alex]"])
    mark = tree.digest(other.compare.params)[:8]  # of weights that are not the package's
    assert other.name == f"src[alex-{mark}]"
    mirror = metrics.load("mirror[lpips_alex]", files["src[alex]"])
    assert mirror.name == f"mirror[lpips_alex-{mark}]"
    assert size_name(published("base")) == "base"
    assert size_name(published("small", registers=True)) == "small-registers"
    assert "LPIPS's AlexNet" in other.compare.about
    assert len({src.compare.sha256, other.compare.sha256}) == 2
    assert metrics.load("mirror[ssim]").name == "mirror[ssim]"


def test_the_cosine_is_of_directions():
    a, b = np.array([[3.0, 0], [1, 1], [0, 0]]), np.array([[5.0, 0], [-2, 2], [1, 0]])
    np.testing.assert_allclose(revisits.cosine(a, b), [100, 0, 0], atol=1e-4)


def test_what_cannot_work_is_refused_in_a_sentence(files, monkeypatch, tmp_path):
    truth = walks()
    psnr = metrics.load("mirror[psnr]")
    with pytest.raises(UserError, match="a floor needs a second place: give at least 2 clips"):
        psnr.score(truth[:1], truth[:1])
    with pytest.raises(UserError, match="a clip of one frame has no return path"):
        psnr(truth[:, :1], truth[:, :1])
    with pytest.raises(UserError, match="cannot be compared"):
        psnr(truth, truth[1:])
    with pytest.raises(UserError, match="too small for LPIPS with AlexNet"):
        metrics.load("src[alex]", files["src[alex]"])(truth[:, :, :30], truth[:, :, :30])
    with pytest.raises(UserError, match="DINOv2 needs weights, which ship with no package"):
        metrics.load("src")
    with pytest.raises(UserError, match="holds no DINOv2"):
        metrics.load("src", tmp_path)
    with pytest.raises(UserError, match="no encoder 'clip'; choose one of dinov2, alex, vgg"):
        revisits.read_encoder("clip")
    with pytest.raises(UserError, match=r"no metric 'mirror\[fvd\]'"):
        metrics.load("mirror[fvd]")
    with pytest.raises(UserError, match="psnr is not a network and takes no weights"):
        metrics.load("mirror[psnr]", tmp_path)
    with pytest.raises(UserError, match="DreamSim needs weights"):
        metrics.load("dreamsim")


def test_metrics_without_weights_are_left_out_and_it_is_said(files, monkeypatch, tmp_path):
    monkeypatch.setattr(lpips_weights, "installed", lambda _: None)
    monkeypatch.setattr(i3d_weights, "installed", lambda: None)
    found, left_out = metrics.load_all(weights={"src": files["src"]})
    assert set(found) | set(left_out) | {"depth_mae", "depth_rel"} == set(metrics.NAMES)
    assert list(found) == ["psnr", "ssim", "src", "mirror[psnr]", "mirror[ssim]"]
    assert {"lpips_alex", "lpips_vgg", "fvd", "kvd", "src[alex]", "dreamsim"} < set(left_out)
    assert left_out["fvd"].startswith("fvd is left out: I3D needs weights, and none are installed")
    assert "DreamSim needs weights" in left_out["dreamsim"]
    with pytest.raises(UserError, match="gone does not exist"):
        metrics.load_all(["fvd"], {"fvd": tmp_path / "gone"})
    with pytest.raises(UserError, match="no metric 'fid'"):
        metrics.load_all(["psnr", "fid"])
