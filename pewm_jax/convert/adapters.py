"""Adapters: merge them into their weights, and import those that peft and diffusers wrote.

A published adapter of a linear layer is ``NAME.lora_A.weight`` (rank, in) and
``NAME.lora_B.weight`` (out, rank); of a convolution, a convolution to ``rank`` channels and a
pointwise one. ``NAME`` is the layer's name in the network's table (``models/<family>/convert.py``).
The factor alpha / rank is in the file's metadata (``lora_adapter_metadata``), in
``adapter_config.json``, or in a tensor ``NAME.alpha``; otherwise it is 1, as diffusers reads such a
file.
"""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax import config as configuration
from pewm_jax.config import Config, LoRAConfig, UserError
from pewm_jax.convert import cogvideox, inference, pipeline
from pewm_jax.io import sources, tensor_files, tree, weights
from pewm_jax.io.published import Entry, Network
from pewm_jax.models.cogvideox import convert as cogvideox_names
from pewm_jax.models.cosmos import convert as cosmos_names
from pewm_jax.models.svd import convert as svd_names
from pewm_jax.nn.deferred import is_matrix
from pewm_jax.train import loading, runs
from pewm_jax.types import Params
from pewm_jax.worlds import lora

FILES = ("pytorch_lora_weights.safetensors", "adapter_model.safetensors")
NETWORKS = (cogvideox_names.TRANSFORMER, cosmos_names.TRANSFORMER, svd_names.UNET)
_PREFIXES = r"^(base_model\.model\.|transformer\.|unet\.)+"
_NAMES = (
    (r"\.lora_A(\.default)?\.weight$", "a"),
    (r"\.lora_B(\.default)?\.weight$", "b"),
    (r"[._]lora[._]down\.weight$", "a"),
    (r"[._]lora[._]up\.weight$", "b"),
    (r"\.alpha$", "alpha"),
)
"""Endings of tensor names → the part of an adapter, in the forms of peft and of older diffusers."""
_METADATA = "lora_adapter_metadata"


@dataclasses.dataclass(frozen=True)
class Published:
    """One published adapter, in the reference's layout.

    Attributes:
        a: (rank, in, …).
        b: (out, rank, …), multiplied by alpha / rank.
    """

    a: np.ndarray
    b: np.ndarray


def merge(src: Path, dst: Path) -> Path:
    """Write the weights of a run with adapters as a plain folder, which ``pewm_jax.load`` reads.

    Raises:
        UserError: ``dst`` exists, or ``src`` has no adapters or not the weights that they adapt.
    """
    pipeline.refuse_existing(dst)
    config, params = loading.load(src)
    if not config.train.lora.rank:
        raise UserError(f"{src} holds no adapters: its weights are whole already.")
    train = dataclasses.replace(config.train, lora=LoRAConfig(), start="")
    file = src / runs.WEIGHTS
    facts = weights.metadata(file) if file.is_file() else {}
    facts = {name: facts[name] for name in ("stage", "step") if name in facts}
    with pipeline.new_folder(dst) as folder:
        configuration.save(dataclasses.replace(config, train=train), folder / runs.CONFIG)
        size = tensor_files.size(tree.flatten(params))
        with pipeline.megabytes("write weights", size) as progress:
            weights.save(folder / runs.WEIGHTS, params, facts, progress)
        if (origin := inference.base_record(src, config)) is not None:
            shutil.copyfile(origin, folder / runs.BASE)
    return dst


def import_adapters(src: Path, dst: Path, base: Path) -> str:
    """Write published adapters as a folder of ours, or merged into an imported pipeline.

    Args:
        src: a file, or a folder with one of ``FILES``.
        dst: the folder to create.
        base: the weights that they adapt: a world model's folder, which ``dst`` then refers to; or
            a folder of ``import cogvideox``, of which ``dst`` becomes a copy with merged weights.

    Returns:
        What was written.

    Raises:
        UserError: ``dst`` exists, a file is missing or damaged, or an adapter fits no weight.
    """
    pipeline.refuse_existing(dst)
    published = read_published(src)
    if (base / cogvideox_names.TRANSFORMER.folder / pipeline.CONFIG).is_file():
        _merge_into_pipeline(published, dst, base)
        return f"CogVideoX in our layout, {len(published)} adapters merged"
    config = configuration.load(base / runs.CONFIG)
    network = _network_of(config, base)
    like = {
        path: np.shape(x) for path, x in tree.flatten(weights.lazy(base / runs.WEIGHTS)).items()
    }
    entries = network.entries(config.model.backbone)  # type: ignore[attr-defined]
    adapters, rank = convert(published, entries, like, "backbone/")
    target = "|".join(re.escape(path) for path, _, _ in lora.adapters_of(adapters))
    own = LoRAConfig(rank=rank, target=target)
    train = dataclasses.replace(config.train, lora=own, start=str(base), run=f"runs/{dst.name}")
    config = dataclasses.replace(config, train=train)
    with pipeline.new_folder(dst) as folder:
        configuration.save(config, folder / runs.CONFIG)
        weights.save(folder / runs.WEIGHTS, adapters, lora.reference(config))
        if (origin := inference.base_record(base, config)) is not None:
            shutil.copyfile(origin, folder / runs.BASE)
    return f"{len(published)} adapters of rank {rank} on {base}"


def _network_of(config: Config, base: Path) -> Network:
    backbone = getattr(config.model, "backbone", None)
    for network in NETWORKS:
        if isinstance(backbone, network.config_class):
            return network
    raise UserError(f"{base} has no network whose published adapters can be read.")


