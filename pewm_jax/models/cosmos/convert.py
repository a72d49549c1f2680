"""Cosmos' checkpoints in diffusers: the transformer's settings and tensor names, theirs and ours.

Reference: ``CosmosTransformer3DModel`` of diffusers. The autoencoder is Wan's
(``models.wan.convert``).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pewm_jax.errors import UserError
from pewm_jax.io import published
from pewm_jax.io.published import LINEAR, SAME, Entry, Network, rename
from pewm_jax.models.cosmos import model
from pewm_jax.models.cosmos.backbone import CosmosBackbone

CLASS = "CosmosTransformer3DModel"
"""The reference's class."""
WHAT = "The transformer"
_FIELDS: dict[str, tuple[str, Any]] = {
    "in_channels": ("in_channels", 16),
    "out_channels": ("out_channels", 16),
    "num_attention_heads": ("heads", 32),
    "attention_head_dim": ("head_dim", 128),
    "num_layers": ("layers", 28),
    "mlp_ratio": ("mlp_ratio", 4.0),
    "text_embed_dim": ("text_dim", 1024),
    "adaln_lora_dim": ("lora_dim", 256),
    "max_size": ("max_size", (128, 240, 240)),
    "rope_scale": ("rope_scale", (2.0, 1.0, 1.0)),
    "concat_padding_mask": ("padding_mask", True),
}
"""Their setting → our field, and what diffusers takes for one that a file leaves out."""
_PATCH = {"patch_size": (1, 2, 2)}
_CHOICES: dict[str, Any] = {
    "extra_pos_embed_type": "learnable",
    "use_crossattn_projection": False,
    "crossattn_proj_in_channels": 1024,
    "encoder_hidden_states_channels": 1024,
}
"""The same for settings that depend on each other."""
_ONLY = {"controlnet_block_every_n": None, "img_context_dim_in": None}
"""Settings of which one value is supported, which is also what diffusers takes."""
_WITHOUT_EFFECT = {"img_context_num_tokens": 256, "img_context_dim_out": 2048}
"""Settings that the network does not read, and what is written for them."""
_RULES = (
    (r"^patch_embed/", "patch_embed.proj/"),
    (r"^text_embed/", "crossattn_proj.0/"),
    (r"^time_embed/linear", "time_embed.t_embedder.linear"),
    (r"^positions/time$", "learnable_pos_embed.pos_emb_t"),
    (r"^positions/rows$", "learnable_pos_embed.pos_emb_h"),
    (r"^positions/columns$", "learnable_pos_embed.pos_emb_w"),
    (r"modulate_out/", "norm_out."),
    (r"modulate(\d)/", r"norm\1."),
    (r"norm(_out|\d)\.down/", r"norm\1.linear_1/"),
    (r"norm(_out|\d)\.up/", r"norm\1.linear_2/"),
    (r"to_out/", "to_out.0/"),
    (r"ff/up/", "ff.net.0.proj/"),
    (r"ff/down/", "ff.net.2/"),
)


def config_from_diffusers(values: Mapping[str, Any]) -> CosmosBackbone:
    """Read the settings of ``transformer/config.json``; absent ones have diffusers' defaults.

    Raises:
        UserError: another class, or a setting that is unknown or not supported.
    """
    checked = {**published.defaults(_FIELDS), **_PATCH}
    defaults = {**checked, **_CHOICES, **_ONLY}
    given = published.read_settings(values, WHAT, CLASS, defaults, _WITHOUT_EFFECT)
    published.require_only(given, WHAT, _ONLY)
    published.require_kinds(given, WHAT, checked)
    patch_t, rows, columns = given["patch_size"]
    if rows != columns:
        raise UserError(
            f"{WHAT}'s patch_size is {given['patch_size']!r}; only square patches are supported."
        )
    published.require_choice(given, WHAT, "extra_pos_embed_type", (None, "learnable"))
    return CosmosBackbone(
        **published.read_fields(_FIELDS, given),
        raw_text_dim=_raw_text(given),
        patch=rows,
        patch_t=patch_t,
        learned_positions=given["extra_pos_embed_type"] == "learnable",
    )


def _raw_text(given: Mapping[str, Any]) -> int:
    """Return the channels of given text tokens, or 0 if no layer changes them."""
    published.require_kinds(given, WHAT, {"use_crossattn_projection": False})
    if not given["use_crossattn_projection"]:
        return 0
    sizes = ("crossattn_proj_in_channels", "encoder_hidden_states_channels")
    published.require_kinds(given, WHAT, {key: _CHOICES[key] for key in sizes})
    inside, outside = (given[key] for key in sizes)
    if outside != given["text_embed_dim"]:
        raise UserError(
            f"{WHAT}'s encoder_hidden_states_channels {outside} is not its text_embed_dim "
            f"{given['text_embed_dim']}, which the blocks take."
        )
    return inside


def config_to_diffusers(config: CosmosBackbone) -> dict[str, Any]:
    """Write the settings of ``transformer/config.json``, the inverse of reading them."""
    return {
        "_class_name": CLASS,
        **_ONLY,
        **_WITHOUT_EFFECT,
        **published.write_fields(_FIELDS, config),
        "patch_size": [config.patch_t, config.patch, config.patch],
        "extra_pos_embed_type": "learnable" if config.learned_positions else None,
        "use_crossattn_projection": config.raw_text_dim > 0,
        "crossattn_proj_in_channels": config.raw_text_dim or 1024,
        "encoder_hidden_states_channels": config.text_dim if config.raw_text_dim else 1024,
    }


def entries(config: CosmosBackbone) -> list[Entry]:
    """Return one entry per tensor of the reference."""
    found = []
    for path in model.layout(config):
        transform = LINEAR if path.endswith("/kernel") else SAME
        if path.startswith("blocks/"):
            inside = rename(path.removeprefix("blocks/"), _RULES)
            found += [
                Entry(f"transformer_blocks.{layer}.{inside}", path, transform, layer)
                for layer in range(config.layers)
            ]
        else:
            found.append(Entry(rename(path, _RULES), path, transform))
    return found


TRANSFORMER = Network(
    "transformer",
    CLASS,
    CosmosBackbone,
    config_from_diffusers,
    config_to_diffusers,
    entries,
    model.init,
)
