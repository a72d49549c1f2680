"""CLIP's image encoder equals transformers', and its input is that of Stable Video Diffusion."""

import json

import jax
import numpy as np
import pytest
import torch
from diffusers.pipelines.stable_video_diffusion import (
    pipeline_stable_video_diffusion as svd_pipeline,
)
from safetensors.numpy import load_file, save_file
from transformers import CLIPImageProcessor, CLIPVisionConfig, CLIPVisionModelWithProjection

from pewm_jax.config import UserError
from pewm_jax.convert import pipeline, svd
from pewm_jax.models.clip import convert as clip_convert
from pewm_jax.models.clip import model
from pewm_jax.models.clip import model as clip_config
from tests.models.svd.references import distance, draw, randomise


def reference(activation="gelu", layers=2, heads=2, width=32, hidden=48, size=28, out=16):
    config = CLIPVisionConfig(
        hidden_act=activation,
        num_hidden_layers=layers,
        num_attention_heads=heads,
        hidden_size=width,
        intermediate_size=hidden,
        image_size=size,
        patch_size=14,
        projection_dim=out,
    )
    return CLIPVisionModelWithProjection(config)


@pytest.fixture(scope="module", params=["gelu", "quick_gelu"])
def pair(request, tmp_path_factory):
    network = randomise(reference(request.param))
    folder = tmp_path_factory.mktemp("clip") / "image_encoder"
    network.save_pretrained(folder)
    return network, folder, svd.read_image_encoder(folder.parent)


def test_embeddings_equal_the_reference_s(pair):
    network, _, (config, params) = pair
    images = draw(3, 28, 28, 3)
    want = network(torch.tensor(images).permute(0, 3, 1, 2)).image_embeds
    got = jax.jit(model.apply, static_argnums=0)(config, params, images)
    assert distance(got, want) < 1e-5


def test_what_is_written_back_is_what_was_read(pair, tmp_path):
    _, folder, (config, params) = pair
    svd.write_image_encoder(config, params, tmp_path / "back")
    before, after = (load_file(f / "model.safetensors") for f in (folder, tmp_path / "back"))
    assert before.keys() == after.keys()
    for key, tensor in before.items():
        np.testing.assert_array_equal(after[key], tensor)
    again = CLIPVisionModelWithProjection.from_pretrained(tmp_path / "back")
    assert again.config.hidden_act == config.activation


def test_counted_positions_are_left_behind_and_nothing_else(pair, tmp_path):
    _, folder, (_, params) = pair
    tensors = load_file(folder / "model.safetensors")
    (tmp_path / "config.json").write_text((folder / "config.json").read_text())
    counted = {clip_convert.UNUSED[0]: np.arange(5)[None]}
    save_file(tensors | counted, tmp_path / "model.safetensors")
    jax.tree.map(np.testing.assert_array_equal, svd.read_image_encoder(tmp_path)[1], params)
    save_file(tensors | {"more": np.ones(1)}, tmp_path / "model.safetensors")
    with pytest.raises(UserError, match=r"1 unexpected tensors \(more\)"):
        svd.read_image_encoder(tmp_path)


def test_the_published_size_has_the_reference_s_tensors():
    config = clip_config.CLIPVisionConfig()
    with torch.device("meta"):
        network = reference("gelu", 32, 16, 1280, 5120, 224, 1024)
    assert clip_convert.config_from_transformers(network.config.to_dict()) == config
    like = jax.eval_shape(lambda: model.init(config, jax.random.key(0)))
    want = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    assert pipeline.expected(clip_convert.entries(config), like) == want


@pytest.mark.parametrize("size", [(90, 61), (224, 40), (30, 224), (7, 20)], ids=str)
def test_images_are_prepared_as_by_the_pipeline(size):
    rgb = np.random.default_rng(0).uniform(-1, 1, (2, *size, 3)).astype(np.float32)
    resized = svd_pipeline._resize_with_antialiasing(
        torch.tensor(rgb).permute(0, 3, 1, 2), (28, 28)
    )
    processor = CLIPImageProcessor()
    want = processor(
        images=(resized + 1) / 2,
        do_normalize=True,
        do_center_crop=False,
        do_resize=False,
        do_rescale=False,
        return_tensors="pt",
    ).pixel_values
    got = model.preprocess(rgb, 28)
    assert distance(got, want.permute(0, 2, 3, 1)) < 1e-5


@pytest.mark.parametrize(
    ("setting", "value", "words"),
    [
        ("hidden_act", "relu", "supported are gelu, quick_gelu"),
        ("model_type", "siglip", "clip_vision_model only"),
        ("window", 3, "not known: window"),
        ("num_channels", 1, "only 3 is supported"),
        ("hidden_size", 2.5, "a value like 768"),
    ],
)
def test_settings_that_are_not_supported_are_refused(pair, setting, value, words):
    _, folder, _ = pair
    values = json.loads((folder / "config.json").read_text()) | {setting: value}
    with pytest.raises(UserError, match=words):
        clip_convert.config_from_transformers(values)


def test_images_of_another_shape_are_refused(pair):
    config, params = pair[2]
    with pytest.raises(UserError, match=r"clip_vision\.preprocess"):
        model.apply(config, params, draw(1, 14, 28, 3))
    with pytest.raises(UserError, match="at least 2×2 pixels"):
        model.preprocess(draw(1, 1, 5, 3))
