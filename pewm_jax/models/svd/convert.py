"""Stable Video Diffusion's checkpoints in diffusers: settings and tensor names, theirs and ours.

References: ``UNetSpatioTemporalConditionModel`` and ``AutoencoderKLTemporalDecoder`` of diffusers.
The image encoder is CLIP's (``models.clip.convert``).
"""

from __future__ import annotations

from typing import Any

from pewm_jax.errors import UserError
from pewm_jax.io import published
from pewm_jax.io.published import Entry, Network, Transform, rename
from pewm_jax.models.svd import unet, vae
from pewm_jax.models.svd.unet import SVDUNetBackbone
from pewm_jax.models.svd.vae import SVDVAECodec

UNET_CLASS = "UNetSpatioTemporalConditionModel"
"""The reference's class."""
DOWN = {True: "CrossAttnDownBlockSpatioTemporal", False: "DownBlockSpatioTemporal"}
UP = {True: "CrossAttnUpBlockSpatioTemporal", False: "UpBlockSpatioTemporal"}
_UNET_DEFAULTS: dict[str, Any] = {
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
_UNET_WITHOUT_EFFECT = {"sample_size": None, "num_frames": 25}
"""Settings that the network does not read, and what is written for them."""


def unet_config_from_diffusers(values: dict[str, Any]) -> SVDUNetBackbone:
    """Read the settings of ``unet/config.json``; absent ones have diffusers' defaults.

    Raises:
        UserError: another class, or a setting that is unknown or not supported.
    """
    given = published.read_settings(
        values, "The U-Net", UNET_CLASS, _UNET_DEFAULTS, _UNET_WITHOUT_EFFECT
    )
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
    return SVDUNetBackbone(
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


def unet_config_to_diffusers(config: SVDUNetBackbone) -> dict[str, Any]:
    """Write the settings of ``unet/config.json``, the inverse of reading them."""
    return {
        "_class_name": UNET_CLASS,
        **_UNET_WITHOUT_EFFECT,
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


def unet_entries(config: SVDUNetBackbone) -> list[Entry]:
    """Return one entry per tensor of the reference."""
    rules = (*_UNET_RULES, *RULES)
    return [
        Entry(rename(path, rules), path, _transform(path, shape))
        for path, shape in unet.layout(config).items()
    ]


def _transform(path: str, shape: tuple[int, ...]) -> Transform:
    """Return the change of layout of a leaf."""
    if not path.endswith("/kernel"):
        return published.SAME
    if len(shape) == 2:
        pointwise = "/shortcut/" in path or path == "encoder/quant/kernel"
        return published.POINTWISE if pointwise else published.LINEAR
    return published.TIME_CONV if len(shape) == 3 else published.CONV


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
_UNET_RULES = (
    (r"\bspatial_(\d+)/", r"transformer_blocks.\1."),
    (r"\btemporal_(\d+)/", r"temporal_transformer_blocks.\1."),
    (r"frame_embed/", "time_pos_embed/"),
    (r"^time_embed/", "time_embedding/"),
    (r"^added_embed/", "add_embedding/"),
    (r"\b(ff|ff_in)/up/", r"\1.net.0.proj/"),
    (r"\b(ff|ff_in)/down/", r"\1.net.2/"),
)


def _numbers(given: dict[str, Any], key: str, count: int | None) -> tuple[int, ...]:
    """Return whole numbers, one per level; a single one holds for all levels."""
    value = given[key]
    values = list(value) if isinstance(value, list | tuple) else [value] * (count or 1)
    if any(type(item) is not int for item in values) or count not in (None, len(values)):
        raise UserError(
            f"The U-Net's {key} is {value!r}; it must be a whole number or one for each level."
        )
    return tuple(values)


VAE_CLASS = "AutoencoderKLTemporalDecoder"
"""The reference's class."""
BLOCK = "DownEncoderBlock2D"
"""The only kind of block on the way down."""
_VAE_FIELDS: dict[str, tuple[str, Any]] = {
    "in_channels": ("in_channels", 3),
    "out_channels": ("out_channels", 3),
    "latent_channels": ("latent_channels", 4),
    "block_out_channels": ("widths", [64]),
    "layers_per_block": ("resnets", 1),
    "scaling_factor": ("scaling_factor", 0.18215),
}
"""Their setting → our field, and what diffusers takes for one that a file leaves out."""
_VAE_WITHOUT_EFFECT = {"sample_size": 768, "force_upcast": True}
"""Settings that the network does not read, and what is written for them."""
_VAE_RULES = (
    (r"^encoder/quant/", "quant_conv/"),
    (r"time_out/", "time_conv_out/"),
    (r"attend_(\d+)/norm/", r"attend_\1/group_norm/"),
)


def vae_config_from_diffusers(values: dict[str, Any]) -> SVDVAECodec:
    """Read the settings of ``vae/config.json``; absent ones have diffusers' defaults.

    Raises:
        UserError: another class, or a setting that is unknown or not supported.
    """
    checked = published.defaults(_VAE_FIELDS)
    given = published.read_settings(
        values, "The VAE", VAE_CLASS, {**checked, "down_block_types": [BLOCK]}, _VAE_WITHOUT_EFFECT
    )
    published.require_kinds(given, "The VAE", checked)
    only = {"down_block_types": [BLOCK] * len(given["block_out_channels"])}
    published.require_only(given, "The VAE", only)
    return SVDVAECodec(**published.read_fields(_VAE_FIELDS, given))


def vae_config_to_diffusers(config: SVDVAECodec) -> dict[str, Any]:
    """Write the settings of ``vae/config.json``, the inverse of reading them."""
    return {
        "_class_name": VAE_CLASS,
        **_VAE_WITHOUT_EFFECT,
        **published.write_fields(_VAE_FIELDS, config),
        "down_block_types": [BLOCK] * len(config.widths),
    }


def vae_entries(config: SVDVAECodec) -> list[Entry]:
    """Return one entry per tensor of the reference."""
    rules = (*_VAE_RULES, *RULES)
    return [
        Entry(rename(path, rules), path, _transform(path, shape))
        for path, shape in vae.layout(config).items()
    ]


UNET = Network(
    "unet",
    UNET_CLASS,
    SVDUNetBackbone,
    unet_config_from_diffusers,
    unet_config_to_diffusers,
    unet_entries,
    unet.init,
)
VAE = Network(
    "vae",
    VAE_CLASS,
    SVDVAECodec,
    vae_config_from_diffusers,
    vae_config_to_diffusers,
    vae_entries,
    vae.init,
)
