"""The settings and tensor names of Stable Video Diffusion's U-Net, and ours.

Reference: ``UNetSpatioTemporalConditionModel`` of diffusers.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from pewm_jax.config import SVDUNetConfig, UserError
from pewm_jax.convert import settings
from pewm_jax.convert.mapping import CONV, LINEAR, SAME, Entry, Turn
from pewm_jax.models.svd import shapes as svd_shapes

CLASS = "UNetSpatioTemporalConditionModel"
"""The reference's class."""
TIME_CONV = Turn(
    lambda x: np.moveaxis(x[:, :, :, 0, 0], (0, 1), (2, 1)),
    lambda x: np.moveaxis(x, (2, 1), (0, 1))[:, :, :, None, None],
)
"""torch (out, in, 3, 1, 1) ↔ ours (3, in, out)."""
POINTWISE = Turn(lambda x: x[:, :, 0, 0].T, lambda x: x.T[:, :, None, None])
"""torch (out, in, 1, 1) ↔ ours (in, out)."""
DOWN = {True: "CrossAttnDownBlockSpatioTemporal", False: "DownBlockSpatioTemporal"}
UP = {True: "CrossAttnUpBlockSpatioTemporal", False: "UpBlockSpatioTemporal"}
_DEFAULTS: dict[str, Any] = {
    "in_channels": 8,
    "out_channels": 4,
    "block_out_channels": [320, 640, 1280, 1280],
    "down_block_types": [DOWN[True]] * 3 + [DOWN[False]],
    "up_block_types": [UP[False]] + [UP[True]] * 3,
    "addition_time_embed_dim": 256,
    "projection_class_embeddings_input_dim": 768,
    "layers_per_block": 2,
    "cross_attention_dim": 1024,
    "transformer_layers_per_block": 1,
    "num_attention_heads": [5, 10, 20, 20],
}
"""What diffusers takes for settings that a file leaves out."""
_WITHOUT_EFFECT = {"sample_size": None, "num_frames": 25}
"""Settings that the network does not read, and what is written for them."""


def config_from_diffusers(values: dict[str, Any]) -> SVDUNetConfig:
    """Read the settings of ``unet/config.json``; absent ones have diffusers' defaults.

    Raises:
        UserError: another class, or a setting that is unknown or not supported.
    """
    given = settings.of_network(values, "The U-Net", CLASS, _DEFAULTS, _WITHOUT_EFFECT)
    widths = _numbers(given, "block_out_channels", None)
    levels = len(widths)
    attends = tuple(kind == DOWN[True] for kind in given["down_block_types"])
    for key, names, order in (("down_block_types", DOWN, 1), ("up_block_types", UP, -1)):
        expected = [names[attend] for attend in attends][::order]
        if list(given[key]) != expected:
            raise UserError(
                f"The U-Net's {key} is {given[key]!r}; only {DOWN[True]} and {DOWN[False]} and "
                "the mirror image of them on the way up are known."
            )
    across = set(_numbers(given, "cross_attention_dim", levels))
    if len(across) > 1:
        raise UserError(
            f"The U-Net's cross_attention_dim is {given['cross_attention_dim']!r}; only one number "
            "for all levels is known."
        )
    (added_dim,) = _numbers(given, "addition_time_embed_dim", 1)
    (joint,) = _numbers(given, "projection_class_embeddings_input_dim", 1)
    if added_dim < 1 or joint % added_dim:
        raise UserError(
            f"The U-Net's projection_class_embeddings_input_dim {joint} is not a multiple of "
            f"addition_time_embed_dim {added_dim}; it holds one embedding per scalar."
        )
    return SVDUNetConfig(
        in_channels=_numbers(given, "in_channels", 1)[0],
        out_channels=_numbers(given, "out_channels", 1)[0],
        widths=widths,
        heads=_numbers(given, "num_attention_heads", levels),
        attends=attends,
        resnets=_numbers(given, "layers_per_block", levels),
        layers=_numbers(given, "transformer_layers_per_block", levels),
        image_dim=across.pop(),
        added=joint // added_dim,
        added_dim=added_dim,
    )


