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
from pewm_jax.models.cogvideox.vae_codec import VAECodec

TRANSFORMER_CLASS = "CogVideoXTransformer3DModel"
"""The class that the json names."""

DEFAULTS: dict[str, Any] = {
    "num_attention_heads": 30,
    "attention_head_dim": 64,
    "in_channels": 16,
    "out_channels": 16,
    "time_embed_dim": 512,
    "ofs_embed_dim": None,
    "text_embed_dim": 4096,
    "num_layers": 30,
    "sample_width": 90,
    "sample_height": 60,
    "sample_frames": 49,
    "patch_size": 2,
    "patch_size_t": None,
    "temporal_compression_ratio": 4,
    "max_text_seq_length": 226,
    "spatial_interpolation_scale": 1.875,
    "temporal_interpolation_scale": 1.0,
    "use_rotary_positional_embeddings": False,
    "use_learned_positional_embeddings": False,
    "patch_bias": True,
}
"""Settings that differ between networks, and what an absent one means."""
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
IGNORED = ("dropout",)
"""Settings without effect on inference."""


def transformer_config_from_diffusers(values: dict[str, Any]) -> DiTBackbone:
    """Read the settings of ``transformer/config.json``.

    Args:
        values: the json's keys and values; those that start with an underscore are diffusers'
            own notes.

    Raises:
        UserError: a key that is unknown, or a value that is not supported, by its name.
    """
    published.require_class(values, "The transformer", TRANSFORMER_CLASS)
    for key, value in values.items():
        if key in FIXED and value != FIXED[key]:
            raise UserError(f"The transformer's {key} is {value!r}; only {FIXED[key]!r} is known.")
        if not (key.startswith("_") or key in DEFAULTS or key in FIXED or key in IGNORED):
            raise UserError(f"The transformer's setting {key} ({value!r}) is unknown.")
    given = {**DEFAULTS, **{k: v for k, v in values.items() if k in DEFAULTS}}
    for key, value in given.items():
        optional = DEFAULTS[key] is None and value is None
        like = int if DEFAULTS[key] is None else type(DEFAULTS[key])
        kinds = (int, float) if like is float else (like,)
        if not optional and (type(value) not in kinds):
            raise UserError(f"The transformer's {key} is {value!r}; it must be {_a(like)}.")
    return DiTBackbone(
        layers=given["num_layers"],
        heads=given["num_attention_heads"],
        head_dim=given["attention_head_dim"],
        patch=given["patch_size"],
        patch_t=given["patch_size_t"] or 1,
        in_channels=given["in_channels"],
        out_channels=given["out_channels"],
        text_length=given["max_text_seq_length"],
        text_dim=given["text_embed_dim"],
        time_dim=given["time_embed_dim"],
        ofs_dim=given["ofs_embed_dim"] or 0,
        positions=_positions(given),
        sample_height=given["sample_height"],
        sample_width=given["sample_width"],
        sample_frames=given["sample_frames"],
        temporal=given["temporal_compression_ratio"],
        spatial_interpolation=float(given["spatial_interpolation_scale"]),
        temporal_interpolation=float(given["temporal_interpolation_scale"]),
    )


def _a(kind: type) -> str:
    return {int: "a whole number", float: "a number", bool: "true or false"}[kind]


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
        "num_layers": config.layers,
        "num_attention_heads": config.heads,
        "attention_head_dim": config.head_dim,
        "patch_size": config.patch,
        "patch_size_t": config.patch_t if newer else None,
        "patch_bias": not newer,
        "in_channels": config.in_channels,
        "out_channels": config.out_channels,
        "max_text_seq_length": config.text_length,
        "text_embed_dim": config.text_dim,
        "time_embed_dim": config.time_dim,
        "ofs_embed_dim": config.ofs_dim or None,
        "sample_height": config.sample_height or 300,
        "sample_width": config.sample_width or 300,
        "sample_frames": config.sample_frames or 81,
        "temporal_compression_ratio": config.temporal,
        "spatial_interpolation_scale": config.spatial_interpolation,
        "temporal_interpolation_scale": config.temporal_interpolation,
        "use_rotary_positional_embeddings": config.positions != "sincos",
        "use_learned_positional_embeddings": config.positions == "rope_learned",
    }


def transformer_entries(config: DiTBackbone) -> list[Entry]:
    """List every tensor of the reference with the leaf of ours that holds it."""
    return [*_ends(config), *(e for i in range(config.layers) for e in _block(i))]


def _linear(theirs: str, ours: str, layer: int | None = None) -> Iterator[Entry]:
    yield Entry(f"{theirs}.weight", f"{ours}/kernel", LINEAR, layer)
    yield Entry(f"{theirs}.bias", f"{ours}/bias", SAME, layer)


def _norm(theirs: str, ours: str, layer: int | None = None) -> Iterator[Entry]:
    yield Entry(f"{theirs}.weight", f"{ours}/scale", SAME, layer)
    yield Entry(f"{theirs}.bias", f"{ours}/bias", SAME, layer)


