"""DINOv2's checkpoints: settings and tensor names of transformers and of the original repository.

A ``transformers`` folder has its settings in ``config.json``. For a state dict of the original
repository (such as ``dinov2_vits14_pretrain.pth``, or the same tensors as safetensors) they follow
from the tensors' shapes: every published model has heads of 64 channels. Both fill the same tree;
the network follows ``transformers`` in how position embeddings are interpolated (see
``pewm_jax.models.dinov2.model``).

The mask token, which only pretraining uses, and an image classifier's last layer are left out;
every other tensor must be used.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from pewm_jax.errors import UserError
from pewm_jax.io import published, tree
from pewm_jax.io.published import SAME, Entry, Transform
from pewm_jax.io.sources import Source, renamed
from pewm_jax.models.dinov2.config import HEAD_DIM, DINOv2Config

_UNUSED = re.compile(r"(embeddings\.)?mask_token|classifier\.(weight|bias)")
_BODY = re.compile(r"^(dinov2|dinov2_with_registers)\.")
_HUB = (
    (r"cls_token|register_tokens|mask_token", r"embeddings.\g<0>"),
    (r"pos_embed", r"embeddings.position_embeddings"),
    (r"patch_embed\.proj\.(\w+)", r"embeddings.patch_embeddings.projection.\1"),
    (r"blocks\.(\d+)\.(norm[12]\.\w+|mlp\.fc[12]\.\w+)", r"encoder.layer.\1.\2"),
    (r"blocks\.(\d+)\.attn\.proj\.(\w+)", r"encoder.layer.\1.attention.output.dense.\2"),
    (r"blocks\.(\d+)\.ls([12])\.gamma", r"encoder.layer.\1.layer_scale\2.lambda1"),
    (r"blocks\.(\d+)\.mlp\.w12\.(\w+)", r"encoder.layer.\1.mlp.weights_in.\2"),
    (r"blocks\.(\d+)\.mlp\.w3\.(\w+)", r"encoder.layer.\1.mlp.weights_out.\2"),
    (r"norm\.(\w+)", r"layernorm.\1"),
)
"""The original repository's names, as patterns, and those of ``transformers``; the fused q, k and v
are split apart from these."""
_HUB_QKV = re.compile(r"blocks\.(\d+)\.attn\.qkv\.(\w+)")
_FIXED = {"hidden_act": "gelu", "num_channels": 3, "qkv_bias": True}
"""Settings of which only this value is implemented."""
_NO_MATTER = (
    "num_labels",
    "apply_layernorm",
    "reshape_hidden_states",
    "out_features",
    "out_indices",
    "stage_names",
    "layerscale_value",
    "attention_probs_dropout_prob",
    "hidden_dropout_prob",
    "drop_path_rate",
    "use_mask_token",
    "_attn_implementation_autoset",
)
"""Settings that do not change what the network computes once it is trained."""
_NUMBERS = {
    "num_hidden_layers": ("layers", 12),
    "num_attention_heads": ("heads", 12),
    "hidden_size": ("width", 768),
    "patch_size": ("patch", 14),
    "image_size": ("pretrained_size", 224),
    "mlp_ratio": ("mlp_ratio", 4),
    "num_register_tokens": ("registers", 0),
}
"""Their setting → our field, and what transformers takes for one that a file leaves out."""
_WITH_REGISTERS = {"patch_size": 16, "num_register_tokens": 4}
"""The defaults of the network with registers, where they differ."""


def entries(config: DINOv2Config) -> list[Entry]:
    """List every tensor of ``transformers``' network and its path in our tree."""
    row = Transform(lambda x: x[0], lambda x: x[None])
    token = Transform(lambda x: x[0, 0], lambda x: x[None, None])
    patch, there = published.patches(config.patch), "embeddings.patch_embeddings.projection"
    found = [
        Entry("embeddings.cls_token", "cls_token", token),
        Entry("embeddings.position_embeddings", "position_embed", row),
        *published.affine(there, "patch_embed", transform=patch),
        *published.norm("layernorm", "norm"),
    ]
    if config.registers:
        found.append(Entry("embeddings.register_tokens", "register_tokens", row))
    for layer in range(config.layers):
        found += _block(config, f"encoder.layer.{layer}", layer)
    return found


def _block(config: DINOv2Config, theirs: str, layer: int) -> Iterator[Entry]:
    up, down = ("weights_in", "weights_out") if config.swiglu else ("fc1", "fc2")
    linear = {
        "attention.attention.query": "to_q",
        "attention.attention.key": "to_k",
        "attention.attention.value": "to_v",
        "attention.output.dense": "to_out",
        f"mlp.{up}": "up",
        f"mlp.{down}": "down",
    }
    for there, here in linear.items():
        yield from published.affine(f"{theirs}.{there}", f"blocks/{here}", layer)
    for n in "12":
        yield from published.norm(f"{theirs}.norm{n}", f"blocks/norm{n}", layer)
        yield Entry(f"{theirs}.layer_scale{n}.lambda1", f"blocks/scale{n}", SAME, layer)


