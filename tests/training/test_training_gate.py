"""The gate is trained after the codec, alone, and learns to show what was seen."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pewm_jax
from pewm_jax import shipped, tree, worlds
from pewm_jax.config import (
    ClipConfig,
    CodecTrainConfig,
    CodecWorldConfig,
    Config,
    DataConfig,
    LearnedCodecConfig,
    StageConfig,
    SurfelConfig,
)
from pewm_jax.data import abstract
from pewm_jax.models import learned_codec
from pewm_jax.rollouts import load_finished
from pewm_jax.training import loop
from tests.helpers import random_camera

CODEC = LearnedCodecConfig(
    latent_channels=4, fine=8, coarse=8, fine_blocks=1, coarse_blocks=1, gate=8
)


def experiment(run="runs/it", **steps):
    each = {name: StageConfig(steps=0) for name in ("codec", "statistics", "gate")}
    each |= {
        name: StageConfig(steps=count, batch=2, warmup=0, learning_rate=5e-3, decay="constant")
        for name, count in steps.items()
    }
    memory = SurfelConfig(capacity=2048, cell_m=(0.02, 0.02, 0.02))
    return Config(
        model=CodecWorldConfig(
            clip=ClipConfig(frames=3, height=16, width=24), codec=CODEC, memory=memory
        ),
        data=DataConfig(context=2),
        train=CodecTrainConfig(run=str(run), save_every=1, log_every=1, ema=0.0, **each),
    )


def batch(config, rows, seed=0):
    """Still cameras before a wall in waves of colour: all of it was seen before."""
    rng = np.random.default_rng(seed)
    like = abstract.clip(config, rows)
    clip = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), like)
    cameras = [random_camera(rng, 1) for _ in range(rows)]
    one = jax.tree.map(lambda *x: np.stack(x), *cameras)
    walls = rng.integers(0, 256, (rows, 1, 16, 24, 3), np.uint8)

    def still(frames):
        count = frames.depth_THW.shape[1]
        return dataclasses.replace(
            frames,
            rgb_THWC=np.repeat(walls, count, 1),
            depth_THW=np.full_like(frames.depth_THW, 2.0),
            camera=jax.tree.map(lambda x: np.repeat(x, count, 1), one),
        )

    return dataclasses.replace(
        clip,
        frames=still(clip.frames),
        context=still(clip.context),
        context_valid_S=np.ones_like(clip.context_valid_S),
    )


@pytest.fixture
def clips(monkeypatch):
    def given(config, split, *, batch: int, start_step: int = 0, **_):
        del split
        while True:
            yield globals()["batch"](config, batch, start_step)
            start_step += 1

    monkeypatch.setattr(loop.loader, "clips", given)


def test_only_the_gate_learns_in_its_stage_and_the_run_can_be_loaded(clips, tmp_path):
    first = loop.train(experiment(tmp_path / "codec", codec=1, statistics=1), say=lambda _: None)
    before = tree.flatten(pewm_jax.load(first)[1])
    config = experiment(tmp_path / "gate", gate=2)
    start = dataclasses.replace(config.train, start=str(first), fresh=(r"codec/gate/.*",))
    run = loop.train(dataclasses.replace(config, train=start), say=lambda _: None)
    after = tree.flatten(load_finished(run)[1])
    assert {path for path in after if path.startswith("codec/gate/")} == after.keys() - before
    for path, leaf in before.items():
        np.testing.assert_array_equal(after[path], leaf)
    assert np.abs(after["codec/gate/out/kernel"]).max() > 0


def test_with_what_was_seen_the_gate_makes_more_of_noisy_latents_than_the_decoder():
    config = experiment()
    stage = worlds.stages(config)[2]
    params = worlds.init(config, jax.random.key(0))
    clip = batch(config, 2)
    loss = jax.jit(lambda p, key: stage.loss(config.model, config.train, p, clip, key))
    measured = loss(params, jax.random.key(1))[1]
    assert measured["psnr_rgb"] > measured["psnr_decoded"] + 3
    assert measured["psnr_rendered"] > measured["psnr_rgb"]


def test_weights_that_come_with_the_library_are_found_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in shipped.names():
        config, params = pewm_jax.load(name)
        assert (shipped.find(name) / "README.md").is_file()
        assert all(np.isfinite(leaf.astype(np.float32)).all() for leaf in jax.tree.leaves(params))
        assert all(leaf.dtype.itemsize == 2 for leaf in jax.tree.leaves(params))
        if isinstance(config.model, CodecWorldConfig):
            video = jnp.zeros((1, 2, 16, 24, 3))
            latents = learned_codec.encode(config.model.codec, params["codec"], video)
            assert latents.shape == (1, 2, 2, 3, 16)
