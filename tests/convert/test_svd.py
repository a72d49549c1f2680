"""A pipeline's folder of Stable Video Diffusion becomes a world that loads, and changes nothing."""

import dataclasses

import jax
import numpy as np
import pytest
from diffusers import (
    AutoencoderKLTemporalDecoder,
    EulerDiscreteScheduler,
    UNetSpatioTemporalConditionModel,
)
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

import pewm_jax
from pewm_jax import worlds
from pewm_jax.config import ConfigError, UserError
from pewm_jax.convert import commands, svd
from pewm_jax.convert.options import ImportSVD
from pewm_jax.io import tree
from pewm_jax.models.svd.convert import BLOCK, DOWN, UP
from pewm_jax.train import loading
from tests.helpers import random_frames

UNET = {
    "block_out_channels": (32, 64),
    "num_attention_heads": (2, 4),
    "down_block_types": [DOWN[True], DOWN[False]],
    "up_block_types": [UP[False], UP[True]],
    "layers_per_block": 1,
    "cross_attention_dim": 24,
    "addition_time_embed_dim": 16,
    "projection_class_embeddings_input_dim": 48,
}
CLIP = {
    "num_hidden_layers": 1,
    "num_attention_heads": 2,
    "hidden_size": 32,
    "intermediate_size": 48,
    "image_size": 28,
    "patch_size": 14,
    "hidden_act": "gelu",
}


def pipeline(folder, projection=24):
    UNetSpatioTemporalConditionModel(**UNET).save_pretrained(folder / "unet")
    vae = AutoencoderKLTemporalDecoder(
        block_out_channels=(32, 32), down_block_types=[BLOCK] * 2, layers_per_block=2
    )
    vae.save_pretrained(folder / "vae")
    encoder = CLIPVisionModelWithProjection(CLIPVisionConfig(projection_dim=projection, **CLIP))
    encoder.save_pretrained(folder / "image_encoder")
    EulerDiscreteScheduler(
        prediction_type="v_prediction",
        timestep_type="continuous",
        timestep_spacing="leading",
        use_karras_sigmas=True,
        sigma_min=0.002,
        sigma_max=700.0,
    ).save_pretrained(folder / "scheduler")
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return pipeline(tmp_path_factory.mktemp("svd"))


def run(src, dst, **options):
    commands.import_svd(ImportSVD(src, dst, **options))


@pytest.mark.slow
def test_it_loads_with_every_tensor_and_can_be_imagined_and_trained(folder, tmp_path):
    run(folder, tmp_path / "world", height=32, width=48)
    config, params = pewm_jax.load(tmp_path / "world")
    model = config.model
    assert (model.clip.height, model.clip.width, model.noise.sigma_max) == (32, 48, 700)
    like = jax.eval_shape(lambda: worlds.init(model, jax.random.key(0)))
    assert tree.mismatches(params, like) == []
    for part, read in (
        ("backbone", svd.read_unet),
        ("codec", svd.read_vae),
        ("image", svd.read_image_encoder),
    ):
        stored = tree.flatten(read(folder)[1])
        for path, leaf in tree.flatten(params[part]).items():
            np.testing.assert_array_equal(leaf, stored[path], err_msg=path)
    assert not np.any(params["control"]["linear_2"]["kernel"])

    seen = random_frames(np.random.default_rng(0), 2, 32, 48)
    state = worlds.start(model, params, seen)
    actions = np.zeros((10, 3), np.float32)
    _, frames = jax.eval_shape(
        lambda p, s, a: worlds.imagine(model, p, s, a, jax.random.key(0)), params, state, actions
    )
    assert frames.rgb_THWC.shape == (10, 32, 48, 3)
    train = dataclasses.replace(config.train, start=str(tmp_path / "world"))
    loading.require_weights(dataclasses.replace(config, train=train))
    with pytest.raises(UserError, match=r"set train\.start to its folder"):
        loading.require_weights(config)


def test_what_does_not_fit_is_refused_before_anything_is_written(folder, tmp_path):
    with pytest.raises(ConfigError, match=r"multiples of codec\.spatial"):
        run(folder, tmp_path / "odd", height=31)
    with pytest.raises(ConfigError, match="is attended to, so use the same"):
        run(pipeline(tmp_path / "other", projection=16), tmp_path / "world")
    with pytest.raises(UserError):
        run(folder / "unet", tmp_path / "nothing")
    assert {path.name for path in tmp_path.iterdir()} == {"other"}
