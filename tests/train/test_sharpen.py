"""Stage ``sharpen`` trains the decoder alone, resumes exactly, and leaves no discriminator."""

import dataclasses
import json

import jax
import numpy as np
import pytest

import pewm_jax
from pewm_jax.codecs.learned import LearnedCodecConfig
from pewm_jax.config import (
    ClipConfig,
    Config,
    ConfigError,
    DataConfig,
    StageConfig,
    UserError,
)
from pewm_jax.data import abstract, loader
from pewm_jax.io import tree, weights
from pewm_jax.models.lpips import convert as lpips_weights
from pewm_jax.models.lpips import model as lpips
from pewm_jax.train import loading, loop, optimizer, runs, step
from pewm_jax.train.checkpoint import Checkpoints
from pewm_jax.worlds.codec import CodecTask, CodecTrainConfig

TINY = LearnedCodecConfig(latent_channels=4, fine=8, coarse=8, fine_blocks=1, coarse_blocks=1)
SIDE = 32


def silent(_line):
    """Print nothing."""


@pytest.fixture(scope="module")
def alex(tmp_path_factory):
    file = tmp_path_factory.mktemp("lpips") / "alex.safetensors"
    weights.save(file, jax.jit(lpips.init, static_argnums=0)("alex", jax.random.key(0)))
    return str(file)


def experiment(run, alex, *, codec=0, statistics=0, steps=0, gate=0, **train):
    def stage(count):
        return StageConfig(steps=count, batch=2, warmup=1, learning_rate=2e-3)

    stages = {"codec": stage(codec), "statistics": stage(statistics), "gate": stage(0)}
    settings = {"save_every": 1, "log_every": 1, "ema": 0.5, "lpips_file": alex} | train
    clip = ClipConfig(frames=2, height=SIDE, width=SIDE)
    return Config(
        model=CodecTask(clip=clip, codec=dataclasses.replace(TINY, gate=gate)),
        data=DataConfig(context=1),
        train=CodecTrainConfig(run=str(run), sharpen=stage(steps), **stages, **settings),
    )


def batch(config, rows, seed):
    rng = np.random.default_rng(seed)
    clip = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), abstract.clip(config, rows))
    rgb = rng.integers(0, 256, (rows, 2, SIDE, SIDE, 3), np.uint8)
    depth = rng.uniform(1, 4, (rows, 2, SIDE, SIDE)).astype(np.float32)
    frames = dataclasses.replace(clip.frames, rgb_THWC=rgb, depth_THW=depth)
    return dataclasses.replace(clip, frames=frames)


@pytest.fixture
def clips(monkeypatch):
    """Endless clips; ``clips["until"]`` is the number of batches before reading fails."""
    limit = {"until": 1000}

    def endless(config, split="train", *, seed, batch: int, start_step=0, **_options):
        del split
        for number in range(start_step, 1000):
            if number >= limit["until"]:
                raise UserError("the data end here")
            yield globals()["batch"](config, batch, 1000 * seed + number)

    monkeypatch.setattr(loader, "clips", endless)
    return limit


def restored(run, config):
    """Return the state of the newest checkpoint of stage ``sharpen``."""
    stage = runs.planned(config)[-1]
    like = step.abstract_state(config, stage, loop.sharding.make_mesh())
    with Checkpoints(run, config, stage, silent) as checkpoints:
        return jax.device_get(checkpoints.restore(like))


