"""A checkpoint of Cosmos-Predict2 as a world model, before any training on actions.

The folder has the settings of the preset ``egowm_cosmos2b`` around the checkpoint's networks, and
fresh layers for the actions, which change nothing yet. Where the pipeline has a text encoder, two
prompts are encoded and stored: the one that videos are made with, and the one that guidance pushes
away from.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

from pewm_jax.config import Config, CosmosConfig, UserError, WanVAEConfig
from pewm_jax.convert import cogvideox, cosmos, output, text, whole_world
from pewm_jax.types import Params
from pewm_jax.worlds.egowm import paper as egowm_paper


def config_of(
    src: Path, dst: Path, dtype: str | None, clip: tuple[int, int, int], *, prompt: bool
) -> Config:
    """Return the settings of the world model around a pipeline's networks.

    Args:
        src: the pipeline's folder.
        dst: the folder to be made, whose name the runs have.
        dtype: of the weights; 16 bits are computed in bfloat16.
        clip: frames, height and width.
        prompt: whether prompts' embeddings are stored.

    Raises:
        UserError: a network of another class, settings that are not known, or a transformer that is
            not for video.
        ConfigError: the networks do not fit each other or the clip.
    """
    transformer, vae = (
        network.config(cogvideox.settings(network, src), network.folder)
        for network in (cosmos.TRANSFORMER, cosmos.VAE)
    )
    assert isinstance(transformer, CosmosConfig)
    assert isinstance(vae, WanVAEConfig)
    latents = vae.latent_channels
    found = transformer.in_channels, transformer.out_channels
    if found != (latents + 1, latents):
        raise UserError(
            f"The transformer takes {found[0]} channels and gives {found[1]}; one for video takes "
            f"the {latents} of the autoencoder's latents and 1 that marks given frames: import a "
            "Video2World checkpoint."
        )
    precision: Literal["float32", "bfloat16"] = "float32" if dtype == "float32" else "bfloat16"
    return egowm_paper.cosmos_experiment(
        dataclasses.replace(transformer, prompt="stored" if prompt else "zeros"),
        vae,
        cosmos.read_scheduler(src),
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
        src: a pipeline's folder as diffusers writes it: transformer/, vae/, scheduler/ and, if
            there is one, text_encoder/ with tokenizer/.
        dst: the folder to make.
        dtype: of the weights; by default the stored one, and float32 for the actions' layers and
            the prompts.
        clip: frames, height and width.
        prompts: the prompt, and the one that guidance pushes away from.

    Returns:
        Whether prompts were encoded.

    Raises:
        UserError: ``dst`` exists, or ``src`` is incomplete, damaged or of another kind.
        ConfigError: the networks do not fit each other or the clip.
    """
    output.refuse_existing(dst)
    backbone, codec = (
        cogvideox.stored_specs(network, src, dtype) for network in (cosmos.TRANSFORMER, cosmos.VAE)
    )
    stored = backbone["proj_out/kernel"].dtype.name
    config = config_of(src, dst, dtype or stored, clip, prompt=False)
    length, width = config.model.backbone.text_shape
    encoded = text.encode(src, prompts, length, width, masked=True)
    parts: dict[str, whole_world.Part] = {
        "backbone": (backbone, lambda: cosmos.read_transformer(src, dtype)[1]),
        "codec": (codec, lambda: cosmos.read_vae(src, dtype)[1]),
        "control": whole_world.actions(config, dtype),
    }
    if encoded:
        config = config_of(src, dst, dtype or stored, clip, prompt=True)
        tokens: Params = dict(
            zip(("prompt_LC", "negative_LC"), (encoded[prompt] for prompt in prompts), strict=True)
        )
        parts["text"] = (whole_world.like(tokens, dtype), lambda: tokens)
    whole_world.write(dst, config, parts)
    return bool(encoded)
