"""The weights of DreamSim, from the folder that the package ``dreamsim`` 0.2 downloads.

    ensemble_lora/adapter_config.json, adapter_model.safetensors (or .bin)
    clip_vitb16_pretrain.pth.tar, open_clip_vitb16_pretrain.pth.tar
    checkpoints/dino_vitbase16_pretrain.pth (or beside the others)

DreamSim's training gave low-rank updates (LoRA) of queries, keys and values; they are merged into
the weights here. Files are read as data (``pickled_tensors``), and every tensor is used, or the
file is refused.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.io import tree, weights
from pewm_jax.models.dreamsim.model import ENCODERS, HEAD, KINDS, Encoder
from pewm_jax.types import Params

DINO = ("checkpoints/dino_vitbase16_pretrain.pth", "dino_vitbase16_pretrain.pth")
LORA = "ensemble_lora"
Tensors = dict[str, np.ndarray]
_ADDED = re.compile(
    r".*extractor_list\.(?P<which>\d+)\.model\.blocks\.(?P<layer>\d+)\.attn\.qkv\."
    r"lora_(?P<part>[AB])(?:\.default)?\.weight"
)
_LAYER = re.compile(r"blocks\.(\d+)\.(.+)")
_PARTS = {
    "norm1.weight": "norm1/scale",
    "norm1.bias": "norm1/bias",
    "attn.qkv.weight": "qkv/kernel",
    "attn.qkv.bias": "qkv/bias",
    "attn.proj.weight": "to_out/kernel",
    "attn.proj.bias": "to_out/bias",
    "norm2.weight": "norm2/scale",
    "norm2.bias": "norm2/bias",
    "mlp.fc1.weight": "up/kernel",
    "mlp.fc1.bias": "up/bias",
    "mlp.fc2.weight": "down/kernel",
    "mlp.fc2.bias": "down/bias",
}
"""Names in a block, theirs → ours."""
_AROUND: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "pos_drop.weight": ("norm_before/scale", np.asarray),
    "pos_drop.bias": ("norm_before/bias", np.asarray),
    "norm.weight": ("norm/scale", np.asarray),
    "norm.bias": ("norm/bias", np.asarray),
    "proj": ("projection", np.asarray),
    "cls_token": ("cls_token", np.ravel),
    "pos_embed": ("position_embed", lambda x: x[0]),
    "patch_embed.proj.bias": ("patch_embed/bias", np.asarray),
    # (D, 3, p, p) → (p p 3, D)
    "patch_embed.proj.weight": (
        "patch_embed/kernel",
        lambda x: x.transpose(2, 3, 1, 0).reshape(-1, len(x)),
    ),
}
"""Names outside of blocks, theirs → ours and how the array is turned."""


def read(folder: Path) -> Params:
    """Read all encoders, with DreamSim's updates merged: ``{encoder: parameters}``, float32.

    Raises:
        UserError: a file is absent or damaged, or holds other tensors than expected.
    """
    if not folder.is_dir():
        raise UserError(
            f"{folder} is not a folder: no package contains DreamSim's weights; name the folder "
            "that the package dreamsim 0.2 downloads them to."
        )
    config = folder / LORA / "adapter_config.json"
    try:
        settings = json.loads(config.read_text("utf-8"))
        scale = float(settings["lora_alpha"]) / float(settings["r"])
    except (OSError, ValueError, KeyError, TypeError, ZeroDivisionError):
        raise UserError(
            f"{config} is absent, or does not give r and lora_alpha: name the folder that the "
            "package dreamsim 0.2 keeps its weights in."
        ) from None
    added = _added(_first(folder / LORA, ("adapter_model.safetensors", "adapter_model.bin")))
    params = {}
    for number, name in enumerate(ENCODERS):
        files = DINO if name == "dino_vitb16" else (f"{name}_pretrain.pth.tar",)
        path = _first(folder, files)
        params[name] = _encoder(name, path, added.pop(number, {}), scale)
    if added:
        raise UserError(f"{folder / LORA} adds to encoders {sorted(added)}, but there are three.")
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), params)


def _first(folder: Path, names: tuple[str, ...]) -> Path:
    for name in names:
        if (folder / name).is_file():
            return folder / name
    raise UserError(f"{folder} has no {' or '.join(names)}, which DreamSim needs.")


def _added(path: Path) -> dict[int, dict[int, Tensors]]:
    """Return ``[encoder][layer]["A" or "B"]``."""
    found: dict[int, dict[int, Tensors]] = {}
    for name, tensor in weights.read_others(path, "DreamSim").items():
        match = _ADDED.fullmatch(name.replace("/", "."))
        if match is None:
            raise UserError(f"{path} holds {name}, which does not belong to DreamSim's ensemble.")
        layers = found.setdefault(int(match["which"]), {})
        layers.setdefault(int(match["layer"]), {})[match["part"]] = tensor
    return found


def _encoder(name: Encoder, path: Path, added: dict[int, Tensors], scale: float) -> Params:
    """Read one encoder and merge its updates."""
    theirs = {
        key.replace("/", ".").removeprefix("state_dict."): np.asarray(tensor, np.float32)
        for key, tensor in weights.read_others(path, f"DreamSim's {name}").items()
    }
    if not KINDS[name].embeds:  # the class token is taken before the last norm
        theirs = {key: tensor for key, tensor in theirs.items() if not key.startswith("norm.")}
    flat: Tensors = {}
    layers: dict[str, dict[int, np.ndarray]] = {part: {} for part in _PARTS.values()}
    unknown = []
    for key, tensor in theirs.items():
        match = _LAYER.fullmatch(key)
        if match and match[2] in _PARTS:
            layers[_PARTS[match[2]]][int(match[1])] = tensor.T if tensor.ndim == 2 else tensor
        elif key in _AROUND:
            ours, shaped = _AROUND[key]
            flat[ours] = shaped(tensor)
        else:
            unknown.append(key)
    _require_whole(name, path, flat, layers, unknown)
    depth = len(layers["qkv/kernel"])
    whole = all(set(pair) == {"A", "B"} for pair in added.values())
    if sorted(added) != list(range(depth)) or not whole:
        raise UserError(f"DreamSim's additions to {name} are incomplete; download them again.")
    for layer, pair in added.items():
        addition = scale * (pair["B"].astype(np.float32) @ pair["A"].astype(np.float32))
        layers["qkv/kernel"][layer] = layers["qkv/kernel"][layer] + addition.T
    for part, by_layer in layers.items():
        flat[f"blocks/{part}"] = np.stack([by_layer[layer] for layer in range(depth)])
    return tree.unflatten(flat)


def _require_whole(
    name: Encoder,
    path: Path,
    flat: Tensors,
    layers: dict[str, dict[int, np.ndarray]],
    unknown: list[str],
) -> None:
    """Refuse a file that lacks tensors or has unexpected ones."""
    expected = {"patch_embed/kernel", "patch_embed/bias", "cls_token", "position_embed"}
    if KINDS[name].embeds:
        expected = {ours for ours, _ in _AROUND.values()}
    depth = max(map(len, layers.values()))
    broken = [part for part, by in layers.items() if sorted(by) != list(range(max(depth, 1)))]
    wrong = [*sorted(expected ^ flat.keys()), *broken, *unknown]
    if wrong or flat["cls_token"].shape[0] % HEAD:
        raise UserError(
            f"{path} is not DreamSim's {name}: missing or unexpected are "
            f"{', '.join(wrong[:6]) or 'heads of 64 channels'}."
        )