def _merge_into_pipeline(published: Mapping[str, Published], dst: Path, base: Path) -> None:
    network = cogvideox_names.TRANSFORMER
    config, params = cogvideox.load(network, base)
    like = {path: np.shape(leaf) for path, leaf in tree.flatten(params).items()}
    adapters, rank = convert(published, network.entries(config), like)
    merged = lora.merge(params, adapters, LoRAConfig(rank=rank))
    with pipeline.new_folder(dst) as folder:
        for part in base.iterdir():
            if part.is_dir() and part.name != network.folder:
                shutil.copytree(part, folder / part.name)
            elif part.is_file():
                shutil.copyfile(part, folder / part.name)
        inside = folder / network.folder
        inside.mkdir()
        configuration.save(config, inside / runs.CONFIG)
        weights.save(inside / runs.WEIGHTS, merged)


def read_published(src: Path) -> dict[str, Published]:
    """Read published adapters, by the layers' names in the reference.

    Raises:
        UserError: the file is missing or damaged, or has tensors that are not understood.
    """
    found = [src / name for name in FILES if (src / name).is_file()]
    path = src if src.is_file() else next(iter(found), None)
    if path is None:
        raise UserError(f"{src} is no file, and no folder with {' or '.join(FILES)}.")
    parts: dict[str, dict[str, np.ndarray]] = {}
    unknown = []
    for name, tensor in tensor_files.read(path):
        layer, part = _split_name(name)
        if part:
            parts.setdefault(layer, {})[part] = np.asarray(tensor, np.float32)
        else:
            unknown.append(name)
    lacking = [layer for layer, has in parts.items() if not {"a", "b"} <= has.keys()]
    if unknown or lacking or not parts:
        wrong = tree.listing(unknown or lacking) or "no adapter"
        raise UserError(
            f"{path} has tensors that are not understood: {wrong}; only pairs of lora_A and lora_B "
            "(LoRA without DoRA or trained biases) can be read."
        )
    settings = _settings(path)
    return {layer: _scaled(layer, has, settings) for layer, has in parts.items()}


def _split_name(name: str) -> tuple[str, str]:
    """Return the layer's name in the reference, and the part of its adapter ("" if unknown)."""
    for pattern, part in _NAMES:
        layer, count = re.subn(pattern, "", name)
        if count:
            layer = re.sub(_PREFIXES, "", layer).replace(".processor.", ".")
            return re.sub(r"\.to_out$", ".to_out.0", layer), part
    return name, ""


def _settings(path: Path) -> dict[str, Any]:
    """Return peft's settings of a file of adapters, without the network's name; {} if unknown."""
    beside = path.parent / "adapter_config.json"
    if beside.is_file():
        return sources.read_json(beside)
    values = json.loads(tensor_files.metadata(path).get(_METADATA, "{}"))
    return {
        name.removeprefix("transformer.").removeprefix("unet."): x for name, x in values.items()
    }


def _scaled(layer: str, parts: Mapping[str, np.ndarray], settings: Mapping[str, Any]) -> Published:
    """Multiply B by alpha / rank, or by alpha / √rank (rank-stabilized LoRA)."""
    a, b = parts["a"], parts["b"]
    rank, alpha = a.shape[0], settings.get("lora_alpha")
    for pattern, value in (settings.get("alpha_pattern") or {}).items():
        if re.fullmatch(rf"(.*\.)?({pattern})", layer):
            alpha = value
    if "alpha" in parts:
        alpha = float(parts["alpha"])
    if alpha is None:
        return Published(a, b)
    return Published(a, b * np.float32(alpha / (rank**0.5 if settings.get("use_rslora") else rank)))


def convert(
    published: Mapping[str, Published],
    entries: list[Entry] | Any,
    like: Mapping[str, tuple[int, ...]],
    prefix: str = "",
) -> tuple[Params, int]:
    """Return published adapters in our layout, of the largest rank among them, and that rank.

    Adapters of smaller rank are filled with zeros, as are those of stacked layers without any.

    Args:
        published: by the layers' names.
        entries: the network's table of names.
        like: shapes of the weights by path.
        prefix: what their paths begin with.

    Raises:
        UserError: a layer is unknown, or is of another shape.
    """
    table = {entry.name.removesuffix(".weight"): entry for entry in entries}
    table = {name: entry for name, entry in table.items() if not name.endswith(".bias")}
    rank = max(one.a.shape[0] for one in published.values())
    leaves: dict[str, np.ndarray] = {}
    wrong = [name for name in published if name not in table]
    for name, one in published.items():
        if name in wrong:
            continue
        entry, path = table[name], prefix + table[name].path
        a = np.asarray(entry.transform.read(one.a))
        b = one.b.reshape(*one.b.shape[:2]).T
        shape, stacked = like.get(path, ()), entry.layer is not None
        if not is_matrix(path, shape) or (*a.shape[:-1], b.shape[-1]) != shape[stacked:]:
            wrong.append(f"{name} (of another shape than {path})")
            continue
        for part, array, axis in (("a", a, -1), ("b", b, 0)):
            wide = np.zeros(
                (*a.shape[:-1], rank) if part == "a" else (rank, b.shape[-1]), np.float32
            )
            filled = [slice(None)] * wide.ndim
            filled[axis] = slice(0, array.shape[axis])
            wide[tuple(filled)] = array
            where = f"{lora.ROOT}/{path}/{part}"
            if stacked:
                whole = leaves.setdefault(where, np.zeros((shape[0], *wide.shape), np.float32))
                whole[entry.layer] = wide
            else:
                leaves[where] = wide
    if wrong:
        raise UserError(
            f"These adapters fit no weight of the network: {tree.listing(wrong)}; give the weights "
            "that they were trained on by --base."
        )
    return tree.unflatten(leaves), rank
