"""CLIP's image encoder in transformers: its settings and tensor names, theirs and ours.

Reference: ``CLIPVisionModelWithProjection``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pewm_jax.errors import UserError
from pewm_jax.io import published
from pewm_jax.io.published import LINEAR, Entry, Network
from pewm_jax.models.clip import model
from pewm_jax.models.clip.model import CLIPVisionConfig

CLASS = "CLIPVisionModelWithProjection"
"""The reference's class."""
UNUSED = ("vision_model.embeddings.position_ids",)
"""Position indices in older files, which no network reads."""
WHAT = "The image encoder"
_FIELDS: dict[str, tuple[str, Any]] = {
    "num_hidden_layers": ("layers", 12),
    "num_attention_heads": ("heads", 12),
    "hidden_size": ("width", 768),
    "intermediate_size": ("hidden", 3072),
    "projection_dim": ("projection", 512),
    "image_size": ("image_size", 224),
    "patch_size": ("patch", 32),
    "hidden_act": ("activation", "quick_gelu"),
    "layer_norm_eps": ("epsilon", 1e-5),
}
"""Their setting → our field, and what transformers takes for one that a file leaves out."""
_NO_MATTER = ("attention_dropout", "dropout", "initializer_factor", "num_channels")
"""Settings that do not change what the network computes once it is trained."""


def config_from_transformers(values: Mapping[str, Any]) -> CLIPVisionConfig:
    """Read the settings of ``image_encoder/config.json``; absent ones have transformers' defaults.

    Raises:
        UserError: another model, or a setting that is unknown or not supported.
    """
    if values.get("model_type") != "clip_vision_model":
        raise UserError(
            f"{WHAT} is of model_type {values.get('model_type')!r}; this can read "
            "clip_vision_model only."
        )
    checked = published.defaults(_FIELDS)
    known = {*checked, *published.TRANSFORMERS_METADATA, *_NO_MATTER}
    published.require_known(values, WHAT, known)
    published.require_only(values, WHAT, {"num_channels": 3})
    given = {key: values.get(key, default) for key, default in checked.items()}
    published.require_kinds(given, WHAT, checked)
    published.require_choice(given, WHAT, "hidden_act", ("gelu", "quick_gelu"))
    return CLIPVisionConfig(**published.read_fields(_FIELDS, given))


def config_to_transformers(config: CLIPVisionConfig) -> dict[str, Any]:
    """Write the settings of ``config.json``, the inverse of reading them."""
    return {
        "architectures": [CLASS],
        "model_type": "clip_vision_model",
        "num_channels": 3,
        **published.write_fields(_FIELDS, config),
    }


def entries(config: CLIPVisionConfig) -> list[Entry]:
    """List every tensor of the reference and its path in our tree."""
    body = "vision_model"
    patch = published.patches(config.patch)
    found = [
        Entry(f"{body}.embeddings.class_embedding", "cls_token"),
        Entry(f"{body}.embeddings.position_embedding.weight", "position_embed"),
        Entry(f"{body}.embeddings.patch_embedding.weight", "patch_embed/kernel", patch),
        Entry("visual_projection.weight", "project/kernel", LINEAR),
        *published.norm(f"{body}.pre_layrnorm", "norm_in"),
        *published.norm(f"{body}.post_layernorm", "norm_out"),
    ]
    for layer in range(config.layers):
        found += _block(f"{body}.encoder.layers.{layer}", layer)
    return found


def _block(theirs: str, layer: int) -> Iterator[Entry]:
    for name in ("q", "k", "v", "out"):
        there = f"{theirs}.self_attn.{name}_proj"
        yield from published.affine(there, f"blocks/attn/to_{name}", layer)
    yield from published.affine(f"{theirs}.mlp.fc1", "blocks/up", layer)
    yield from published.affine(f"{theirs}.mlp.fc2", "blocks/down", layer)
    for n in "12":
        yield from published.norm(f"{theirs}.layer_norm{n}", f"blocks/norm{n}", layer)


IMAGE_ENCODER = Network(
    "image_encoder",
    "clip_vision_model",
    CLIPVisionConfig,
    config_from_transformers,
    config_to_transformers,
    entries,
    model.init,
    unused=UNUSED,
    class_key="model_type",
    weights_file="model.safetensors",
)