def config_to_diffusers(config: SVDUNetConfig) -> dict[str, Any]:
    """Write the settings of ``unet/config.json``, the inverse of reading them."""
    return {
        "_class_name": CLASS,
        **_WITHOUT_EFFECT,
        "in_channels": config.in_channels,
        "out_channels": config.out_channels,
        "block_out_channels": list(config.widths),
        "down_block_types": [DOWN[attend] for attend in config.attends],
        "up_block_types": [UP[attend] for attend in config.attends][::-1],
        "addition_time_embed_dim": config.added_dim,
        "projection_class_embeddings_input_dim": config.added * config.added_dim,
        "layers_per_block": list(config.resnets),
        "cross_attention_dim": config.image_dim,
        "transformer_layers_per_block": list(config.layers),
        "num_attention_heads": list(config.heads),
    }


def entries(config: SVDUNetConfig) -> list[Entry]:
    """Return one entry per tensor of the reference."""
    return [
        Entry(_theirs(path), path, turn(path, s)) for path, s in svd_shapes.unet(config).items()
    ]


def turn(path: str, shape: tuple[int, ...]) -> Turn:
    """Return the change of layout of a leaf."""
    if not path.endswith("/kernel"):
        return SAME
    if len(shape) == 2:
        return POINTWISE if "/shortcut/" in path else LINEAR
    return TIME_CONV if len(shape) == 3 else CONV


RULES = (
    (r"\b(down|up)_(\d+)/", r"\1_blocks.\2."),
    (r"\bmid/", "mid_block."),
    (r"resnet_(\d+)/", r"resnets.\1."),
    (r"\battend_(\d+)/", r"attentions.\1."),
    (r"(down_blocks.*)resample/", r"\1downsamplers.0.conv/"),
    (r"(up_blocks.*)resample/", r"\1upsamplers.0.conv/"),
    (r"\b(spatial|temporal)/", r"\1_res_block."),
    (r"shortcut/", "conv_shortcut/"),
    (r"\btime/", "time_emb_proj/"),
    (r"/?\bmix$", ".time_mixer.mix_factor"),
    (r"norm_out/", "conv_norm_out/"),
    (r"to_out/", "to_out.0/"),
)
"""Parts of our paths and the reference's names, shared with the autoencoder."""
_RULES = (
    (r"\bspatial_(\d+)/", r"transformer_blocks.\1."),
    (r"\btemporal_(\d+)/", r"temporal_transformer_blocks.\1."),
    (r"frame_embed/", "time_pos_embed/"),
    (r"^time_embed/", "time_embedding/"),
    (r"^added_embed/", "add_embedding/"),
    (r"\b(ff|ff_in)/up/", r"\1.net.0.proj/"),
    (r"\b(ff|ff_in)/down/", r"\1.net.2/"),
)


def _theirs(path: str) -> str:
    """Turn ``up_0/resnet_1/temporal/norm1/scale`` into the reference's name."""
    return renamed(path, (*_RULES, *RULES))


def renamed(path: str, rules: tuple[tuple[str, str], ...]) -> str:
    """Apply rules to a path of ours and return the reference's name."""
    for pattern, name in rules:
        path = re.sub(pattern, name, path)
    path = re.sub(r"/(kernel|scale)$", "/weight", path)
    return re.sub(r"\.+", ".", path.replace("/", "."))


def _numbers(given: dict[str, Any], key: str, count: int | None) -> tuple[int, ...]:
    """Return whole numbers, one per level; a single one holds for all levels."""
    value = given[key]
    values = list(value) if isinstance(value, list | tuple) else [value] * (count or 1)
    if any(type(item) is not int for item in values) or count not in (None, len(values)):
        raise UserError(
            f"The U-Net's {key} is {value!r}; it must be a whole number or one for each level."
        )
    return tuple(values)
