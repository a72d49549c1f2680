"""DreamSim equals the reference's architecture in torch, with its additions of low rank."""

import json

import jax
import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from pewm_jax.config import UserError
from pewm_jax.eval import metrics
from pewm_jax.models.dreamsim import convert as dreamsim_weights
from pewm_jax.models.dreamsim import model as dreamsim

WIDTH, DEPTH, PATCH, GRID, RANK, ALPHA = 128, 2, 4, 3, 3, 0.5


class Mlp(nn.Module):
    def __init__(self, quick):
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(WIDTH, 4 * WIDTH), nn.Linear(4 * WIDTH, WIDTH)
        self.quick = quick

    def forward(self, x):
        x = self.fc1(x)
        x = x * torch.sigmoid(1.702 * x) if self.quick else nn.functional.gelu(x)
        return self.fc2(x)


class Attention(nn.Module):
    def __init__(self):
        super().__init__()
        self.qkv, self.proj = nn.Linear(WIDTH, 3 * WIDTH), nn.Linear(WIDTH, WIDTH)
        self.lora_a = torch.randn(RANK, WIDTH)
        self.lora_b = torch.randn(3 * WIDTH, RANK)

    def forward(self, x):
        count, tokens, width = x.shape
        qkv = self.qkv(x) + ALPHA / RANK * (x @ self.lora_a.T @ self.lora_b.T)
        q, k, v = qkv.reshape(count, tokens, 3, width // 64, 64).permute(2, 0, 3, 1, 4)
        mixed = nn.functional.scaled_dot_product_attention(q, k, v)
        return self.proj(mixed.transpose(1, 2).reshape(x.shape))


class Block(nn.Module):
    def __init__(self, quick, epsilon):
        super().__init__()
        self.norm1 = nn.LayerNorm(WIDTH, eps=epsilon)
        self.attn = Attention()
        self.norm2 = nn.LayerNorm(WIDTH, eps=epsilon)
        self.mlp = Mlp(quick)

    def forward(self, x):
        x = x + self.attn(self.norm1(x))
        return x + self.mlp(self.norm2(x))


class Vit(nn.Module):
    """A vision transformer under DINO's names, as the package keeps all three."""

    def __init__(self, name):
        super().__init__()
        self.clip = name != "dino_vitb16"
        epsilon = 1e-5 if self.clip else 1e-6
        self.patch_embed = nn.Module()
        self.patch_embed.proj = nn.Conv2d(3, WIDTH, PATCH, PATCH)
        self.cls_token = nn.Parameter(torch.randn(1, 1, WIDTH))
        self.pos_embed = nn.Parameter(torch.randn(1, 1 + GRID**2, WIDTH))
        self.pos_drop = nn.LayerNorm(WIDTH, eps=epsilon) if self.clip else nn.Identity()
        quick = name == "clip_vitb16"
        self.blocks = nn.ModuleList(Block(quick, epsilon) for _ in range(DEPTH))
        self.norm = nn.LayerNorm(WIDTH, eps=epsilon)
        self.proj = torch.randn(WIDTH, 48) if self.clip else None

    def forward(self, x):
        x = self.patch_embed.proj(x).flatten(2).transpose(1, 2)
        x = torch.cat([self.cls_token.expand(len(x), -1, -1), x], 1) + self.pos_embed
        x = self.pos_drop(x)
        for block in self.blocks:
            x = block(x)
        return self.norm(x)[:, 0] @ self.proj if self.clip else x[:, 0]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The reference's encoders with random weights and norms, and its folder of files."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("dreamsim")
    (folder / "checkpoints").mkdir()
    (folder / "ensemble_lora").mkdir()
    encoders, added = {}, {}
    for number, name in enumerate(dreamsim.ENCODERS):
        encoder = encoders[name] = Vit(name)
        with torch.no_grad():
            for parameter in encoder.parameters():
                parameter.add_(0.05 * torch.randn_like(parameter))
        state = {key: value.detach() for key, value in encoder.state_dict().items()}
        for layer, block in enumerate(encoder.blocks):
            key = f"base_model.model.extractor_list.{number}.model.blocks.{layer}.attn.qkv.lora_"
            added[f"{key}A.weight"] = block.attn.lora_a
            added[f"{key}B.weight"] = block.attn.lora_b
        if encoder.clip:
            state = {"state_dict": state | {"proj": encoder.proj}}
            torch.save(state, folder / f"{name}_pretrain.pth.tar")
        else:
            torch.save(state, folder / "checkpoints" / "dino_vitbase16_pretrain.pth")
    save_file(added, folder / "ensemble_lora" / "adapter_model.safetensors")
    adapter = {"r": RANK, "lora_alpha": ALPHA, "target_modules": ["qkv"]}
    (folder / "ensemble_lora" / "adapter_config.json").write_text(json.dumps(adapter))
    return folder, encoders


def reference(encoders, images):
    """``PerceptualModel.embed`` with normalised embeddings (dreamsim/model.py, version 0.2)."""
    parts = []
    for name, encoder in encoders.items():
        kind = dreamsim.KINDS[name]
        mean, std = (torch.tensor(x).reshape(3, 1, 1) for x in (kind.mean_3, kind.std_3))
        parts.append(encoder((images - mean) / std))
    joined = torch.cat(parts, -1)
    centred = joined - joined.mean(-1, keepdim=True)
    return centred / centred.norm(dim=-1, keepdim=True)


@pytest.mark.slow
def test_the_features_and_distances_equal_the_reference(made):
    folder, encoders = made
    params = dreamsim_weights.read(folder)
    side = GRID * PATCH
    rng = np.random.default_rng(0)
    a, b = rng.uniform(size=(2, 5, side, side, 3)).astype(np.float32)
    with torch.no_grad():
        one, two = (reference(encoders, torch.from_numpy(x).permute(0, 3, 1, 2)) for x in (a, b))
    np.testing.assert_allclose(jax.jit(dreamsim.embed)(params, a), one.numpy(), atol=2e-6)
    expected = 1 - torch.nn.functional.cosine_similarity(one, two).numpy()
    np.testing.assert_allclose(dreamsim.distance(params, a, b), expected, rtol=1e-4)


@pytest.mark.slow
def test_clips_are_measured_frame_by_frame_at_any_size(made):
    metric = metrics.load("dreamsim", made[0])
    rng = np.random.default_rng(1)
    truth = rng.uniform(-1, 1, size=(2, 3, 20, 17, 3)).astype(np.float32)
    near = np.clip(truth + 0.05 * rng.normal(size=truth.shape), -1, 1).astype(np.float32)
    far = np.clip(truth + 0.8 * rng.normal(size=truth.shape), -1, 1).astype(np.float32)
    np.testing.assert_allclose(metric(truth, truth), 0, atol=1e-6)
    assert (np.asarray(metric(near, truth)) < np.asarray(metric(far, truth))).all()
    single = [float(metric(far[:, t : t + 1], truth[:, t : t + 1])[0]) for t in range(3)]
    np.testing.assert_allclose(float(metric(far, truth)[0]), np.mean(single), rtol=1e-5)


def test_other_files_are_refused_in_a_sentence(made, tmp_path):
    import shutil

    with pytest.raises(UserError, match="is not a folder: no package contains DreamSim's weights"):
        metrics.load("dreamsim", tmp_path / "nothing")
    folder = tmp_path / "copy"
    shutil.copytree(made[0], folder)
    (folder / "clip_vitb16_pretrain.pth.tar").unlink()
    with pytest.raises(UserError, match=r"has no clip_vitb16_pretrain\.pth\.tar"):
        metrics.load("dreamsim", folder)
    shutil.copy(folder / "open_clip_vitb16_pretrain.pth.tar", folder / "checkpoints" / "x")
    (folder / "checkpoints" / "x").replace(folder / "checkpoints" / "dino_vitbase16_pretrain.pth")
    with pytest.raises(UserError, match="is not DreamSim's dino_vitb16"):
        metrics.load("dreamsim", folder)
    (folder / "ensemble_lora" / "adapter_config.json").write_text("{}")
    with pytest.raises(UserError, match="does not give r and lora_alpha"):
        metrics.load("dreamsim", folder)
