"""Wan's autoencoder in diffusers: its settings and tensor names, theirs and ours.

Reference: ``AutoencoderKLWan`` of diffusers, in the form of Wan 2.1 (that of Wan 2.2 has other
blocks and is refused).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from pewm_jax.errors import UserError
from pewm_jax.io import published
from pewm_jax.io.published import Entry, Network, Transform, rename
from pewm_jax.models.wan import vae
from pewm_jax.models.wan.vae import MEAN_16, STD_16, WanVAECodec

CLASS = "AutoencoderKLWan"
"""The reference's class."""
WHAT = "The VAE"
GAMMA_3D = Transform(lambda x: x[:, 0, 0, 0], lambda x: x[:, None, None, None])
"""torch (C, 1, 1, 1) ↔ ours (C,)."""
GAMMA_2D = Transform(lambda x: x[:, 0, 0], lambda x: x[:, None, None])
"""torch (C, 1, 1) ↔ ours (C,)."""
POINTWISE_3D = Transform(lambda x: x[:, :, 0, 0, 0].T, lambda x: x.T[:, :, None, None, None])
"""torch (out, in, 1, 1, 1) ↔ ours (in, out)."""
_FIELDS: dict[str, tuple[str, Any]] = {
    "base_dim": ("base_width", 96),
    "z_dim": ("latent_channels", 16),
    "dim_mult": ("multiples", [1, 2, 4, 4]),
    "num_res_blocks": ("resnets", 2),
    "temperal_downsample": ("halves_time", [False, True, True]),
    "latents_mean": ("latents_mean", list(MEAN_16)),
    "latents_std": ("latents_std", list(STD_16)),
    "in_channels": ("in_channels", 3),
    "out_channels": ("out_channels", 3),
}
"""Their setting → our field, and what diffusers takes for one that a file leaves out."""
_BASE = {"decoder_base_dim": None}
_ONLY: dict[str, Any] = {"attn_scales": [], "is_residual": False, "patch_size": None}
"""Settings of which one value is supported, which is also what diffusers takes."""
_WITHOUT_EFFECT = ("dropout", "scale_factor_temporal", "scale_factor_spatial")
"""Settings that do not change what the network computes, unless in tiles."""


def config_from_diffusers(values: Mapping[str, Any]) -> WanVAECodec:
    """Read the settings of ``vae/config.json``; absent ones have diffusers' defaults.

    Raises:
        UserError: another class, or a setting that is unknown or not supported.
    """
    checked = published.defaults(_FIELDS)
    defaults = {**checked, **_BASE, **_ONLY}
    given = published.read_settings(values, WHAT, CLASS, defaults, _WITHOUT_EFFECT)
    published.require_only(given, WHAT, _ONLY)
    published.require_kinds(given, WHAT, checked)
    decoder = given["decoder_base_dim"]
    if decoder is not None and type(decoder) is not int:
        raise UserError(f"{WHAT}'s decoder_base_dim is {decoder!r}; it must be a whole number.")
    return WanVAECodec(
        **published.read_fields(_FIELDS, given),
        decoder_base_width=given["base_dim"] if decoder is None else decoder,
    )


def config_to_diffusers(config: WanVAECodec) -> dict[str, Any]:
    """Write the settings of ``vae/config.json``, the inverse of reading them.

    The form of the convolutions is not part of it.
    """
    same = config.decoder_base_width == config.base_width
    return {
        "_class_name": CLASS,
        **_ONLY,
        **published.write_fields(_FIELDS, config),
        "decoder_base_dim": None if same else config.decoder_base_width,
        "dropout": 0.0,
        "scale_factor_temporal": config.temporal,
        "scale_factor_spatial": config.spatial,
    }


def entries(config: WanVAECodec) -> list[Entry]:
    """Return one entry per tensor of the reference."""
    return [
        Entry(_name(config, path), path, _transform(path, shape))
        for path, shape in vae.layout(config).items()
    ]


def _transform(path: str, shape: tuple[int, ...]) -> Transform:
    """Return the change of layout of a leaf."""
    attends = "/attend_0/" in path
    if path.endswith("/scale"):
        return GAMMA_2D if attends else GAMMA_3D
    if path.endswith("/bias"):
        return published.SAME
    if len(shape) == 2:
        return published.POINTWISE if attends else POINTWISE_3D
    return published.TIME_CONV if len(shape) == 3 else published.CONV


def _name(config: WanVAECodec, path: str) -> str:
    """Turn ``encoder/down_1/resnet_0/conv1/kernel`` into the reference's name.

    On the way down it numbers the blocks of all levels in one row.
    """

    def flat(found: re.Match) -> str:
        level, kind, number = int(found[1]), found[2], int(found[3] or config.resnets)
        rest = "" if kind == "resnet" else "resample/"
        return f"encoder/down_blocks.{level * (config.resnets + 1) + number}/{rest}"

    rules: tuple[tuple[str, Any], ...] = (
        (r"^encoder/down_(\d+)/(resnet|resample)(?:_(\d+))?/", flat),
        (r"^encoder/quant/", "quant_conv/"),
        (r"^decoder/quant/", "post_quant_conv/"),
        (r"/up_(\d+)/", r"/up_blocks.\1/"),
        (r"/mid/", "/mid_block/"),
        (r"(up_blocks.*)/resample/", r"\1/upsamplers.0/resample/"),
        (r"resample/space/", "resample.1/"),
        (r"resample/time/", "time_conv/"),
        (r"resnet_(\d+)/", r"resnets.\1/"),
        (r"attend_(\d+)/", r"attentions.\1/"),
        (r"to_out/", "proj/"),
        (r"shortcut/", "conv_shortcut/"),
        (r"/scale$", "/gamma"),
    )
    return rename(path, rules)


VAE = Network(
    "vae", CLASS, WanVAECodec, config_from_diffusers, config_to_diffusers, entries, vae.init
)
