"""Adapters of peft and diffusers come in, and adapters are merged, to rounding."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.torch
import torch

import pewm_jax
from pewm_jax.cli import main as program
from pewm_jax.convert import adapters, cogvideox
from pewm_jax.io import tree, weights
from pewm_jax.models.cogvideox import model as dit
from tests.convert import pipelines

WORLD = ["--rgbd", "--camera", "--memory", "--frames", "9", "--height", "32", "--width", "32"]
TARGETS = ("to_q", "to_k", "to_v", "to_out.0")


def run(*argv):
    assert program.main(["convert", *(str(word) for word in argv)]) == 0


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    return pipelines.save(tmp_path_factory.mktemp("2b"), "2b")


@pytest.fixture(scope="module")
def imported(images, tmp_path_factory):
    dst = tmp_path_factory.mktemp("imported") / "dst"
    run("import", "cogvideox", images, dst)
    return dst


@pytest.fixture(scope="module")
def widened(images, tmp_path_factory):
    dst = tmp_path_factory.mktemp("widened") / "dst"
    run("import", "cogvideox", images, dst, *WORLD)
    return dst


def pairs(rank=3, width=32, layers=2, skip=()):
    """Return random pairs (A, B) by the reference's layer, in torch's layout."""
    generator = torch.Generator().manual_seed(0)
    return {
        f"transformer_blocks.{layer}.attn1.{name}": (
            0.3 * torch.randn(rank, width, generator=generator),
            0.3 * torch.randn(width, rank, generator=generator),
        )
        for layer in range(layers)
        for name in TARGETS
        if (layer, name) not in skip
    }


def save(folder, made, *, form="peft", metadata=None):
    """Write pairs as diffusers' ``save_lora_weights`` does, or in its older form."""
    folder.mkdir(parents=True, exist_ok=True)
    tensors = {}
    for layer, (a, b) in made.items():
        if form == "peft":
            names = f"transformer.{layer}.lora_A.weight", f"transformer.{layer}.lora_B.weight"
        else:
            block, name = layer.rsplit(".attn1.", 1)
            name = f"transformer.{block}.attn1.processor.{name.removesuffix('.0')}_lora"
            names = f"{name}.down.weight", f"{name}.up.weight"
        tensors |= dict(zip(names, (a, b), strict=True))
    file = folder / "pytorch_lora_weights.safetensors"
    safetensors.torch.save_file(tensors, file, metadata)
    return folder


def reference(made, scale=1.0):
    """Return the reference's network with the adapters in its weights."""
    network = pipelines.dit("2b")
    state = network.state_dict()
    for layer, (a, b) in made.items():
        state[f"{layer}.weight"] = state[f"{layer}.weight"] + scale * b @ a
    network.load_state_dict(state)
    return network


def outputs(network, config, params):
    """Return what the reference and our network predict from the same input."""
    rng = np.random.default_rng(0)
    latents = rng.normal(size=(1, 3, 4, 4, 4)).astype(np.float32)
    text = rng.normal(size=(1, 6, 12)).astype(np.float32)
    mine = dit.apply(config, params, jnp.asarray(latents), jnp.asarray(text), jnp.array([7.0]))
    with torch.no_grad():
        theirs = network(
            torch.from_numpy(latents.transpose(0, 1, 4, 2, 3)),
            torch.from_numpy(text),
            torch.tensor([7]),
        ).sample
    return np.asarray(mine), theirs.numpy().transpose(0, 1, 3, 4, 2)


@pytest.mark.parametrize("form", ["peft", "older"])
def test_diffusers_adapters_give_the_reference_s_output(imported, tmp_path, form):
    made = pairs()
    run("import", "lora", save(tmp_path / "lora", made, form=form), tmp_path / "dst",
        "--base", imported)  # fmt: skip
    config, params = cogvideox.load_transformer(tmp_path / "dst")
    mine, theirs = outputs(reference(made), config, params)
    np.testing.assert_allclose(mine, theirs, atol=1e-4)
    plain = np.asarray(outputs(reference({}), *cogvideox.load_transformer(imported))[0])
    assert np.abs(plain - mine).max() > 1e-2
    assert (tmp_path / "dst/vae/weights.safetensors").is_file()
    assert cogvideox.load_base(tmp_path / "dst") == cogvideox.load_base(imported)


