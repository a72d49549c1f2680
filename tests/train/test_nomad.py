"""NoMaD is trained by the trainer of world models: it learns, goes on where it stopped, is read."""

import dataclasses
import json

import jax
import numpy as np
import pytest

import pewm_jax
from pewm_jax import presets
from pewm_jax.config import ClipConfig, Config, ConfigError, DataConfig, StageConfig, UserError
from pewm_jax.data import abstract, loader
from pewm_jax.eval import loaded_run as opened
from pewm_jax.geometry.actions import discrete_table, integrate
from pewm_jax.geometry.cameras import pose_from_yaw
from pewm_jax.io import tree
from pewm_jax.planning import nomad_policy
from pewm_jax.train import loop
from pewm_jax.worlds.nomad import NomadTask, NomadTrainConfig
from tests.planning.test_nomad import STEPS
from tests.planning.test_nomad import TINY as POLICY

TINY = dataclasses.replace(POLICY, channels=(16,), lowest=(-1.2, -1.2), highest=(1.2, 1.2))
MODEL = NomadTask(clip=ClipConfig(frames=8, height=12, width=16), policy=TINY)
follow = jax.jit(integrate)
WALKS = [0, 0, 0, 0, 0, 0], [1, 0, 0, 1, 0, 0], [2, 0, 0, 2, 0, 0]
"""Of the toy, after the present picture: straight, to the left, to the right."""


def experiment(run="runs/it", steps=3, save_every=1):
    stage = StageConfig(steps=steps, batch=16, warmup=0, learning_rate=3e-3, decay="constant")
    return Config(
        model=MODEL,
        data=DataConfig(context=1),
        train=NomadTrainConfig(
            run=str(run), save_every=save_every, log_every=1, ema=0.0, nearest=0, policy=stage
        ),
    )


def batch(config, rows, seed=0):
    """Walks whose colour says where they lead."""
    rng = np.random.default_rng(seed)
    clip = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), abstract.clip(config, rows))
    kinds = rng.integers(0, 3, rows)
    rgb = rng.integers(0, 60, clip.frames.rgb_THWC.shape, dtype=np.uint8)
    rgb += (180 * np.eye(3)[kinds]).astype(np.uint8)[:, None, None, None]
    poses = []
    for kind in kinds:
        start = pose_from_yaw(rng.uniform(-2, 2, 3), rng.uniform(-3, 3), 0.0)
        walk = discrete_table(STEPS)[[0, *WALKS[kind]]]
        poses.append(np.asarray(follow(start, walk)))
    camera = dataclasses.replace(clip.frames.camera, world_from_camera=np.stack(poses))
    frames = dataclasses.replace(clip.frames, rgb_THWC=rgb, camera=camera)
    return dataclasses.replace(clip, frames=frames), kinds


@pytest.fixture
def clips(monkeypatch):
    kept = [batch(experiment(), 16, seed)[0] for seed in range(10)]

    def endless(config, split="train", *, seed, batch: int, start_step=0, **_options):
        for number in range(start_step, 1000):
            yield kept[number % 10]

    monkeypatch.setattr(loader, "clips", endless)


def test_waypoints_are_the_places_of_the_next_steps():
    clip, kinds = batch(experiment(), 6)
    found = np.asarray(MODEL.waypoints(clip))
    start = pose_from_yaw(np.zeros(3), 0.0, 0.0)
    for each, kind in zip(found, kinds, strict=True):
        walk = discrete_table(STEPS)[WALKS[kind][:4]]
        assert np.allclose(each, np.asarray(integrate(start, walk))[1:, :2, 3], atol=1e-4)


@pytest.mark.slow
def test_it_learns_to_walk_as_it_was_shown(tmp_path, clips):
    run = loop.train(experiment(tmp_path / "run", steps=300, save_every=300), log=lambda _: None)
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    found = [line["loss"] for line in lines if "loss" in line]
    assert np.mean(found[-20:]) < 0.3 * np.mean(found[:10])
    config, params = pewm_jax.load(run)
    clip, kinds = batch(config, 12, 99)
    sides = []
    for seen in clip.frames.rgb_THWC:
        way = nomad_policy.propose(TINY, params["policy"], seen[:2], None, jax.random.key(1), 8)
        sides.append(float(np.median(np.asarray(way)[:, -1, 1])))
    told = np.digitize(sides, [-0.1, 0.1])
    assert (told == np.array([1, 2, 0])[kinds]).mean() > 0.8  # chance: a third


@pytest.mark.slow
def test_training_goes_on_and_what_comes_out_is_read(tmp_path, clips):
    whole = loop.train(experiment(tmp_path / "whole"), log=lambda _: None)
    short = experiment(tmp_path / "halves")
    with pytest.MonkeyPatch.context() as patch:
        real = loader.clips

        def ending(*arguments, **options):
            for number, clip in enumerate(real(*arguments, **options)):
                if number == 2:
                    raise KeyboardInterrupt
                yield clip

        patch.setattr(loader, "clips", ending)
        with pytest.raises(KeyboardInterrupt):
            loop.train(short, log=lambda _: None)
    halves = loop.train(short, log=lambda _: None)
    (config, one), (_, other) = pewm_jax.load(whole), pewm_jax.load(halves)
    assert config.model == MODEL
    for path, leaf in tree.flatten(one).items():
        assert np.array_equal(leaf, tree.flatten(other)[path]), path
    with pytest.raises(UserError, match="trained a policy"):
        pewm_jax.start(config, one, None)
    with pytest.raises(UserError, match="nomad_policy"):
        opened.open_run(whole)


def test_the_preset_can_be_read():
    config = presets.load("nomad")
    assert isinstance(config.model, NomadTask)
    assert config.model.farthest >= config.model.policy.waypoints


def test_settings_that_cannot_work_are_refused():
    with pytest.raises(ConfigError, match="waypoints need"):
        dataclasses.replace(MODEL, clip=ClipConfig(frames=5))
    with pytest.raises(ConfigError, match="use 2 or more"):
        NomadTrainConfig(policy=StageConfig(batch=1))
