"""Cosmos-Predict2: read its networks, write them back, and import it as a world model.

A pipeline's folder has ``transformer/``, ``vae/`` and ``scheduler/``. Every tensor of a folder must
be used. The text encoder (T5) is not converted. If there is one, two prompts are encoded with it:
the prompt of the videos, and the negative prompt for guidance. The world model has the settings of
the preset ``egowm_cosmos2b`` around the checkpoint's networks, and newly initialized layers for the
actions, which have no effect until they are trained.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

from pewm_jax.config import Config, UserError
from pewm_jax.convert import output, pipeline, schedulers, text
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.models.cosmos.backbone import CosmosBackbone
from pewm_jax.models.cosmos.convert import TRANSFORMER
from pewm_jax.models.wan.codec import WanVAECodec
from pewm_jax.models.wan.convert import VAE
from pewm_jax.types import Params
from pewm_jax.worlds.egowm import paper as egowm_paper


def read_transformer(folder: str | Path, dtype: str | None = None) -> tuple[CosmosBackbone, Params]:
    """Read the transformer for ``pewm_jax.models.cosmos.model.apply``; see ``pipeline.read``."""
    return pipeline.read(TRANSFORMER, folder, dtype)


def write_transformer(
    config: CosmosBackbone, params: Params, folder: str | Path, dtype: str | None = None
) -> None:
    """Write the transformer for diffusers' ``from_pretrained``; see ``pipeline.write``.

    Settings of the attention implementation and of rematerialization are not written.
    """
    pipeline.write(TRANSFORMER, config, params, folder, dtype)


def read_vae(folder: str | Path, dtype: str | None = None) -> tuple[WanVAECodec, Params]:
    """Read the autoencoder for ``pewm_jax.models.wan.vae``; see ``pipeline.read``."""
    return pipeline.read(VAE, folder, dtype)


def write_vae(
    config: WanVAECodec, params: Params, folder: str | Path, dtype: str | None = None
) -> None:
    """Write the autoencoder for diffusers' ``from_pretrained``; see ``pipeline.write``."""
    pipeline.write(VAE, config, params, folder, dtype)


def read_scheduler(folder: str | Path) -> EDMConfig:
    """Read the scheduler of a checkpoint: settings only, it has no weights.

    Args:
        folder: a diffusers pipeline's folder, or the scheduler's folder in it.

    Raises:
        UserError: a class or setting is unknown.
    """
    return schedulers.read(schedulers.COSMOS, folder)


def config_of(
    src: Path, dst: Path, dtype: str | None, clip: tuple[int, int, int], *, prompt: bool
) -> Config:
    """Return the settings of the world model around a pipeline's networks.

    Args:
        src: the pipeline's folder.
        dst: the folder to create; runs get its name.
        dtype: dtype of the weights; 16-bit weights are computed in bfloat16.
        clip: frames, height and width.
        prompt: whether the embeddings of prompts are stored.

    Raises:
        UserError: a network of another class, unknown settings, or a transformer that is not for
            video.
        ConfigError: the networks do not fit each other or the clip.
    """
    transformer, vae = (pipeline.read_config(network, src) for network in (TRANSFORMER, VAE))
    assert isinstance(transformer, CosmosBackbone)
    assert isinstance(vae, WanVAECodec)
    latents = vae.latent_channels
    found = transformer.in_channels, transformer.out_channels
    if found != (latents + 1, latents):
        raise UserError(
            f"The transformer has {found[0]} input and {found[1]} output channels; one for video "
            f"takes the {latents} of the autoencoder's latents and 1 that marks given frames: "
            "import a Video2World checkpoint."
        )
    precision: Literal["float32", "bfloat16"] = "float32" if dtype == "float32" else "bfloat16"
    return egowm_paper.cosmos_experiment(
        dataclasses.replace(transformer, prompt="stored" if prompt else "zeros"),
        vae,
        read_scheduler(src),
        run=dst.name,
        clip=clip,
        dtype=precision,
    )


def import_world(
    src: Path,
    dst: Path,
    dtype: str | None = None,
    clip: tuple[int, int, int] = egowm_paper.COSMOS_CLIP,
    prompts: tuple[str, str] = ("", ""),
) -> bool:
    """Write the folder: ``config.json`` and ``weights.safetensors``.

    Args:
        src: a pipeline's folder in the layout of diffusers: transformer/, vae/, scheduler/ and, if
            there is one, text_encoder/ with tokenizer/.
        dst: the folder to create.
        dtype: dtype of the weights; by default the stored one, and float32 for the actions' layers
            and the prompts.
        clip: frames, height and width.
        prompts: the prompt and the negative prompt.

    Returns:
        Whether prompts were encoded.

    Raises:
        UserError: ``dst`` exists, or ``src`` is incomplete, damaged or of another type.
        ConfigError: the networks do not fit each other or the clip.
    """
    output.refuse_existing(dst)
    backbone, codec = (pipeline.part(network, src, dtype) for network in (TRANSFORMER, VAE))
    stored = backbone[0]["proj_out/kernel"].dtype.name
    config = config_of(src, dst, dtype or stored, clip, prompt=False)
    length, width = config.model.backbone.text_shape
    encoded = text.encode(src, prompts, length, width, masked=True)
    parts: dict[str, pipeline.Part] = {
        "backbone": backbone,
        "codec": codec,
        "control": pipeline.fresh_actions(config, dtype),
    }
    if encoded:
        config = config_of(src, dst, dtype or stored, clip, prompt=True)
        tokens: Params = dict(
            zip(("prompt_LC", "negative_LC"), (encoded[prompt] for prompt in prompts), strict=True)
        )
        parts["text"] = (pipeline.cast_specs(tokens, dtype), lambda: tokens)
    pipeline.write_world(dst, config, parts)
    return bool(encoded)
