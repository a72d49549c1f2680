"""DINOv2 equals transformers', in every form and read from either kind of file."""

import json

import jax
import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from transformers import (
    Dinov2Config,
    Dinov2Model,
    Dinov2WithRegistersConfig,
    Dinov2WithRegistersModel,
)

from pewm_jax.convert import dinov2, pipeline
from pewm_jax.io import sources
from pewm_jax.models.dinov2 import model
from pewm_jax.models.dinov2.config import published
from pewm_jax.models.dinov2.convert import with_transformers_names

SHRUNKEN = {"small": (64, 1), "base": (128, 2), "large": (192, 3), "giant": (192, 3)}
"""Width and heads that stand for each published size; layers: 2, and 3 for the largest."""
VARIANTS = [(size, registers) for size in SHRUNKEN for registers in (False, True)]
IMAGE = 70
"""Pixels that the shrunken models are pretrained at: 5×5 patches."""
SIZES = ((70, 70), (42, 98), (112, 28))
"""The pretrained size; and wider, taller, larger and smaller ones."""


def name(variant):
    return f"{variant[0]}{'-registers' * variant[1]}"


def reference(size, registers, *, width=None, heads=None, layers=None, image=IMAGE):
    settings = {
        "hidden_size": width or SHRUNKEN[size][0],
        "num_attention_heads": heads or SHRUNKEN[size][1],
        "num_hidden_layers": layers or 2 + (size == "giant"),
        "use_swiglu_ffn": size == "giant",
        "image_size": image,
        "patch_size": 14,
    }
    if registers:
        return Dinov2WithRegistersModel(Dinov2WithRegistersConfig(**settings)).eval()
    return Dinov2Model(Dinov2Config(**settings)).eval()