def config_from_transformers(values: Mapping[str, Any], where: str = "config.json") -> DINOv2Config:
    """Read the settings of ``Dinov2Config`` or ``Dinov2WithRegistersConfig``.

    Args:
        values: what ``config.json`` holds.
        where: its name in messages.

    Raises:
        UserError: a setting that is unknown, or one that this network does not have.
    """
    kind = values.get("model_type")
    if kind not in ("dinov2", "dinov2_with_registers"):
        raise UserError(
            f"{where} is of model_type {kind!r}; this can read dinov2 and dinov2_with_registers "
            "only."
        )
    read = {*_NUMBERS, "layer_norm_eps", "use_swiglu_ffn"}
    known = {*read, *_NO_MATTER, *published.TRANSFORMERS_METADATA, *_FIXED}
    if unknown := values.keys() - known:
        raise UserError(
            f"{where} has settings this library does not know: {tree.listing(unknown)}; remove "
            "them if they change nothing."
        )
    for name, only in _FIXED.items():
        if values.get(name, only) != only:
            raise UserError(
                f"{where} has {name} {values[name]!r}; only {only!r} is known of DINOv2."
            )
    registers = kind == "dinov2_with_registers"
    if not registers and values.get("num_register_tokens"):
        raise UserError(
            f"{where} has num_register_tokens; that is model_type dinov2_with_registers."
        )
    given = {**(_WITH_REGISTERS if registers else {}), **values}
    if not registers:
        given["num_register_tokens"] = 0
    return DINOv2Config(
        **{ours: _number(given, key, default, where) for key, (ours, default) in _NUMBERS.items()},
        swiglu=bool(values.get("use_swiglu_ffn", False)),
        antialias=registers,
        epsilon=float(values.get("layer_norm_eps", 1e-6)),
    )


def config_from_shapes(source: Source) -> DINOv2Config:
    """Work out the settings from the shapes of tensors with ``transformers``' names.

    Raises:
        UserError: the tensors are not DINOv2's.
    """
    names = set(source.names())
    needed = ("position_embeddings", "patch_embeddings.projection.weight")
    shapes = [source.shape(f"embeddings.{n}") for n in needed if f"embeddings.{n}" in names]
    layers = {int(n.split(".")[2]) for n in names if re.match(r"encoder\.layer\.\d+\.", n)}
    if [len(shape) for shape in shapes] != [3, 4] or not layers:
        raise UserError(
            f"{source.where} is not a DINOv2 state dict: it holds {tree.listing(names)}; give "
            "dinov2_vit{s,b,l,g}14[_reg4]_pretrain.pth, or a transformers folder."
        )
    (_, places, width), (*_, patch) = shapes
    if width % HEAD_DIM:
        raise UserError(
            f"{source.where} has a width of {width}, which is not a multiple of {HEAD_DIM}, "
            "DINOv2's width of a head; give a transformers folder, whose config.json names the "
            "heads."
        )
    side = round((places - 1) ** 0.5)
    register = "embeddings.register_tokens"
    registers = source.shape(register)[1] if register in names else 0
    swiglu = any(".mlp.weights_in." in name for name in names)
    return DINOv2Config(
        layers=max(layers) + 1,
        heads=width // HEAD_DIM,
        width=width,
        patch=patch,
        pretrained_size=side * patch,
        swiglu=swiglu,
        registers=registers,
        antialias=registers > 0,
    )


def _number(values: Mapping[str, Any], name: str, default: int, where: str) -> int:
    """Return a whole number, of a pair of equal ones too."""
    value = values.get(name, default)
    if isinstance(value, list) and len(set(value)) == 1:
        value = value[0]
    if isinstance(value, bool) or not isinstance(value, int | float) or value != int(value):
        raise UserError(f"{where} has {name} {value!r}; it should be a whole number.")
    return int(value)


def with_transformers_names(source: Source) -> Source:
    """Return DINOv2's tensors under ``transformers``' names, without those that are not used."""
    views: dict[str, tuple[str, int, int]] = {}
    for theirs in source.names():
        name = _BODY.sub("", theirs)
        if _UNUSED.fullmatch(name):
            continue
        if qkv := _HUB_QKV.fullmatch(name):
            stem = f"encoder.layer.{qkv[1]}.attention.attention"
            for part, what in enumerate(("query", "key", "value")):
                views[f"{stem}.{what}.{qkv[2]}"] = (theirs, part, 3)
            continue
        for pattern, ours in _HUB:
            if hub := re.fullmatch(pattern, name):
                name = hub.expand(ours)
                break
        views[name] = (theirs, 0, 1)
    return renamed(source, views)
