"""Cosmos-Predict2: read its networks, write them back, and import it as a world model.

A pipeline's folder has ``transformer/``, ``vae/`` and ``scheduler/``. Every tensor of a folder must
be used. The text encoder (T5) is not converted. If there is one, two prompts are encoded with it:
the prompt of the videos, and the negative prompt for guidance. The world model has the settings of
the preset ``egowm_cosmos2b`` around the checkpoint's networks, and newly initialized layers for the
actions, which have no effect until they are trained.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Literal

from pewm_jax.config import Config, UserError
from pewm_jax.convert import pipeline, schedulers, text
from pewm_jax.models.cosmos.convert import TRANSFORMER
from pewm_jax.models.wan.convert import VAE
from pewm_jax.types import Params
from pewm_jax.worlds.egowm import paper as egowm_paper

read_transformer = functools.partial(pipeline.read, TRANSFORMER)
"""Read the transformer for ``pewm_jax.models.cosmos.model.apply``; see ``pipeline.read``."""
write_transformer = functools.partial(pipeline.write, TRANSFORMER)
"""Write the transformer for diffusers' ``from_pretrained``; see ``pipeline.write``."""
read_vae = functools.partial(pipeline.read, VAE)
"""Read the autoencoder for ``pewm_jax.models.wan.vae``; see ``pipeline.read``."""
write_vae = functools.partial(pipeline.write, VAE)
"""Write the autoencoder for diffusers' ``from_pretrained``; see ``pipeline.write``."""
read_scheduler = functools.partial(schedulers.read, schedulers.COSMOS)
"""Read the scheduler of a checkpoint, an ``EDMConfig``; see ``schedulers.read``."""


def config_of(
    src: Path, dst: Path, dtype: str | None, clip: tuple[int, int, int], *, prompt: bool
) -> Config:
    """Return the settings of the world model around a pipeline's networks.

    16-bit weights are computed in bfloat16. ``clip`` is frames, height and width, and ``prompt``
    tells whether the embeddings of prompts are stored.

    Raises:
        UserError: a network of another class, unknown settings, or a transformer that is not for
            video.
        ConfigError: the networks do not fit each other or the clip.
    """
    transformer, vae = (pipeline.read_config(network, src) for network in (TRANSFORMER, VAE))
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
    """Write a world model's folder: ``config.json`` and ``weights.safetensors``.

    Args:
        src: a pipeline's folder in the layout of diffusers: transformer/, vae/, scheduler/ and, if
            there is one, text_encoder/ with tokenizer/.
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
    pipeline.refuse_existing(dst)
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
        parts["text"] = pipeline.made(tokens, lambda: tokens, dtype)
    pipeline.write_world(dst, config, parts)
    return bool(encoded)
