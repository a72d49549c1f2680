"""Features kept on disk train like those the encoder makes; stale ones are refused."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from pewm_jax import presets
from pewm_jax.config import ClipConfig, ConfigError, StageConfig, UserError
from pewm_jax.data import loader
from pewm_jax.encoders.simple import PatchColoursConfig
from pewm_jax.memory import feature_cache
from pewm_jax.memory import feature_cache as feature_build
from pewm_jax.train import loading, loop, runs
from pewm_jax.worlds import objective
from pewm_jax.worlds.pewm import world as pewm
from tests.data import two_rooms as data_world
from tests.helpers import tiny_config


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    """A tiny experiment whose data and features exist."""
    root = tmp_path_factory.mktemp("kept")
    data_world.split(root / "data" / "train", episodes=4, frames=12, width=24)
    tiny = tiny_config(clip=ClipConfig(frames=5, height=16, width=24))
    paths = {"path": str(root / "data"), "features": str(root / "features"), "context": 6}
    tiny = dataclasses.replace(tiny, data=dataclasses.replace(tiny.data, **paths))
    train, kept = root / "data" / "train", root / "features" / "train"
    feature_build.build(
        tiny.model.memory.encoder, {}, train, kept, dtype="float32", log=lambda _: None
    )
    return tiny


def batch(config, cache):
    read = cache and functools.partial(feature_cache.features, cache)
    return next(loader.clips(config, seed=0, batch=3, features=read))


@pytest.mark.slow
def test_the_map_of_kept_features_is_the_map_of_computed_ones(config):
    cache = loading.features(config, pewm.STAGES[1])
    kept, plain = batch(config, cache), batch(config, None)
    assert not kept.context_valid_S.all(), "the test should see slots without a frame"
    assert kept.extras["context_features_ShwF"].shape == (3, 6, 8, 12, 6)
    assert "context_features_ShwF" not in plain.extras
    readout = jax.jit(objective.clip_readout, static_argnums=0)
    got, want = (readout(config.model, {}, clip).tokens for clip in (kept, plain))
    assert np.asarray(want.valid_M).any(1).all()
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), got, want)
    scaled = kept.with_extras(context_features_ShwF=2 * kept.extras["context_features_ShwF"])
    features = readout(config.model, {}, scaled).tokens.features_MF
    np.testing.assert_allclose(features, 2 * np.asarray(want.features_MF), atol=1e-6)


def test_features_are_opened_only_where_a_map_is_built(config):
    assert loading.features(config, pewm.STAGES[0]) is None
    none = dataclasses.replace(config, data=dataclasses.replace(config.data, features=""))
    assert loading.features(none, pewm.STAGES[1]) is None
    absent = dataclasses.replace(config, data=dataclasses.replace(config.data, features="absent"))
    with pytest.raises(UserError, match=r"absent/train is no cache; make it with"):
        loading.features(absent, pewm.STAGES[1])


def test_training_on_stale_features_is_refused(config, tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "compile_step", lambda *_: None)
    other = dataclasses.replace(config.model.memory, encoder=PatchColoursConfig(patch=4))
    train = dataclasses.replace(config.train, run=str(tmp_path / "run"))
    train = dataclasses.replace(
        train,
        stage1=dataclasses.replace(train.stage1, steps=1, batch=2),
        stage2=dataclasses.replace(train.stage2, steps=1, batch=2),
    )
    stale = dataclasses.replace(config.with_model(memory=other), train=train)
    monkeypatch.setattr(runs, "planned", lambda _: [pewm.STAGES[1]])
    monkeypatch.setattr(loop, "initial_state", fake_state)
    with pytest.raises(UserError, match=r"stale: it was made with other preprocessing"):
        loop.train(stale, log=lambda _: None)


def test_a_run_goes_on_with_features_that_were_moved(config, tmp_path):
    train = dataclasses.replace(config.train, run=str(tmp_path / "run"))
    begun = dataclasses.replace(config, train=train)
    (runs.prepare(begun) / runs.WEIGHTS).touch()
    moved = dataclasses.replace(begun, data=dataclasses.replace(begun.data, features="elsewhere"))
    runs.check(moved)
    assert not runs.differences({**runs.identity(begun), "data.features": ""}, runs.identity(moved))
    other = dataclasses.replace(moved, data=dataclasses.replace(moved.data, context=7))
    with pytest.raises(ConfigError, match=r"data\.context 6 there, 7 here"):
        runs.check(other)


def test_a_run_that_learns_from_imagined_clips_keeps_its_sampler(tmp_path):
    base = presets.load("egowm")
    base = dataclasses.replace(
        base, train=dataclasses.replace(base.train, run=str(tmp_path / "run"))
    )
    none = dataclasses.replace(base.train, gate=StageConfig(steps=0))
    for config, keeps in ((base, True), (dataclasses.replace(base, train=none), False)):
        (runs.prepare(config) / runs.WEIGHTS).touch()
        noise = dataclasses.replace(config.model.noise, sample_steps=9)
        other = config.with_model(noise=noise)
        if keeps:
            with pytest.raises(ConfigError, match=r"sample_steps 4 there, 9 here"):
                runs.check(other)
            (tmp_path / "run" / runs.WEIGHTS).unlink()
        else:
            runs.check(other)


def fake_state(*_):
    @dataclasses.dataclass
    class State:
        params: dict

    return State({})
