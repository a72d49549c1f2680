"""A world with everything in it that a converted checkpoint brings: VAE, DINOv2, a prompt."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax import config as configs
from pewm_jax import worlds
from pewm_jax.codecs import rgbd, signals
from pewm_jax.config import ConfigError, DataConfig, StageConfig, TrainConfig, UserError
from pewm_jax.data import loader
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.io import tree, weights
from pewm_jax.memory.voxel_map import VoxelConfig
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.cogvideox.vae import VAECodec
from pewm_jax.models.dinov2.config import DINOv2Config
from pewm_jax.models.dinov2.model import DINOv2EncoderConfig
from pewm_jax.readers.attention import AttentionConfig
from pewm_jax.train import loop
from pewm_jax.types import Clip, Control
from pewm_jax.worlds import rollouts, world_model
from tests.helpers import random_frames, randomise, tiny_config

VAE = VAECodec(widths=(8, 8, 8), resnets=1, groups=4, latent_channels=4, sample_height=16)
STAGE = StageConfig(steps=2, batch=2, warmup=1)


def full_config(**sections):
    memory = VoxelConfig(
        cell_m=(0.5, 0.5, 0.5),
        cells=(16, 16, 8),
        capacity=256,
        tokens=16,
        encoder=DINOv2EncoderConfig(
            size=28, network=DINOv2Config(layers=1, heads=2, width=16, pretrained_size=28)
        ),
        reader=AttentionConfig(heads=8, head_dim=8),
    )
    backbone = DiTBackbone(
        layers=1,
        heads=2,
        head_dim=16,
        patch_t=2,
        text_length=3,
        text_dim=8,
        time_dim=16,
        prompt="stored",
    )
    return tiny_config(
        **{
            "codec": VAE,
            "backbone": backbone,
            "memory": memory,
            "noise": DDPMConfig(sample_steps=2, target="v"),
            **sections,
        }
    )


@pytest.fixture(scope="module")
def world():
    config = full_config()
    params = jax.jit(lambda key: world_model.init(config.model, key))(jax.random.key(0))
    return config, randomise(params, scale=0.1)


def clips(config, split="train", *, seed, batch, start_step=0, **_):
    """Random clips in place of a data set."""
    assert split == "train"
    while True:
        rng = np.random.default_rng([seed, start_step])
        drawn = [
            Clip(
                random_frames(rng, config.model.clip.frames),
                random_frames(rng, 2),
                np.ones(2, bool),
            )
            for _ in range(batch)
        ]
        yield jax.tree.map(lambda *x: np.stack(x), *drawn)
        start_step += 1


@pytest.mark.slow
def test_it_has_every_part_and_rolls_out(world):
    config, params = world
    assert set(params) == {"backbone", "memory", "codec", "encoder", "text"}
    state = worlds.start(config, params, random_frames(np.random.default_rng(0), 2))
    assert state.map.features_VF.shape[-1] == config.model.memory.encoder.network.width
    roll = jax.jit(rollouts.rollout, static_argnums=0)
    after, frames = roll(config, params, state, jnp.zeros(8, jnp.int32), jax.random.key(0))
    assert frames.rgb_THWC.shape == (8, 16, 24, 3)
    assert np.isfinite(frames.rgb_THWC).all()
    assert np.isfinite(frames.depth_THW).all()
    assert int(after.map.occupied) >= int(state.map.occupied) > 0


@pytest.mark.slow
def test_text_and_encoder_matter_and_depth_goes_through_the_vae(world):
    config, params = world
    model = config.model
    frames = random_frames(np.random.default_rng(1), 9)
    batch = jax.tree.map(lambda x: jnp.asarray(x)[None], signals.as_signal(frames))
    observed = jax.tree.map(lambda x: x[:, :1], batch)
    said = world_model.condition(model, params, observed, Control(batch.camera)).backbone
    np.testing.assert_array_equal(said.tokens_BLC[0], params["text"]["prompt_LC"])
    latents = rgbd.encode_rgbd(model, params, batch.rgb_THWC, batch.depth_THW)
    assert latents.shape == (1, 3, 4, 6, 8)
    grey = signals.signal_from_depth(model.clip, batch.depth_THW)[..., None].repeat(3, -1)
    alone = model.codec.encode(params["codec"], grey)
    np.testing.assert_allclose(latents[..., 4:], alone, atol=1e-5)
    rgb, depth = rgbd.decode_rgbd(model, params, latents)
    assert rgb.shape == (1, 9, 16, 24, 3)
    assert depth.shape == (1, 9, 16, 24)
    compiled = jax.jit(rgbd.decode_rgbd, static_argnums=0)(model, params, latents)
    np.testing.assert_allclose(compiled[0], rgb, atol=1e-4)
    np.testing.assert_allclose(compiled[1], depth, rtol=1e-3)
    one = model.memory.encoder.encode(params["encoder"], frames.rgb_THWC / 127.5 - 1)
    assert one.shape == (9, 2, 2, 16)


@pytest.mark.slow
def test_only_an_inverting_vae_divides_the_image_latents_by_its_factor(world):
    _, params = world
    image = np.random.default_rng(2).uniform(-1, 1, (1, 1, 16, 24, 3)).astype(np.float32)
    for inverts, power in ((False, 0), (True, 2)):
        settings = dataclasses.replace(VAE, invert_scale_latents=inverts)
        plain = settings.encode(params["codec"], image)
        shown = settings.encode(params["codec"], image, condition=True)
        np.testing.assert_allclose(shown * VAE.scaling_factor**power, plain, rtol=1e-5, atol=1e-6)


def test_unmeasured_depth_weighs_nothing(world):
    config, _ = world
    depth = np.ones((1, 9, 16, 24), np.float32)
    depth[:, 1:5, :4, :4] = 0
    depth[:, 5:, :4, :2] = 0
    share = np.asarray(rgbd.measured(config.model, depth))
    assert share.shape == (1, 3, 4, 6, 1)
    assert share[0, 1, 0, 0, 0] == 0
    assert share[0, 2, 0, 0, 0] == 0.5
    assert (share == 1).sum() == share.size - 2


def test_frames_that_decode_to_another_number_are_refused():
    clip = dataclasses.replace(full_config().model.clip, frames=13)
    with pytest.raises(ConfigError, match=r"8k \+ 1"):
        full_config(clip=clip)
    with pytest.raises(UserError, match=r"2 latents decode to 8 frames.*5 frames were expected"):
        VAE.decode({}, jnp.zeros((1, 2, 4, 6, 4)))


@pytest.mark.slow
def test_training_needs_converted_weights_and_leaves_them_alone(world, tmp_path, monkeypatch):
    monkeypatch.setattr(loader, "clips", clips)
    config, params = world
    train = TrainConfig(run=str(tmp_path / "run"), stage1=STAGE, stage2=STAGE, preview_every=0)
    config = dataclasses.replace(config, train=train, data=DataConfig(context=2))
    with pytest.raises(UserError, match=r"train\.start"):
        loop.train(config)

    start = tmp_path / "converted"
    start.mkdir()
    configs.save(config, start / "config.json")
    weights.save(start / "weights.safetensors", params)
    (start / "base.json").write_text("{}")
    config = dataclasses.replace(config, train=dataclasses.replace(train, start=str(start)))
    run = loop.train(config, log=lambda _: None)

    _, trained = rollouts.load_finished(run)
    before, after = tree.flatten(params), tree.flatten(trained)
    assert before.keys() == after.keys()
    for path in before:
        same = np.array_equal(before[path], after[path])
        assert same == path.startswith(("codec/", "encoder/", "text/")), path
    far = max(np.abs(after[p] - before[p]).max() for p in before if p.startswith("backbone"))
    assert far < 0.1, "stage 1 did not start from the converted weights"
    assert (run / "base.json").read_text() == "{}"