def test_alpha_is_read_from_the_metadata_and_ranks_may_differ(tmp_path):
    made = pairs(skip=[(0, "to_v")])
    first = next(iter(made))
    made[first] = (torch.randn(1, 32), torch.randn(32, 1))
    values = {"transformer.r": 3, "transformer.lora_alpha": 6, "transformer.alpha_pattern": {}}
    metadata = {"lora_adapter_metadata": json.dumps(values)}
    published = adapters.read_published(save(tmp_path / "one", made, metadata=metadata))
    for name, (a, b) in made.items():
        np.testing.assert_allclose(published[name].a, a)
        np.testing.assert_allclose(published[name].b, b * 6 / a.shape[0], rtol=1e-6)
    network = adapters.NETWORKS[0]
    settings = network.config_class(layers=2, heads=2, head_dim=16, in_channels=4, out_channels=4)
    like = {path: x.shape for path, x in tree.flatten(network.like(settings)).items()}
    found, rank = adapters.convert(published, network.entries(settings), like)
    assert rank == 3
    b = found["lora"]["blocks"]["to_v"]["kernel"]["b"]
    assert b.shape == (2, 3, 32)
    assert not b[0].any()
    delta = found["lora"]["blocks"]["to_q"]["kernel"]
    whole = delta["a"][0] @ delta["b"][0]
    np.testing.assert_allclose(whole, (made[first][1] @ made[first][0]).T * 6, rtol=1e-4, atol=1e-5)


def test_a_world_loads_adapters_and_is_merged(widened, tmp_path):
    made = pairs()
    run("import", "lora", save(tmp_path / "lora", made), tmp_path / "adapted", "--base", widened)
    found = weights.load(tmp_path / "adapted/weights.safetensors")
    assert set(found) == {"lora"}
    run("merge", tmp_path / "adapted", tmp_path / "merged")
    before, (config, adapted) = pewm_jax.load(widened)[1], pewm_jax.load(tmp_path / "adapted")
    plain, merged = pewm_jax.load(tmp_path / "merged")
    assert config.train.lora.rank == 3
    assert (plain.train.lora.rank, plain.train.start) == (0, "")
    assert set(weights.load(tmp_path / "merged/weights.safetensors")) == set(before)
    assert (tmp_path / "merged/base.json").is_file()
    moved = set()
    for path, leaf in tree.flatten(merged).items():
        assert np.asarray(leaf).tobytes() == np.asarray(tree.flatten(adapted)[path]).tobytes()
        if np.abs(leaf - tree.flatten(before)[path]).max() > 0:
            moved.add(path)
    assert moved == {
        f"backbone/blocks/{name}/kernel" for name in ("to_q", "to_k", "to_v", "to_out")
    }
    a, b = made["transformer_blocks.1.attn1.to_k"]
    delta = (
        merged["backbone"]["blocks"]["to_k"]["kernel"]
        - before["backbone"]["blocks"]["to_k"]["kernel"]
    )
    np.testing.assert_allclose(delta[1], (b @ a).T, atol=1e-5)
    run("export", "diffusers", tmp_path / "merged", tmp_path / "theirs")
    assert program.main(
        ["convert", "export", "diffusers", str(tmp_path / "adapted"), str(tmp_path / "no")]
    ) == 2  # fmt: skip


def test_what_cannot_be_read_is_refused(widened, tmp_path, capsys):
    def refused(folder, message):
        argv = [
            "convert",
            "import",
            "lora",
            str(folder),
            str(tmp_path / "dst"),
            "--base",
            str(widened),
        ]
        assert program.main(argv) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "dst").exists()

    refused(tmp_path / "nothing", "is no file, and no folder with")
    refused(save(tmp_path / "wide", pairs(width=64)), "fit no weight of the network")
    refused(save(tmp_path / "deep", pairs(layers=4)), "transformer_blocks.2.attn1.to_k")
    folder = save(tmp_path / "dora", pairs())
    tensors = safetensors.torch.load_file(folder / adapters.FILES[0])
    more = {"transformer.transformer_blocks.0.attn1.to_q.lora_magnitude_vector": torch.ones(3)}
    safetensors.torch.save_file(tensors | more, folder / adapters.FILES[0])
    refused(folder, "lora_magnitude_vector")
    assert program.main(["convert", "merge", str(widened), str(tmp_path / "dst")]) == 2
    assert "holds no adapters" in capsys.readouterr().err
