"""Cosmos' transformer with actions in training, and the same beside a memory."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import worlds
from pewm_jax.codecs import rgbd
from pewm_jax.config import (
    ClipConfig,
    Config,
    ConfigError,
    DataConfig,
    MeshConfig,
    StageConfig,
    TrainConfig,
)
from pewm_jax.controls.actions import ModulationConfig
from pewm_jax.data import abstract
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.io import tree
from pewm_jax.models.cosmos.backbone import CosmosBackbone
from pewm_jax.models.wan.vae import WanVAECodec
from pewm_jax.plan import program
from pewm_jax.plan.measure import QUICK
from pewm_jax.train import flops, sharding
from pewm_jax.train import step as state
from pewm_jax.worlds import world_model
from pewm_jax.worlds.egowm.world import EgoWM, EgoWMTrainConfig
from tests.helpers import TINY, init_world, random_frames, randomise, with_reader
from tests.train import fakes
from tests.train.test_egowm import changed, trained

COSMOS = CosmosBackbone(
    layers=2, heads=2, head_dim=16, mlp_ratio=2.0, text_dim=24, text_length=3, lora_dim=8
)
VAE = WanVAECodec(
    latent_channels=4,
    base_width=4,
    decoder_base_width=4,
    multiples=(1, 1),
    resnets=1,
    halves_time=(True,),
    latents_mean=(0.1, -0.2, 0.3, 0.0),
    latents_std=(0.5, 1.5, 1.0, 2.0),
    convolution="volume",  # whose work is that of the sums
    depth=False,
)
NOISE = EDMConfig(sigma_data=1.0, target="flow", ends="sigma_min", sample_steps=2)
MODEL = EgoWM(
    clip=ClipConfig(frames=5, height=16, width=12, depth=False),
    codec=VAE,
    backbone=COSMOS,
    control=ModulationConfig(projection="convolution"),
    noise=NOISE,
)
STAGE = StageConfig(steps=4, batch=2, warmup=0, learning_rate=1e-3)


@pytest.fixture(scope="module")
def stepped():
    train = EgoWMTrainConfig(adapt=STAGE, mesh=MeshConfig())
    config = Config(model=MODEL, data=DataConfig(context=1), train=train)
    stage = worlds.stages(MODEL)[1]
    return config, stage, *trained(config, stage)


@pytest.mark.slow
def test_the_transformer_learns_with_actions_and_the_codec_stands_still(stepped):
    _, _, first, last, losses, _ = stepped
    assert losses[-1] < losses[0]
    assert changed(first, last.params) == {"backbone", "control"}
    cells = COSMOS.patch**2
    assert first["backbone"]["patch_embed"]["kernel"].shape == (cells * (4 + 1 + 1), 32)


@pytest.mark.slow
def test_its_sums_are_those_of_the_compiled_step(stepped):
    config, stage, *_, text = stepped
    needed = flops.of_stage(config, stage, abstract.clip(config, 2)).total
    assert needed == pytest.approx(program.read(text).flops, rel=0.02)


def test_every_leaf_has_its_place_on_many_devices():
    config = Config(model=MODEL, train=EgoWMTrainConfig(adapt=STAGE))
    mesh = jax.sharding.AbstractMesh((1, 4, 2, 1), ("data", "fsdp", "tensor", "context"))
    stage = worlds.stages(MODEL)[1]
    shapes = jax.eval_shape(functools.partial(state.create, config, stage), jax.random.key(0))
    placed = tree.flatten(sharding.of_state(MODEL, mesh, shapes))
    for path, leaf in tree.flatten(shapes).items():
        split = [axis for axis in placed[path].spec if axis]
        small = leaf.size <= 2048 or path.endswith(("scale", "bias"))
        assert split or small or "codec" in path, f"{path} {leaf.shape} is whole"


@pytest.mark.slow
def test_frames_that_are_given_do_not_count_in_the_loss(monkeypatch):
    def latents(model, _params, rgb, _depth, **_):
        grid = (model.codec.frames(rgb.shape[1]), *model.latent_shape[1:], model.codec.channels)
        return jnp.zeros((len(rgb), *grid))

    monkeypatch.setattr(rgbd, "encode_rgbd", latents)
    config = Config(model=MODEL, data=DataConfig(context=1), train=EgoWMTrainConfig(blind=0.5))
    params = {"control": jax.jit(MODEL.control.init, static_argnums=0)(MODEL, jax.random.key(0))}
    batch = jax.tree.map(np.asarray, fakes.clip(config, 1, 0))

    def loss(wrong_at):
        def predicted(_model, _params, noisy, *_):
            return jnp.zeros_like(noisy).at[:, wrong_at].add(3.0)

        monkeypatch.setattr(world_model, "apply", predicted)
        stage = worlds.stages(MODEL)[1]
        return float(stage.loss(MODEL, config.train, params, batch, jax.random.key(0))[0])

    right, at_given, at_other = (loss(where) for where in (slice(0, 0), 0, 1))
    assert at_given == right
    assert at_other > right + 1


PEWM = dataclasses.replace(
    with_reader(TINY, looks=8),
    clip=ClipConfig(frames=5, height=16, width=16),
    codec=dataclasses.replace(VAE, depth=True),
    backbone=dataclasses.replace(COSMOS, layers=1),
    control=ModulationConfig(projection="convolution", rays=True),
    noise=NOISE,
)
"""The world ``pewm``: depth beside colour, rays beside actions, memory blocks after its blocks."""
LATER = dataclasses.replace(
    MODEL, clip=dataclasses.replace(MODEL.clip, frames=9), history=5, dtype="bfloat16"
)


@pytest.mark.parametrize("model", [PEWM, LATER], ids=["pewm", "egowm"])
def test_worlds_on_cosmos_imagine_and_compare_candidates(model):
    clip = model.clip
    seen = random_frames(np.random.default_rng(0), 2, clip.height, clip.width)

    def shapes(key):
        params = worlds.init(model, key)
        state = worlds.start(model, params, seen)
        plans, keys = jnp.zeros((3, 7, 3)), jax.random.split(key, 3)
        _, alone = worlds.imagine(model, params, state, plans[0], key)
        _, many = worlds.imagine_many(model, params, state, plans, keys)
        return alone.rgb_THWC, many.rgb_THWC

    alone, many = jax.eval_shape(shapes, jax.random.key(0))
    assert alone.shape == (7, clip.height, clip.width, 3)
    assert many.shape == (3, *alone.shape)


@pytest.mark.slow
def test_actions_and_a_memory_on_cosmos():
    model = PEWM
    assert model.in_channels == 8 + 1 + 12
    config = Config(model=model, data=DataConfig(context=1), train=TrainConfig(stage2=STAGE))
    stage = worlds.stages(model)[1]
    fresh = init_world(model)
    read = randomise(fresh, scale=0.1) | {"backbone": fresh["backbone"], "codec": fresh["codec"]}
    batch = jax.tree.map(np.asarray, fakes.clip(config, 1, 0))
    given = fresh, batch, jax.random.key(0)
    traced = jax.jit(stage.loss, static_argnums=(0, 1)).lower(model, config.train, *given)
    loss = traced.compile(compiler_options=QUICK)
    one, other = (
        float(loss(params, *given[1:])[0])
        for params in (fresh, {**fresh, "memory": read["memory"]})
    )
    assert np.isfinite(one)
    assert abs(one - other) > 1e-4


def test_frames_that_share_a_token_are_refused():
    with pytest.raises(ConfigError, match="a token covers one latent frame"):
        dataclasses.replace(MODEL, backbone=dataclasses.replace(COSMOS, patch_t=2))
