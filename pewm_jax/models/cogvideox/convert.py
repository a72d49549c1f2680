"""CogVideoX's checkpoints in diffusers: settings and tensor names, theirs and ours.

References: ``CogVideoXTransformer3DModel`` and ``AutoencoderKLCogVideoX`` of diffusers,
``transformer/`` and ``vae/`` of a CogVideoX folder.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pewm_jax.errors import UserError
from pewm_jax.io import published
from pewm_jax.io.published import CONV, LINEAR, SAME, Entry, Network, Transform, rename
from pewm_jax.models.cogvideox import model, vae
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.cogvideox.vae import VAECodec

TRANSFORMER_CLASS = "CogVideoXTransformer3DModel"
"""The class that the json names."""

_FIELDS: dict[str, tuple[str, Any]] = {
    "num_attention_heads": ("heads", 30),
    "attention_head_dim": ("head_dim", 64),
    "in_channels": ("in_channels", 16),
    "out_channels": ("out_channels", 16),
    "time_embed_dim": ("time_dim", 512),
    "text_embed_dim": ("text_dim", 4096),
    "num_layers": ("layers", 30),
    "sample_width": ("sample_width", 90),
    "sample_height": ("sample_height", 60),
    "sample_frames": ("sample_frames", 49),
    "patch_size": ("patch", 2),
    "temporal_compression_ratio": ("temporal", 4),
    "max_text_seq_length": ("text_length", 226),
    "spatial_interpolation_scale": ("spatial_interpolation", 1.875),
    "temporal_interpolation_scale": ("temporal_interpolation", 1.0),
}
"""Their setting → our field, and what an absent one means."""
_SWITCHES = {
    "use_rotary_positional_embeddings": False,
    "use_learned_positional_embeddings": False,
    "patch_bias": True,
}
_OPTIONAL = {"ofs_embed_dim": None, "patch_size_t": None}
"""Whole numbers, or None for none."""
FIXED: dict[str, Any] = {
    "flip_sin_to_cos": True,
    "freq_shift": 0,
    "attention_bias": True,
    "activation_fn": "gelu-approximate",
    "timestep_activation_fn": "silu",
    "norm_elementwise_affine": True,
    "norm_eps": 1e-5,
}
"""Settings that are equal in every published network; other values are not supported."""
WHAT = "The transformer"


def transformer_config_from_diffusers(values: dict[str, Any]) -> DiTBackbone:
    """Read the settings of ``transformer/config.json``; absent ones have diffusers' defaults.

    Raises:
        UserError: another class, or a setting that is unknown or not supported.
    """
    checked = {**published.defaults(_FIELDS), **_SWITCHES}
    defaults = {**checked, **_OPTIONAL, **FIXED}
    given = published.read_settings(values, WHAT, TRANSFORMER_CLASS, defaults, ["dropout"])
    published.require_only(given, WHAT, FIXED)
    optional = {key: 1 for key in _OPTIONAL if given[key] is not None}
    published.require_kinds(given, WHAT, {**checked, **optional})
    return DiTBackbone(
        **published.read_fields(_FIELDS, given),
        patch_t=given["patch_size_t"] or 1,
        ofs_dim=given["ofs_embed_dim"] or 0,
        positions=_positions(given),
    )


def _positions(given: dict[str, Any]) -> Any:
    rotary = given["use_rotary_positional_embeddings"]
    learned = given["use_learned_positional_embeddings"]
    newer = given["patch_size_t"] is not None
    if newer and (learned or not rotary):
        raise UserError(
            "The transformer has patch_size_t with "
            + ("use_learned_positional_embeddings true" if learned else "no rotary positions")
            + "; CogVideoX 1.5 has rotary positions alone, and only that is known."
        )
    if learned and not rotary:
        raise UserError(
            "The transformer's use_learned_positional_embeddings is true with "
            "use_rotary_positional_embeddings false; only both together are known."
        )
    if not newer and not given["patch_bias"]:
        raise UserError(
            "The transformer's patch_bias is False with no patch_size_t; only True is known."
        )
    if newer:
        return "rope_integer"
    if learned:
        return "rope_learned"
    return "rope_crop" if rotary else "sincos"


def transformer_config_to_diffusers(config: DiTBackbone) -> dict[str, Any]:
    """Write the settings of ``transformer/config.json``, the inverse of reading them.

    Raises:
        UserError: a setting that CogVideoX does not have.
    """
    if config.mlp_ratio != 4:
        raise UserError(f"backbone.mlp_ratio is {config.mlp_ratio}; CogVideoX supports only 4.")
    newer = config.positions == "rope_integer"
    return {
        "_class_name": TRANSFORMER_CLASS,
        **FIXED,
        "dropout": 0.0,
        **published.write_fields(_FIELDS, config),
        "patch_size_t": config.patch_t if newer else None,
        "patch_bias": not newer,
        "ofs_embed_dim": config.ofs_dim or None,
        "sample_height": config.sample_height or 300,
        "sample_width": config.sample_width or 300,
        "sample_frames": config.sample_frames or 81,
        "use_rotary_positional_embeddings": config.positions != "sincos",
        "use_learned_positional_embeddings": config.positions == "rope_learned",
    }


def transformer_entries(config: DiTBackbone) -> list[Entry]:
    """List every tensor of the reference with the leaf of ours that holds it."""
    return [*_ends(config), *(e for i in range(config.layers) for e in _block(i))]


def _ends(config: DiTBackbone) -> Iterator[Entry]:
    turn = LINEAR if config.positions == "rope_integer" else _patches(config.patch)
    yield from published.affine("patch_embed.proj", "patch_embed", transform=turn)
    yield from published.affine("patch_embed.text_proj", "text_embed")
    if config.positions == "rope_learned":
        table = Transform(lambda x: x[0], lambda x: x[None])
        yield Entry("patch_embed.pos_embedding", "positions", table)
    for part in ("linear_1", "linear_2"):
        yield from published.affine(f"time_embedding.{part}", f"time_embed/{part}")
        if config.ofs_dim:
            yield from published.affine(f"ofs_embedding.{part}", f"ofs_embed/{part}")
    yield from published.norm("norm_final", "norm_final")
    yield from published.norm("norm_out.norm", "norm_out")
    yield from published.affine("norm_out.linear", "modulate_out")
    yield from published.affine("proj_out", "proj_out")


def _patches(patch: int) -> Transform:
    """Turn a convolution whose stride is its size into the linear layer on patches that it is."""
    return Transform(
        lambda x: x.reshape(x.shape[0], -1).T,
        lambda x: x.T.reshape(x.shape[1], -1, patch, patch),
    )


def _block(layer: int) -> Iterator[Entry]:
    there, here = f"transformer_blocks.{layer}", "blocks"
    for norm in ("norm1", "norm2"):
        yield from published.affine(f"{there}.{norm}.linear", f"{here}/{norm}/linear", layer)
        yield from published.norm(f"{there}.{norm}.norm", f"{here}/{norm}/norm", layer)
    for part in ("q", "k", "v"):
        yield from published.affine(f"{there}.attn1.to_{part}", f"{here}/to_{part}", layer)
    for part in ("q", "k"):
        yield from published.norm(f"{there}.attn1.norm_{part}", f"{here}/norm_{part}", layer)
    yield from published.affine(f"{there}.attn1.to_out.0", f"{here}/to_out", layer)
    yield from published.affine(f"{there}.ff.net.0.proj", f"{here}/ff/up", layer)
    yield from published.affine(f"{there}.ff.net.2", f"{here}/ff/down", layer)


VAE_CLASS = "AutoencoderKLCogVideoX"
"""The reference's class."""
_VAE_FIELDS: dict[str, tuple[str, Any]] = {
    "in_channels": ("in_channels", 3),
    "out_channels": ("out_channels", 3),
    "latent_channels": ("latent_channels", 16),
    "block_out_channels": ("widths", [128, 256, 256, 512]),
    "layers_per_block": ("resnets", 3),
    "norm_num_groups": ("groups", 32),
    "norm_eps": ("eps", 1e-6),
    "temporal_compression_ratio": ("temporal", 4),
    "sample_height": ("sample_height", 480),
    "sample_width": ("sample_width", 720),
    "scaling_factor": ("scaling_factor", 1.15258426),
    "invert_scale_latents": ("invert_scale_latents", False),
}
"""Their setting → our field, and what diffusers takes for one that a file leaves out."""
_VAE_FIXED: dict[str, tuple[Any, ...]] = {
    "act_fn": ("silu", "swish"),
    "shift_factor": (None,),
    "latents_mean": (None,),
    "latents_std": (None,),
    "use_quant_conv": (False,),
    "use_post_quant_conv": (False,),
    "force_upcast": (True, False),
}
"""Settings without effect here, and their allowed values; the first is written."""
_VAE_FORMER = "sample_size"
"""A setting of the reference's first release, which it does not have any more."""
_VAE_BLOCKS = {
    "down_block_types": "CogVideoXDownBlock3D",
    "up_block_types": "CogVideoXUpBlock3D",
}
_VAE_WHAT = "The VAE"


