"""Features kept on disk are those the encoder makes, resumed after a stop, refused when stale."""

import dataclasses

import jax
import numpy as np
import pytest

from pewm_jax.cli import main as program
from pewm_jax.codecs import signals
from pewm_jax.config import UserError, save
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.encoders.simple import PatchColoursConfig
from pewm_jax.io import weights
from pewm_jax.memory import feature_cache
from pewm_jax.memory import feature_cache as feature_build
from pewm_jax.models.dinov2 import model as dinov2
from pewm_jax.models.dinov2.config import DINOv2Config
from pewm_jax.models.dinov2.model import DINOv2EncoderConfig
from tests.data import two_rooms as data_world

NETWORK = DINOv2Config(layers=1, heads=1, width=8, pretrained_size=28)
CONFIG = DINOv2EncoderConfig(size=28, network=NETWORK)


def quiet(_line):
    pass


@pytest.fixture(scope="module")
def params():
    return jax.tree.map(
        np.asarray, jax.jit(dinov2.init, static_argnums=0)(NETWORK, jax.random.key(0))
    )


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return data_world.split(tmp_path_factory.mktemp("data") / "train", episodes=3, frames=7)


@pytest.fixture(scope="module")
def cache(params, data, tmp_path_factory):
    out = tmp_path_factory.mktemp("cache") / "train"
    feature_build.build(CONFIG, params, data, out, batch=4, dtype="float32", log=quiet)
    return feature_cache.open_cache(out, CONFIG, params, data)


def test_what_is_read_is_what_the_encoder_makes(cache, params, data):
    encode = jax.jit(CONFIG.encode)
    for episode in EpisodeSource(data):
        rgb = signals.signal_from_rgb(episode.frames().rgb_THWC)
        want = np.asarray(encode(params, rgb))
        chosen = [5, 0, 5, 6]
        got = feature_cache.features(cache, episode, chosen)
        assert got.shape == (4, 2, 2, 8)
        np.testing.assert_allclose(got, want[chosen], rtol=1e-4, atol=1e-5)
        np.testing.assert_array_equal(feature_cache.features(cache, episode.name, chosen), got)


@pytest.mark.parametrize("dtype", ["float16", "bfloat16"])
def test_half_precision_takes_half_the_space(cache, params, data, dtype, tmp_path):
    small = feature_build.build(CONFIG, params, data, tmp_path / "c", dtype=dtype, log=quiet)
    got = feature_cache.features(small, "episode-1", range(7))
    want = feature_cache.features(cache, "episode-1", range(7))
    assert got.dtype.name == dtype
    np.testing.assert_allclose(np.float32(got), want, rtol=2e-2, atol=1e-2)


def test_a_build_goes_on_after_the_last_whole_episode(cache, params, data, tmp_path, monkeypatch):
    out, made = tmp_path / "cache", []
    write = weights.save

    def stop_at_the_second(path, tensors, *rest):
        if made:
            raise KeyboardInterrupt
        made.append(path)
        write(path, tensors, *rest)

    arguments = (CONFIG, params, data, out)
    with monkeypatch.context() as patch:
        patch.setattr(weights, "save", stop_at_the_second)
        with pytest.raises(KeyboardInterrupt):
            feature_build.build(*arguments, dtype="float32", batch=4, log=quiet)
    with pytest.raises(UserError, match="is not finished"):
        feature_cache.open_cache(out, CONFIG, params, data)
    with pytest.raises(UserError, match="begun with dtype float32, not float16"):
        feature_build.build(*arguments, dtype="float16", log=quiet)
    other = jax.tree.map(lambda leaf: leaf + 1, params)
    with pytest.raises(UserError, match="other encoder weights"):
        feature_build.build(CONFIG, other, data, out, dtype="float32", log=quiet)
    before = made[0].stat().st_mtime_ns
    feature_build.build(*arguments, dtype="float32", batch=4, log=quiet)
    assert made[0].stat().st_mtime_ns == before
    resumed = feature_cache.open_cache(out, CONFIG, params, data)
    assert resumed.files == cache.files
    for file, _ in cache.files.values():
        assert (out / file).read_bytes() == (cache.path / file).read_bytes()


