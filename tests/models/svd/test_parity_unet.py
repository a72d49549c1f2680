"""The U-Net of Stable Video Diffusion equals diffusers', per frame modulation included."""

import functools
import json

import jax
import numpy as np
import pytest
import torch
from diffusers import UNetSpatioTemporalConditionModel
from diffusers.models.resnet import SpatioTemporalResBlock
from safetensors.numpy import load_file, save_file

from pewm_jax.config import UserError
from pewm_jax.convert import pipeline, svd
from pewm_jax.models.svd import unet as model
from pewm_jax.models.svd.convert import DOWN, UNET, UP
from pewm_jax.models.svd.unet import SVDUNetBackbone
from tests.models.svd.references import distance, draw, first, randomise

SHRUNKEN = {
    "block_out_channels": (32, 64),
    "num_attention_heads": (2, 4),
    "down_block_types": [DOWN[True], DOWN[False]],
    "up_block_types": [UP[False], UP[True]],
    "layers_per_block": (1, 2),
    "transformer_layers_per_block": (1, 2),
    "cross_attention_dim": 24,
    "addition_time_embed_dim": 16,
    "projection_class_embeddings_input_dim": 48,
}
TOLERANCE = 1e-4


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    network = randomise(UNetSpatioTemporalConditionModel(**SHRUNKEN))
    folder = tmp_path_factory.mktemp("svd") / "unet"
    network.save_pretrained(folder)
    return network, folder, svd.read_unet(folder)


@functools.cache
def compiled():
    return jax.jit(model.apply, static_argnums=0)


def inputs(frames, height, width, batch=2, tokens=1):
    latents = draw(batch, frames, height, width, 8)
    times = np.linspace(-1.5, 1.6, batch).astype(np.float32)
    added = np.array([[6, 127, 0.02], [3, 180, 0.1]], np.float32)[:batch]
    return latents, times, draw(batch, tokens, 24, seed=1), added


def reference(network, latents, times, image, added):
    out = network(first(latents), *(torch.tensor(x) for x in (times, image, added))).sample
    return np.moveaxis(out.numpy(), 2, -1)


def test_it_predicts_as_the_reference_at_any_size(pair):
    network, _, (config, params) = pair
    arguments = inputs(3, 5, 7)
    got = compiled()(config, params, *arguments)
    assert distance(got, reference(network, *arguments)) < TOLERANCE


@pytest.mark.slow
def test_modulation_is_added_per_frame_wherever_the_time_modulates(pair):
    network, _, (config, params) = pair
    arguments = inputs(3, 4, 2, tokens=3)
    modulation = draw(2, 3, config.time_dim, seed=2)
    more = torch.tensor(modulation).flatten(0, 1)

    def add(_block, given, named):
        sample, time = given
        return (sample, time + more), named

    blocks = [m for m in network.modules() if isinstance(m, SpatioTemporalResBlock)]
    hooks = [b.register_forward_pre_hook(add, with_kwargs=True) for b in blocks]
    want = reference(network, *arguments)
    for hook in hooks:
        hook.remove()
    assert distance(compiled()(config, params, *arguments, modulation), want) < TOLERANCE
    assert distance(reference(network, *arguments), want) > 0.01
    zero = compiled()(config, params, *arguments, 0 * modulation)
    assert distance(zero, reference(network, *arguments)) < TOLERANCE


def test_constants_of_the_norms_are_the_reference_s(pair):
    network, _, (config, _) = pair
    for name, module in network.named_modules():
        if not name.endswith(("_res_block.norm1", "_res_block.norm2")):
            continue
        way, level = name.split(".")[:2]
        coarse = way == "mid_block" or (way == "down_blocks" and not config.attends[int(level)])
        assert module.eps == (model.EPS_COARSE if coarse else model.EPS), name
    assert network.conv_norm_out.eps == model.EPS_COARSE


def test_what_is_written_back_is_what_was_read(pair, tmp_path):
    _, folder, (config, params) = pair
    svd.write_unet(config, params, tmp_path / "back")
    name = "diffusion_pytorch_model.safetensors"
    before, after = load_file(folder / name), load_file(tmp_path / "back" / name)
    assert before.keys() == after.keys()
    for key, tensor in before.items():
        np.testing.assert_array_equal(after[key], tensor)
    again = UNetSpatioTemporalConditionModel.from_pretrained(tmp_path / "back")
    assert UNET.read_config(dict(again.config)) == config


@pytest.mark.slow
def test_the_published_size_has_the_reference_s_tensors():
    with torch.device("meta"):
        network = UNetSpatioTemporalConditionModel()
    config = UNET.read_config(dict(network.config))
    assert config == SVDUNetBackbone()
    like = jax.eval_shape(lambda: model.init(config, jax.random.key(0)))
    want = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    assert pipeline.expected(UNET.entries(config), like) == want


def test_every_tensor_must_be_used_and_there(pair, tmp_path):
    _, folder, _ = pair
    name = "diffusion_pytorch_model.safetensors"
    tensors = load_file(folder / name)
    tensors["conv_out.more"] = tensors.pop("conv_out.bias")
    (tmp_path / "config.json").write_text((folder / "config.json").read_text())
    save_file(tensors, tmp_path / name)
    with pytest.raises(UserError, match=r"lacks 1 tensors \(conv_out.bias\) and has 1 .*more"):
        svd.read_unet(tmp_path)


@pytest.mark.parametrize(
    ("setting", "value", "words"),
    [
        ("dropout", 0.1, "not known: dropout"),
        ("up_block_types", [UP[True]] * 2, "mirror image"),
        ("cross_attention_dim", [24, 32], "only one number"),
        ("layers_per_block", 1.5, "whole number"),
    ],
)
def test_settings_that_are_not_supported_are_refused(pair, setting, value, words):
    _, folder, _ = pair
    values = json.loads((folder / "config.json").read_text()) | {setting: value}
    with pytest.raises(UserError, match=words):
        UNET.read_config(values)


@pytest.mark.parametrize("which", range(4))
def test_arguments_of_another_shape_are_refused(pair, which):
    config, params = pair[2]
    arguments = list(inputs(2, 4, 4))
    arguments[which] = arguments[which][..., :-1]
    with pytest.raises(UserError, match=r"must be|channels last"):
        model.apply(config, params, *arguments)