def same(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.slow
def test_only_the_decoder_changes_and_no_weights_have_a_discriminator(clips, alex, tmp_path):
    first = loop.train(experiment(tmp_path / "codec", alex, codec=1, statistics=1), log=silent)
    before = tree.flatten(pewm_jax.load(first)[1])
    config = experiment(tmp_path / "sharp", alex, steps=3, start=str(first))
    run = loop.train(config, log=silent)

    after = tree.flatten(pewm_jax.load(run)[1])
    assert after.keys() == before.keys()
    moved = {path for path in before if not np.array_equal(before[path], after[path])}
    assert moved == {path for path in before if path.startswith("codec/decoder/")}
    for number in (2, 3):  # checkpoints can be loaded like runs
        _, params = pewm_jax.load(run / "checkpoints" / "sharpen" / str(number))
        assert tree.flatten(params).keys() == before.keys()

    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [(line["stage"], line["step"]) for line in lines] == [(4, 1), (4, 2), (4, 3)]
    measured = {"loss_rgb", "loss_depth", "lpips", "loss_gan", "gan_scale", "loss_discriminator"}
    assert measured | {"psnr_rgb", "depth_m"} <= lines[0].keys()
    state = restored(run, config)
    begun = step.create(config, runs.planned(config)[0], jax.random.key(0))
    assert begun.params.keys() == state.params.keys() == {"codec", "discriminator"}
    assert state.ema.keys() == {"codec"}
    assert state.ema["codec"].keys() == {"decoder"}

    further = experiment(tmp_path / "further", alex, codec=1, start=str(run))
    stage = runs.planned(further)[0]
    start = loading.read_weights(further, stage, print)
    same(step.initial_state(further, stage, loop.sharding.make_mesh(), start).params, start)


@pytest.mark.slow
def test_a_resumed_run_is_the_same_bit_for_bit(clips, alex, tmp_path):
    def config(name):
        return experiment(tmp_path / name, alex, codec=1, statistics=1, steps=4)

    whole = loop.train(config("whole"), log=silent)
    clips["until"] = 2
    with pytest.raises(UserError, match="the data end here"):
        loop.train(config("parts"), log=silent)
    assert (tmp_path / "parts" / "checkpoints" / "sharpen" / "2").is_dir()
    clips["until"] = 1000
    parts = loop.train(config("parts"), log=silent)
    same(pewm_jax.load(whole)[1], pewm_jax.load(parts)[1])
    one, other = (restored(run, config(name)) for run, name in ((whole, "whole"), (parts, "parts")))
    same(one.params, other.params)
    same(jax.tree.leaves(one.opt_state), jax.tree.leaves(other.opt_state))


@pytest.mark.slow
def test_a_gate_keeps_its_weights(clips, alex, tmp_path):
    settings = {"gate": 8, "fresh": (r"codec/gate/.*",), "gan_weight": 0.0, "sharpen_lpips": 0.0}
    config = experiment(tmp_path / "run", "", codec=1, statistics=1, steps=1, **settings)
    run = loop.train(config, log=silent)
    _, params = pewm_jax.load(run)
    assert "gate" in params["codec"]
    state = restored(run, config)
    same(state.params["codec"]["gate"], params["codec"]["gate"])


def test_the_discriminator_has_an_optimizer_of_its_own(alex):
    config = experiment("runs/it", alex, steps=10)
    stage = runs.planned(config)[0]
    params = jax.eval_shape(lambda key: stage.init(config.model, key), jax.random.key(0))
    labels = tree.flatten(stage.labels(params))
    assert {path for path, label in labels.items() if label == "adversary"} == {
        path for path in labels if path.startswith("discriminator/")
    }
    small = {"codec": {"decoder": {"kernel": np.ones(3, np.float32)}}}
    small = small | {"discriminator": {"kernel": np.ones(3, np.float32)}}
    rule = optimizer.make(config, stage)
    state = rule.init(small)
    steep = jax.tree.map(lambda x: x, small)
    steep["discriminator"] = {"kernel": np.full(3, 1e6, np.float32)}
    rate = optimizer.rate(stage.settings(config), state)
    one, other = (rule.update(slope, state, small)[0] for slope in (small, steep))
    same(one["codec"], other["codec"])  # the discriminator's gradient does not clip the decoder's
    np.testing.assert_allclose(one["codec"]["decoder"]["kernel"], -rate, rtol=1e-4)
    np.testing.assert_allclose(one["discriminator"]["kernel"], -2e-3, rtol=1e-4)  # no warm-up


def test_without_steps_there_is_no_such_stage_and_what_cannot_work_is_refused(
    alex, tmp_path, monkeypatch
):
    config = experiment(tmp_path / "run", alex, codec=1, statistics=1)
    assert [stage.name for stage in runs.all_stages(config)] == ["codec", "statistics"]
    small = experiment(tmp_path / "run", alex, steps=1).with_model(
        clip=ClipConfig(frames=2, height=16, width=24)
    )
    with pytest.raises(UserError, match="16×24 pixels are too small for the discriminator"):
        loop.train(small)
    monkeypatch.setattr(lpips_weights, "installed", lambda _: None)
    with pytest.raises(UserError, match="LPIPS with AlexNet needs weights, and none are installed"):
        loop.train(experiment(tmp_path / "run", "", steps=1))
    assert not (tmp_path / "run").exists()
    for name in ("gan_weight", "sharpen_lpips", "gate_lpips"):
        with pytest.raises(ConfigError, match=rf"train\.{name} is -1: use 0 or more"):
            CodecTrainConfig(**{name: -1})