def vae_config_from_diffusers(values: dict[str, Any]) -> VAECodec:
    """Read the settings of ``vae/config.json``; absent ones have diffusers' defaults.

    Raises:
        UserError: another class, or a setting that is unknown or not supported.
    """
    checked = published.defaults(_VAE_FIELDS)
    fixed = {key: allowed[0] for key, allowed in _VAE_FIXED.items()}
    ignored = (_VAE_FORMER, *_VAE_BLOCKS)
    given = published.read_settings(values, _VAE_WHAT, VAE_CLASS, {**checked, **fixed}, ignored)
    ratio = given["temporal_compression_ratio"]
    if isinstance(ratio, float) and ratio.is_integer():  # diffusers declares it as a float
        given["temporal_compression_ratio"] = int(ratio)
    published.require_kinds(given, _VAE_WHAT, checked)
    for key, allowed in _VAE_FIXED.items():
        published.require_choice(given, _VAE_WHAT, key, allowed)
    levels = len(given["block_out_channels"])
    blocks = {key: [block] * levels for key, block in _VAE_BLOCKS.items()}
    published.require_only(values, _VAE_WHAT, blocks)
    return VAECodec(**published.read_fields(_VAE_FIELDS, given))


def vae_config_to_diffusers(config: VAECodec) -> dict[str, Any]:
    """Write the settings of ``vae/config.json``, the inverse of reading them.

    Tiling and the form of the convolutions are not part of it: diffusers switches tiling on when
    running (``enable_tiling``).
    """
    return {
        "_class_name": VAE_CLASS,
        **published.write_fields(_VAE_FIELDS, config),
        **{key: [block] * len(config.widths) for key, block in _VAE_BLOCKS.items()},
        **{key: allowed[0] for key, allowed in _VAE_FIXED.items()},
    }


def vae_entries(config: VAECodec) -> list[Entry]:
    """Return one entry per tensor of the reference."""
    return [
        Entry(_vae_name(path), path, CONV if path.endswith("/kernel") else SAME)
        for path in vae.layout(config)
    ]


def _vae_name(path: str) -> str:
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
    )
    return rename(path, rules)


TRANSFORMER = Network(
    "transformer",
    TRANSFORMER_CLASS,
    DiTBackbone,
    transformer_config_from_diffusers,
    transformer_config_to_diffusers,
    transformer_entries,
    model.init,
)
VAE = Network(
    "vae",
    VAE_CLASS,
    VAECodec,
    vae_config_from_diffusers,
    vae_config_to_diffusers,
    vae_entries,
    vae.init,
)