def _ends(config: DiTBackbone) -> Iterator[Entry]:
    turn = LINEAR if config.positions == "rope_integer" else _patches(config.patch)
    yield Entry("patch_embed.proj.weight", "patch_embed/kernel", turn)
    yield Entry("patch_embed.proj.bias", "patch_embed/bias")
    yield from _linear("patch_embed.text_proj", "text_embed")
    if config.positions == "rope_learned":
        table = Transform(lambda x: x[0], lambda x: x[None])
        yield Entry("patch_embed.pos_embedding", "positions", table)
    for part in ("linear_1", "linear_2"):
        yield from _linear(f"time_embedding.{part}", f"time_embed/{part}")
        if config.ofs_dim:
            yield from _linear(f"ofs_embedding.{part}", f"ofs_embed/{part}")
    yield from _norm("norm_final", "norm_final")
    yield from _norm("norm_out.norm", "norm_out")
    yield from _linear("norm_out.linear", "modulate_out")
    yield from _linear("proj_out", "proj_out")


def _patches(patch: int) -> Transform:
    """Turn a convolution whose stride is its size into the linear layer on patches that it is."""
    return Transform(
        lambda x: x.reshape(x.shape[0], -1).T,
        lambda x: x.T.reshape(x.shape[1], -1, patch, patch),
    )


def _block(layer: int) -> Iterator[Entry]:
    there, here = f"transformer_blocks.{layer}", "blocks"
    for norm in ("norm1", "norm2"):
        yield from _linear(f"{there}.{norm}.linear", f"{here}/{norm}/linear", layer)
        yield from _norm(f"{there}.{norm}.norm", f"{here}/{norm}/norm", layer)
    for part in ("q", "k", "v"):
        yield from _linear(f"{there}.attn1.to_{part}", f"{here}/to_{part}", layer)
    for part in ("q", "k"):
        yield from _norm(f"{there}.attn1.norm_{part}", f"{here}/norm_{part}", layer)
    yield from _linear(f"{there}.attn1.to_out.0", f"{here}/to_out", layer)
    yield from _linear(f"{there}.ff.net.0.proj", f"{here}/ff/up", layer)
    yield from _linear(f"{there}.ff.net.2", f"{here}/ff/down", layer)


VAE_CLASS = "AutoencoderKLCogVideoX"
"""The reference's class."""
_VAE_FIELDS = {
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
_VAE_FORMER = frozenset(["sample_size"])
"""Settings of the reference's first release, which it does not have any more."""
_VAE_BLOCKS = {
    "down_block_types": "CogVideoXDownBlock3D",
    "up_block_types": "CogVideoXUpBlock3D",
}


def vae_config_from_diffusers(values: dict[str, Any]) -> VAECodec:
    """Read the settings of a diffusers ``vae/config.json``; absent ones have diffusers' defaults.

    Args:
        values: the JSON object.

    Returns:
        The autoencoder.

    Raises:
        UserError: another class, or a setting that is unknown, of the wrong kind or not supported.
    """
    kind = values.get("_class_name", VAE_CLASS)
    if kind != VAE_CLASS:
        raise UserError(
            f"the VAE's config.json describes a {kind!r}; only {VAE_CLASS} can be read."
        )
    fields: dict[str, Any] = {}
    for key, value in values.items():
        if key.startswith("_") or key in _VAE_FORMER:
            continue
        if key in _VAE_FIELDS:
            fields[_VAE_FIELDS[key]] = _checked(key, value)
        elif key in _VAE_FIXED:
            _require_one_of(key, value, value in _VAE_FIXED[key], _VAE_FIXED[key])
        elif key not in _VAE_BLOCKS:
            raise UserError(
                f"the VAE's config.json has an unknown setting {key!r}; known are "
                f"{', '.join(sorted([*_VAE_FIELDS, *_VAE_FIXED, *_VAE_BLOCKS]))}."
            )
    config = VAECodec(**fields)
    for key, block in _VAE_BLOCKS.items():
        expected = [block] * len(config.widths)
        if key in values:
            _require_one_of(key, values[key], list(values[key] or []) == expected, [expected])
    return config


def vae_config_to_diffusers(config: VAECodec) -> dict[str, Any]:
    """Return the JSON object of a diffusers ``vae/config.json``.

    Tiling and the form of the convolutions are not part of it: diffusers switches tiling on when
    running (``enable_tiling``).
    """
    levels = len(config.widths)
    values = {theirs: getattr(config, ours) for theirs, ours in _VAE_FIELDS.items()}
    return {
        "_class_name": VAE_CLASS,
        **values,
        "block_out_channels": list(config.widths),
        **{key: [block] * levels for key, block in _VAE_BLOCKS.items()},
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
        (r"/(kernel|scale)$", "/weight"),
        (r"/", "."),
    )
    return rename(path, rules)


def _checked(key: str, value: Any) -> Any:
    """Check one of their settings against the kind of our field's default; lists become tuples."""
    default: Any = getattr(VAECodec(), _VAE_FIELDS[key])
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
            f"the VAE's config.json has {key} = {value!r}; give a value like {default!r}."
        )
    return as_type(value)


def _require_one_of(key: str, value: Any, fits: bool, allowed: Any) -> None:
    if not fits:
        raise UserError(
            f"the VAE's config.json has {key} = {value!r}, which is not supported: only "
            f"{' or '.join(map(repr, allowed))} is."
        )


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