def randomise(network, seed=0):
    """Draw every tensor, norms, biases and layer scales included."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for path, parameter in network.named_parameters():
            noise = torch.randn(parameter.shape, generator=generator)
            one = ("norm" in path and path.endswith("weight")) or "lambda" in path
            scale = 1.5 * parameter.shape[-1] ** -0.5 if parameter.ndim == 2 else 0.3
            parameter.copy_(one + noise * scale)
    return network


def saved_words(tensors):
    """The tensors as transformers names them in files; in memory its version 5 has other names."""
    words = {"q_proj": "attention.query", "k_proj": "attention.key", "v_proj": "attention.value"}
    words |= {"o_proj": "output.dense", "down_proj": "weights_out", "gate_proj": "weights_in"}
    saved = {}
    for name, tensor in tensors.items():
        if ".up_proj." in name:
            continue
        parts = [tensor]
        if ".gate_proj." in name:
            parts.append(tensors[name.replace("gate_proj", "up_proj")])
        renamed = name
        for ours, theirs in words.items():
            renamed = renamed.replace(f".{ours}.", f".{theirs}.")
        saved[renamed] = torch.cat(parts) if len(parts) > 1 else tensor
    return saved


def original_words(network):
    """The same tensors as the original repository names and fuses them."""
    theirs = {}
    saved = saved_words(network.state_dict())
    layers = network.config.num_hidden_layers
    embeddings = "embeddings."
    theirs["cls_token"] = saved[embeddings + "cls_token"]
    theirs["mask_token"] = saved[embeddings + "mask_token"]
    theirs["pos_embed"] = saved[embeddings + "position_embeddings"]
    if embeddings + "register_tokens" in saved:
        theirs["register_tokens"] = saved[embeddings + "register_tokens"]
    for end in ("weight", "bias"):
        theirs[f"patch_embed.proj.{end}"] = saved[f"{embeddings}patch_embeddings.projection.{end}"]
        theirs[f"norm.{end}"] = saved[f"layernorm.{end}"]
        for layer in range(layers):
            ours, block = f"encoder.layer.{layer}.", f"blocks.{layer}."
            three = ("query", "key", "value")
            qkv = [saved[f"{ours}attention.attention.{n}.{end}"] for n in three]
            theirs[f"{block}attn.qkv.{end}"] = torch.cat(qkv)
            theirs[f"{block}attn.proj.{end}"] = saved[f"{ours}attention.output.dense.{end}"]
            for n in "12":
                theirs[f"{block}norm{n}.{end}"] = saved[f"{ours}norm{n}.{end}"]
                theirs[f"{block}ls{n}.gamma"] = saved[f"{ours}layer_scale{n}.lambda1"]
            if network.config.use_swiglu_ffn:
                theirs[f"{block}mlp.w12.{end}"] = saved[f"{ours}mlp.weights_in.{end}"]
                theirs[f"{block}mlp.w3.{end}"] = saved[f"{ours}mlp.weights_out.{end}"]
            else:
                for n in "12":
                    theirs[f"{block}mlp.fc{n}.{end}"] = saved[f"{ours}mlp.fc{n}.{end}"]
    return {key: value.contiguous() for key, value in theirs.items()}


@pytest.fixture(scope="module", params=VARIANTS, ids=name)
def pair(request, tmp_path_factory):
    network = randomise(reference(*request.param))
    folder = tmp_path_factory.mktemp("dinov2") / "theirs"
    network.save_pretrained(folder)
    return network, folder, dinov2.read(folder)


def images(size, batch=2):
    return np.random.default_rng(1).normal(size=(batch, *size, 3)).astype(np.float32)


def patch_tokens(network, batch, dtype=torch.float32):
    registers = getattr(network.config, "num_register_tokens", 0)
    with torch.no_grad():
        out = network(torch.tensor(batch).permute(0, 3, 1, 2).to(dtype)).last_hidden_state
    height, width = batch.shape[1] // 14, batch.shape[2] // 14
    return out[:, 1 + registers :].float().numpy().reshape(len(batch), height, width, -1)


@pytest.mark.slow(only=("base", "large", "giant"))
def test_patch_tokens_equal_the_reference_at_every_size(pair):
    network, _, (config, params) = pair
    compute = jax.jit(model.apply, static_argnums=0)
    for size in SIZES:
        batch = images(size)
        want, got = patch_tokens(network, batch), compute(config, params, batch)
        assert got.shape == (2, size[0] // 14, size[1] // 14, config.width)
        assert np.abs(got - want).max() <= 1e-5 * np.abs(want).max(), size


@pytest.mark.slow(only=("base", "large"))
def test_the_class_token_equals_the_reference(pair):
    network, _, (config, params) = pair
    batch = images((42, 98))
    with torch.no_grad():
        want = network(torch.tensor(batch).permute(0, 3, 1, 2)).pooler_output.numpy()
    got = jax.jit(model.summary, static_argnums=0)(config, params, batch)
    assert got.shape == (2, config.width)
    assert np.abs(got - want).max() <= 1e-5 * np.abs(want).max()


def test_an_original_state_dict_gives_the_same_parameters(pair, tmp_path):
    network, _, (config, params) = pair
    torch.save(original_words(network), tmp_path / "dinov2_pretrain.pth")
    save_file(original_words(network), tmp_path / "tensors.safetensors")
    for source in (tmp_path / "dinov2_pretrain.pth", tmp_path / "tensors.safetensors"):
        again, read = dinov2.read(source)
        assert again == config
        jax.tree.map(np.testing.assert_array_equal, read, params)


@pytest.mark.slow
def test_bfloat16_is_as_near_as_the_reference_in_bfloat16(tmp_path):
    network = randomise(reference("base", True))
    exact = patch_tokens(network, images((70, 70)))
    network = network.to(torch.bfloat16)
    network.save_pretrained(tmp_path / "theirs")
    config, params = dinov2.read(tmp_path / "theirs")
    assert {leaf.dtype.name for leaf in jax.tree.leaves(params)} == {"bfloat16"}
    batch = images((70, 70))
    got = jax.jit(model.apply, static_argnums=0)(config, params, batch.astype(jax.numpy.bfloat16))
    theirs = patch_tokens(network, batch, torch.bfloat16)
    assert np.linalg.norm(np.float32(got) - exact) <= 1.5 * np.linalg.norm(theirs - exact)


@pytest.mark.parametrize("registers", [False, True])
@pytest.mark.parametrize("size", SHRUNKEN)
def test_published_sizes_have_the_reference_s_tensors(size, registers):
    config = published(size, registers)
    with torch.device("meta"):
        network = reference(
            size,
            registers,
            width=config.width,
            heads=config.heads,
            layers=config.layers,
            image=config.pretrained_size,
        )
    like = jax.eval_shape(lambda: model.init(config, jax.random.key(0)))
    assembled = pipeline.expected(dinov2.entries(config), like)
    source = with_transformers_names(
        sources.in_memory(
            {
                name: jax.ShapeDtypeStruct(tuple(x.shape), np.float32)
                for name, x in original_words(network).items()
            },
            "meta",
        )
    )
    assert assembled == {name: source.shape(name) for name in source.names()}
    assert sum(np.prod(shape) for shape in assembled.values()) + config.width == sum(
        parameter.numel() for parameter in network.parameters()
    )


def test_an_image_classifier_is_read_by_its_body(pair, tmp_path):
    network, folder, (config, params) = pair
    prefix = network.base_model_prefix
    tensors = {f"{prefix}.{key}": value for key, value in _saved(folder).items()}
    tensors["classifier.weight"] = torch.ones(2, config.width)
    save_file(tensors, tmp_path / "model.safetensors")
    (tmp_path / "config.json").write_text((folder / "config.json").read_text())
    again, read = dinov2.read(tmp_path)
    assert again == config
    jax.tree.map(np.testing.assert_array_equal, read, params)


def test_our_folder_holds_what_was_read(pair, tmp_path):
    _, folder, (config, params) = pair
    lines = []
    dinov2.convert(folder, tmp_path / "ours", log=lines.append)
    again, loaded = model.load(tmp_path / "ours")
    assert again == config
    jax.tree.map(np.testing.assert_array_equal, loaded, params)
    assert f"{config.layers} layers of width {config.width}" in lines[0]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ours"]
    settings = json.loads((tmp_path / "ours" / "config.json").read_text())
    assert settings["registers"] == config.registers


def _saved(folder):
    from safetensors.torch import load_file

    return load_file(folder / "model.safetensors")