def test_a_stale_cache_is_refused_and_says_why(cache, params, data, tmp_path):
    path = cache.path
    moved = {**params, "cls_token": params["cls_token"] + 1e-3}
    with pytest.raises(UserError, match="stale: it was made with other encoder weights"):
        feature_cache.open_cache(path, CONFIG, moved, data)
    larger = dataclasses.replace(CONFIG, size=42)
    with pytest.raises(UserError, match=r"other preprocessing \({'size': 28}, now {'size': 42}\)"):
        feature_cache.open_cache(path, larger, params, data)
    with pytest.raises(UserError, match="another encoder"):
        feature_cache.open_cache(path, PatchColoursConfig(), {}, data)
    other = dataclasses.replace(NETWORK, antialias=True)
    with pytest.raises(UserError, match=r"another network \({'antialias': False}, now {'antialia"):
        feature_cache.open_cache(path, dataclasses.replace(CONFIG, network=other), params, data)
    elsewhere = data_world.split(tmp_path / "train", episodes=3, frames=8)
    with pytest.raises(UserError, match="made with other data"):
        feature_cache.open_cache(path, CONFIG, params, elsewhere)


def test_the_dtype_of_equal_weights_does_not_matter(cache, params, data):
    half = jax.tree.map(lambda leaf: leaf.astype("bfloat16"), params)
    whole = jax.tree.map(lambda leaf: leaf.astype("float32"), half)
    manifest = EpisodeSource(data).manifest
    prints = [feature_cache.fingerprint(CONFIG, p, manifest) for p in (half, whole, params)]
    assert prints[0] == prints[1]
    assert prints[0]["weights"] != prints[2]["weights"]


def test_what_is_not_there_is_refused(cache, params, data, tmp_path):
    with pytest.raises(UserError, match="no features of episode nobody"):
        feature_cache.features(cache, "nobody", [0])
    for wrong in ([7], [-1]):
        with pytest.raises(UserError, match="has 7 frames of episode episode-0"):
            feature_cache.features(cache, "episode-0", wrong)
    with pytest.raises(UserError, match="is no cache"):
        feature_cache.open_cache(tmp_path, CONFIG, params, data)
    (tmp_path / "other.txt").write_text("mine")
    with pytest.raises(UserError, match=r"holds other files \(other.txt\)"):
        feature_build.build(CONFIG, params, data, tmp_path, log=quiet)


def test_damaged_files_are_refused(params, data, tmp_path):
    out = tmp_path / "cache"
    cache = feature_build.build(CONFIG, params, data, out, log=quiet)
    file = out / cache.files["episode-0"][0]
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(UserError, match="damaged or truncated"):
        feature_cache.features(cache, "episode-0", [0])
    for text, words in (("{", "not valid JSON"), ("[]", "no table"), ("{}", "does not parse")):
        (out / "cache.json").write_text(text)
        with pytest.raises(UserError, match=words):
            feature_cache.open_cache(out, CONFIG, params, data)


def test_features_beyond_float16_are_refused(params, data, tmp_path):
    large = {**params, "norm": {**params["norm"], "scale": params["norm"]["scale"] * 1e6}}
    with pytest.raises(UserError, match=r"float16 does not hold .* --dtype bfloat16"):
        feature_build.build(CONFIG, large, data, tmp_path / "cache", log=quiet)


def test_the_command_fills_every_split_with_either_encoder(cache, params, data, tmp_path, capsys):
    folder = tmp_path / "dinov2"
    folder.mkdir()
    save(NETWORK, folder / "config.json")
    weights.save(folder / "weights.safetensors", params)
    arguments = ["cache", str(data.parent), str(tmp_path / "c"), "--size", "28", "--dtype"]
    arguments += ["float32", "--batch", "4", "--encoder", str(folder)]
    assert program.main(["memory", *arguments]) == 0
    assert "features: 21 frames in" in capsys.readouterr().out
    assert program.main(["memory", *arguments]) == 0
    assert "finished already, 3 episodes" in capsys.readouterr().out
    made = feature_cache.open_cache(tmp_path / "c" / "train", CONFIG, params, data)
    assert made.files == cache.files
    assert (
        program.main(["memory", "cache", str(data), str(tmp_path / "colours"), "--patch", "4"]) == 0
    )
    colours = PatchColoursConfig(patch=4)
    made = feature_cache.open_cache(tmp_path / "colours", colours, {}, data)
    assert feature_cache.features(made, "episode-2", [3]).shape == (1, 4, 4, 6)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["cash"], "no command memory 'cash'"),
        (["cache"], "--help"),
        (["cache", "DATA", "OUT", "--sise", "3"], "--sise is not a setting"),
        (["cache", "nowhere", "OUT"], "nowhere does not exist"),
        (["cache", "DATA", "OUT", "--encoder", "nowhere"], "convert import dinov2"),
        (["cache", "DATA", "OUT", "--batch", "0"], "--batch is 0"),
    ],
)
def test_bad_commands_are_refused_in_a_sentence(arguments, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert program.main(["memory", *arguments]) == 2
    told = capsys.readouterr()
    assert told.err.startswith("error: ")
    assert words in told.err
    assert told.err.count("\n") == 1
    assert not list(tmp_path.iterdir())
