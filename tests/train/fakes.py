"""A world model of four small arrays, and random clips: what the trainer needs, in milliseconds."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.config import ClipConfig, Config, DataConfig, StageConfig, TrainConfig
from pewm_jax.data import loader
from pewm_jax.train import sharding
from pewm_jax.types import Camera, Clip, Frames
from pewm_jax.worlds.pewm import world as pewm
from pewm_jax.worlds.pewm.world import PEWM

SIZE = 16


def config(run="runs/fake", *, stage1=6, stage2=6, dtype="float32", **train) -> Config:
    settings = {"batch": 8, "warmup": 2, "learning_rate": 1e-2}
    train = {"save_every": 3, "log_every": 1, "preview_every": 0, "ema": 0.5} | train
    return Config(
        model=PEWM(clip=ClipConfig(frames=5, height=SIZE, width=SIZE), dtype=dtype),
        data=DataConfig(context=1),
        train=TrainConfig(
            run=str(run),
            stage1=StageConfig(steps=stage1, **settings),
            stage2=StageConfig(steps=stage2, **settings),
            **train,
        ),
    )


def with_stage(config: Config, name: str, **changes) -> Config:
    stage = dataclasses.replace(getattr(config.train, name), **changes)
    return dataclasses.replace(config, train=dataclasses.replace(config.train, **{name: stage}))


def with_train(config: Config, **changes) -> Config:
    return dataclasses.replace(config, train=dataclasses.replace(config.train, **changes))


def clip(config: Config, batch: int, seed: int) -> Clip:
    rng, size = np.random.default_rng(seed), config.model.clip

    def frames(count):
        shape = (batch, count, size.height, size.width)
        pose = np.broadcast_to(np.eye(4, dtype=np.float32), (batch, count, 4, 4))
        camera = Camera(np.full((batch, count, 4), 4, np.float32), pose)
        rgb = rng.integers(0, 256, (*shape, 3), dtype=np.uint8)
        return Frames(rgb, rng.uniform(1, 4, shape).astype(np.float32), camera)

    context = config.data.context
    actions = np.zeros((batch, size.frames - 1, 3), np.float32)
    valid = np.ones((batch, context), bool)
    return Clip(frames(size.frames), frames(context), valid, actions_TA=actions)


def clips(config, split="train", *, seed, batch, start_step=0, features=None, rows=None, bad=None):
    assert split == "train"
    assert features is None
    step = start_step
    while True:
        whole = clip(config, batch, 1000 * seed + step)
        yield jax.tree.map(lambda x: x[rows or slice(None)], whole)
        step += 1


def records(config, split="train", *, seed, batch, step):
    return [f"record {1000 * seed + step}-{row}" for row in range(batch)]


def init(model, key, *, memory=True):
    k1, k2 = jax.random.split(key)
    params = {
        "backbone": {"kernel": jax.random.normal(k1, (3, 3)) / 2, "bias": jnp.full((3,), 0.1)}
    }
    if memory:
        params["memory"] = {"kernel": jax.random.normal(k2, (3, 3)), "gate": jnp.full((3,), 0.1)}
    return params


def loss(model, train, params, clip, key, *, memory):
    rgb = jnp.asarray(clip.frames.rgb_THWC, jnp.float32) / 255
    noisy = rgb + 0.1 * jax.random.normal(key, rgb.shape)
    out = noisy @ params["backbone"]["kernel"] + params["backbone"]["bias"]
    if memory:
        out = out + (noisy @ params["memory"]["kernel"]) * params["memory"]["gate"]
    error = jnp.mean((out - rgb) ** 2)
    return error, {"loss_rgb": error}


def without_depth(clip):
    depth = np.full_like(clip.frames.depth_THW, np.nan)
    return dataclasses.replace(clip, frames=dataclasses.replace(clip.frames, depth_THW=depth))


def without_depth_at(bad):
    """Clips whose depth is NaN at one step of each stage."""

    def poisoned(*args, start_step=0, **options):
        source = clips(*args, start_step=start_step, **options)
        for number, clip in enumerate(source, start_step + 1):
            yield without_depth(clip) if number == bad else clip

    return poisoned


def loss_of_depth(model, train, params, clip, key, *, memory):
    value, metrics = loss(model, train, params, clip, key, memory=memory)
    return value * jnp.where(jnp.isnan(clip.frames.depth_THW).any(), jnp.nan, 1.0), metrics


def replaced(loss):
    """Return PEWM's stages with the small model and some loss."""
    return tuple(
        dataclasses.replace(
            stage,
            init=functools.partial(init, memory=stage.memory),
            loss=functools.partial(loss, memory=stage.memory),
        )
        for stage in pewm.STAGES
    )


STAGES = replaced(loss)
RULES = ((r"(backbone|memory)/(kernel|bias|gate)", sharding.WHOLE),)


def install(patch, loss=loss):
    """Put the small model and its clips in place of the real ones."""
    real = pewm.PEWM.sharding
    patch.setattr(pewm, "STAGES", replaced(loss))
    patch.setattr(pewm.PEWM, "sharding", lambda model: (*RULES, *real(model)))
    patch.setattr(loader, "clips", clips)
    patch.setattr(loader, "records", records)


@pytest.fixture
def fake_model(monkeypatch):
    install(monkeypatch)
