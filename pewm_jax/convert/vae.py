"""CogVideoX's autoencoder: its settings and tensor names, and ours.

Reference: ``AutoencoderKLCogVideoX`` of diffusers.
"""

from __future__ import annotations

import re
from typing import Any

from pewm_jax.config import UserError, VAEConfig
from pewm_jax.convert.mapping import CONV, SAME, Entry
from pewm_jax.models.cogvideox import vae

CLASS = "AutoencoderKLCogVideoX"
"""The reference's class."""
_FIELDS = {
    "in_channels": "in_channels",
    "out_channels": "out_channels",
    "latent_channels": "latent_channels",
    "block_out_channels": "widths",
    "layers_per_block": "resnets",
    "norm_num_groups": "groups",
    "norm_eps": "eps",
    "temporal_compression_ratio": "temporal",
    "sample_height": "sample_height",
    "sample_width": "sample_width",
    "scaling_factor": "scaling_factor",
    "invert_scale_latents": "invert_scale_latents",
}
"""Their setting → our field."""
_FIXED: dict[str, tuple[Any, ...]] = {
    "act_fn": ("silu", "swish"),
    "shift_factor": (None,),
    "latents_mean": (None,),
    "latents_std": (None,),
    "use_quant_conv": (False,),
    "use_post_quant_conv": (False,),
    "force_upcast": (True, False),
}
"""Settings that change nothing here, and the values that may stand there; the first is written."""
_FORMER = frozenset(["sample_size"])
"""Settings of the reference's first release, which it does not have any more."""
_BLOCKS = {
    "down_block_types": "CogVideoXDownBlock3D",
    "up_block_types": "CogVideoXUpBlock3D",
}


def config_from_diffusers(values: dict[str, Any]) -> VAEConfig:
    """Read the settings of a diffusers ``vae/config.json``; absent ones have diffusers' defaults.

    Args:
        values: the JSON object.

    Returns:
        The autoencoder.

    Raises:
        UserError: another class, or a setting that is unknown, of the wrong kind or not supported.
    """
    kind = values.get("_class_name", CLASS)
    if kind != CLASS:
        raise UserError(f"the VAE's config.json describes a {kind!r}; only {CLASS} can be read.")
    fields: dict[str, Any] = {}
    for key, value in values.items():
        if key.startswith("_") or key in _FORMER:
            continue
        if key in _FIELDS:
            fields[_FIELDS[key]] = _coerce(key, value)
        elif key in _FIXED:
            _require(key, value, value in _FIXED[key], _FIXED[key])
        elif key not in _BLOCKS:
            raise UserError(
                f"the VAE's config.json has an unknown setting {key!r}; known are "
                f"{', '.join(sorted([*_FIELDS, *_FIXED, *_BLOCKS]))}."
            )
    config = VAEConfig(**fields)
    for key, block in _BLOCKS.items():
        expected = [block] * len(config.widths)
        if key in values:
            _require(key, values[key], list(values[key] or []) == expected, [expected])
    return config


def config_to_diffusers(config: VAEConfig) -> dict[str, Any]:
    """Return the JSON object of a diffusers ``vae/config.json``.

    Tiling and the form of the convolutions are not part of it: diffusers switches tiling on when
    running (``enable_tiling``).
    """
    levels = len(config.widths)
    values = {theirs: getattr(config, ours) for theirs, ours in _FIELDS.items()}
    return {
        "_class_name": CLASS,
        **values,
        "block_out_channels": list(config.widths),
        **{key: [block] * levels for key, block in _BLOCKS.items()},
        **{key: allowed[0] for key, allowed in _FIXED.items()},
    }


def entries(config: VAEConfig) -> list[Entry]:
    """Return one entry per tensor of the reference."""
    return [
        Entry(_theirs(path), path, CONV if path.endswith("/kernel") else SAME)
        for path in vae.layout(config)
    ]


def _theirs(path: str) -> str:
    """Turn ``decoder/up_0/resnet_1/norm1/scale`` into the reference's name."""
    conditioned = path.startswith("decoder/")
    rules = (
        (r"^(\w+)/(down|up)_(\d+)/", r"\1.\2_blocks.\3."),
        (r"^(\w+)/mid/", r"\1.mid_block."),
        (r"resnet_(\d+)/", r"resnets.\1."),
        (r"resample/", "downsamplers.0.conv/" if not conditioned else "upsamplers.0.conv/"),
        (r"shortcut/", "conv_shortcut/"),
        (r"(norm\w+)/(scale|bias)$", r"\1.norm_layer/\2" if conditioned else r"\1/\2"),
        (r"scale_by/", "conv_y.conv/"),
        (r"shift_by/", "conv_b.conv/"),
        (r"(conv\d|conv_in|conv_out)/", r"\1.conv/"),
        (r"/(kernel|scale)$", "/weight"),
        (r"/", "."),
    )
    for pattern, name in rules:
        path = re.sub(pattern, name, path)
    return path


def _coerce(key: str, value: Any) -> Any:
    """Check one of their settings against the kind of our field's default; lists become tuples."""
    default: Any = getattr(VAEConfig(), _FIELDS[key])
    as_type: Any
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if isinstance(default, bool):
        fits, as_type = isinstance(value, bool), bool
    elif isinstance(default, tuple):
        fits = isinstance(value, (list, tuple)) and all(type(item) is int for item in value)
        as_type = tuple
    elif isinstance(default, int):
        fits, as_type = number and value == int(value), int
    else:
        fits, as_type = number, float
    if not fits:
        raise UserError(
            f"the VAE's config.json has {key} = {value!r}, where a value like {default!r} belongs."
        )
    return as_type(value)


def _require(key: str, value: Any, fits: bool, allowed: Any) -> None:
    if not fits:
        raise UserError(
            f"the VAE's config.json has {key} = {value!r}, which is not supported: only "
            f"{' or '.join(map(repr, allowed))} is."
        )
