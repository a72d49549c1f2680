"""CLIP's image encoder in transformers: its settings and tensor names, theirs and ours.

Reference: ``CLIPVisionModelWithProjection``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.io.published import LINEAR, SAME, Entry, Network, Transform
from pewm_jax.models.clip import model
from pewm_jax.models.clip.config import CLIPVisionConfig

CLASS = "CLIPVisionModelWithProjection"
"""The reference's class."""
UNUSED = ("vision_model.embeddings.position_ids",)
"""Position indices in older files, which no network reads."""
_DEFAULTS: dict[str, Any] = {
    "num_hidden_layers": 12,
    "num_attention_heads": 12,
    "hidden_size": 768,
    "intermediate_size": 3072,
    "projection_dim": 512,
    "image_size": 224,
    "patch_size": 32,
    "hidden_act": "quick_gelu",
    "layer_norm_eps": 1e-5,
}
"""What transformers takes for settings that a file leaves out."""
_FIELDS = dict(
    zip(
        _DEFAULTS,
        (
            "layers",
            "heads",
            "width",
            "hidden",
            "projection",
            "image_size",
            "patch",
            "activation",
            "epsilon",
        ),
        strict=True,
    )
)
"""Their setting → our field."""
_NO_MATTER = frozenset(
    [
        "architectures",
        "model_type",
        "torch_dtype",
        "dtype",
        "transformers_version",
        "_name_or_path",
        "attention_dropout",
        "dropout",
        "initializer_factor",
        "initializer_range",
        "num_channels",
        "chunk_size_feed_forward",
        "id2label",
        "is_encoder_decoder",
        "label2id",
        "output_attentions",
        "output_hidden_states",
        "problem_type",
        "return_dict",
        "torchscript",
        "use_bfloat16",
    ]
)
"""Settings that do not change what the network computes once it is trained."""


def config_from_transformers(
    values: Mapping[str, Any], where: str = "The image encoder"
) -> CLIPVisionConfig:
    """Read the settings of ``image_encoder/config.json``.

    Args:
        values: what the file holds; absent settings have transformers' defaults.
        where: its name in messages.

    Raises:
        UserError: another model, or a setting that is unknown or not supported.
    """
    if values.get("model_type") != "clip_vision_model":
        raise UserError(
            f"{where} is of model_type {values.get('model_type')!r}; this can read "
            "clip_vision_model only."
        )
    unknown = sorted(values.keys() - _DEFAULTS.keys() - _NO_MATTER)
    if unknown:
        raise UserError(f"{where} has settings this library does not know: {', '.join(unknown)}.")
    if values.get("num_channels", 3) != 3:
        raise UserError(f"{where} has num_channels {values['num_channels']!r}; only 3 is known.")
    given = {key: values.get(key, default) for key, default in _DEFAULTS.items()}
    for key, default in _DEFAULTS.items():
        if type(given[key]) is not type(default):
            raise UserError(f"{where} has {key} {given[key]!r}; give a value like {default!r}.")
    if given["hidden_act"] not in ("gelu", "quick_gelu"):
        raise UserError(
            f"{where} has hidden_act {given['hidden_act']!r}; only gelu and quick_gelu are known."
        )
    return CLIPVisionConfig(**{_FIELDS[key]: value for key, value in given.items()})


def config_to_transformers(config: CLIPVisionConfig) -> dict[str, Any]:
    """Write the settings of ``config.json``, the inverse of reading them."""
    return {
        "architectures": [CLASS],
        "model_type": "clip_vision_model",
        "num_channels": 3,
        **{theirs: getattr(config, ours) for theirs, ours in _FIELDS.items()},
    }


def entries(config: CLIPVisionConfig) -> list[Entry]:
    """List every tensor of the reference and its path in our tree."""
    p, body = config.patch, "vision_model"
    patch = Transform(
        lambda x: np.moveaxis(x, (1, 0), (2, 3)).reshape(p * p * 3, -1),
        lambda x: np.moveaxis(x.reshape(p, p, 3, -1), (2, 3), (1, 0)),
    )
    found = [
        Entry(f"{body}.embeddings.class_embedding", "cls_token"),
        Entry(f"{body}.embeddings.position_embedding.weight", "position_embed"),
        Entry(f"{body}.embeddings.patch_embedding.weight", "patch_embed/kernel", patch),
        Entry("visual_projection.weight", "project/kernel", LINEAR),
    ]
    for theirs, ours in (("pre_layrnorm", "norm_in"), ("post_layernorm", "norm_out")):
        found += [Entry(f"{body}.{theirs}.weight", f"{ours}/scale")]
        found += [Entry(f"{body}.{theirs}.bias", f"{ours}/bias")]
    linear = {
        "self_attn.q_proj": "attn/to_q",
        "self_attn.k_proj": "attn/to_k",
        "self_attn.v_proj": "attn/to_v",
        "self_attn.out_proj": "attn/to_out",
        "mlp.fc1": "up",
        "mlp.fc2": "down",
    }
    inside = [(f"{t}.weight", f"{o}/kernel", LINEAR) for t, o in linear.items()]
    inside += [(f"{t}.bias", f"{o}/bias", SAME) for t, o in linear.items()]
    for n in "12":
        inside += [(f"layer_norm{n}.weight", f"norm{n}/scale", SAME)]
        inside += [(f"layer_norm{n}.bias", f"norm{n}/bias", SAME)]
    found += [
        Entry(f"{body}.encoder.layers.{layer}.{theirs}", f"blocks/{ours}", turn, layer)
        for layer in range(config.layers)
        for theirs, ours, turn in inside
    ]
    return found


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
