"""The settings and tensor names of Stable Video Diffusion's autoencoder, and ours.

Reference: ``AutoencoderKLTemporalDecoder`` of diffusers.
"""

from __future__ import annotations

from typing import Any

from pewm_jax.config import SVDVAEConfig, UserError
from pewm_jax.convert import settings
from pewm_jax.convert.mapping import Entry
from pewm_jax.convert.svd_unet import POINTWISE, RULES, renamed, turn
from pewm_jax.models.svd import vae as svd_vae

CLASS = "AutoencoderKLTemporalDecoder"
"""The reference's class."""
BLOCK = "DownEncoderBlock2D"
"""The only kind of block on the way down."""
_DEFAULTS: dict[str, Any] = {
    "in_channels": 3,
    "out_channels": 3,
    "latent_channels": 4,
    "block_out_channels": [64],
    "down_block_types": [BLOCK],
    "layers_per_block": 1,
    "scaling_factor": 0.18215,
}
"""What diffusers takes for settings that a file leaves out."""
_WITHOUT_EFFECT = {"sample_size": 768, "force_upcast": True}
"""Settings that the network does not read, and what is written for them."""
_RULES = (
    (r"^encoder/quant/", "quant_conv/"),
    (r"time_out/", "time_conv_out/"),
    (r"attend_(\d+)/norm/", r"attend_\1/group_norm/"),
)


def config_from_diffusers(values: dict[str, Any]) -> SVDVAEConfig:
    """Read the settings of ``vae/config.json``; absent ones have diffusers' defaults.

    Raises:
        UserError: another class, or a setting that is unknown or not supported.
    """
    given = settings.of_network(values, "The VAE", CLASS, _DEFAULTS, _WITHOUT_EFFECT)
    widths = given["block_out_channels"]
    whole = ("in_channels", "out_channels", "latent_channels", "layers_per_block")
    for key, numbers in (*((k, [given[k]]) for k in whole), ("block_out_channels", widths)):
        if not isinstance(numbers, list | tuple) or any(type(n) is not int for n in numbers):
            raise UserError(f"The VAE's {key} is {given[key]!r}; it must be of whole numbers.")
    if list(given["down_block_types"]) != [BLOCK] * len(widths):
        raise UserError(
            f"The VAE's down_block_types is {given['down_block_types']!r}; only one {BLOCK} per "
            "level is known."
        )
    factor = given["scaling_factor"]
    if isinstance(factor, bool) or not isinstance(factor, int | float):
        raise UserError(f"The VAE's scaling_factor is {factor!r}; it must be a number.")
    return SVDVAEConfig(
        in_channels=given["in_channels"],
        out_channels=given["out_channels"],
        latent_channels=given["latent_channels"],
        widths=tuple(widths),
        resnets=given["layers_per_block"],
        scaling_factor=float(factor),
    )


def config_to_diffusers(config: SVDVAEConfig) -> dict[str, Any]:
    """Write the settings of ``vae/config.json``, the inverse of reading them."""
    return {
        "_class_name": CLASS,
        **_WITHOUT_EFFECT,
        "in_channels": config.in_channels,
        "out_channels": config.out_channels,
        "latent_channels": config.latent_channels,
        "block_out_channels": list(config.widths),
        "down_block_types": [BLOCK] * len(config.widths),
        "layers_per_block": config.resnets,
        "scaling_factor": config.scaling_factor,
    }


def entries(config: SVDVAEConfig) -> list[Entry]:
    """Return one entry per tensor of the reference."""
    return [_entry(path, shape) for path, shape in svd_vae.layout(config).items()]


def _entry(path: str, shape: tuple[int, ...]) -> Entry:
    """Pair a leaf with the reference's tensor."""
    quant = path == "encoder/quant/kernel"
    change = POINTWISE if quant else turn(path, shape)
    return Entry(renamed(path, (*_RULES, *RULES)), path, change)
