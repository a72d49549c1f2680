"""Stable Video Diffusion: read its networks, write them back, and import it as a world model.

A pipeline's folder has ``unet/``, ``vae/``, ``image_encoder/`` and ``scheduler/``. Every tensor of
a folder must be used. The world model has the settings of the preset ``egowm_svd`` around the
checkpoint's networks, and newly initialized layers for the actions, which have no effect until they
are trained.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Literal

from pewm_jax.config import Config
from pewm_jax.convert import pipeline, schedulers
from pewm_jax.models.clip.convert import IMAGE_ENCODER
from pewm_jax.models.svd.convert import UNET, VAE
from pewm_jax.worlds.egowm import paper as egowm_paper

read_unet = functools.partial(pipeline.read, UNET)
"""Read the U-Net for ``pewm_jax.models.svd.unet.apply``; see ``pipeline.read``."""
write_unet = functools.partial(pipeline.write, UNET)
"""Write the U-Net for diffusers' ``from_pretrained``; see ``pipeline.write``."""
read_vae = functools.partial(pipeline.read, VAE)
"""Read the autoencoder for ``pewm_jax.models.svd.vae``; see ``pipeline.read``."""
write_vae = functools.partial(pipeline.write, VAE)
"""Write the autoencoder for diffusers' ``from_pretrained``; see ``pipeline.write``."""
read_image_encoder = functools.partial(pipeline.read, IMAGE_ENCODER)
"""Read the image encoder for ``pewm_jax.models.clip.model.apply``; see ``pipeline.read``."""
write_image_encoder = functools.partial(pipeline.write, IMAGE_ENCODER)
"""Write the image encoder for transformers' ``from_pretrained``; see ``pipeline.write``."""
read_scheduler = functools.partial(schedulers.read, schedulers.SVD)
"""Read the scheduler of a checkpoint, an ``EDMConfig``; see ``schedulers.read``."""


def config_of(src: Path, dst: Path, dtype: str | None, size: tuple[int, int]) -> Config:
    """Return the settings of the world model around a pipeline's networks.

    16-bit weights are computed in bfloat16. ``size`` is the height and width of a frame.

    Raises:
        UserError: a network of another class, or unknown settings.
        ConfigError: the networks do not fit each other or the size.
    """
    unet, vae, encoder = (
        pipeline.read_config(network, src) for network in (UNET, VAE, IMAGE_ENCODER)
    )
    precision: Literal["float32", "bfloat16"] = "float32" if dtype == "float32" else "bfloat16"
    return egowm_paper.experiment(
        dataclasses.replace(unet, image=encoder),
        vae,
        read_scheduler(src),
        run=dst.name,
        size=size,
        dtype=precision,
    )


def import_world(
    src: Path, dst: Path, dtype: str | None = None, size: tuple[int, int] = (512, 512)
) -> None:
    """Write a world model's folder: ``config.json`` and ``weights.safetensors``.

    Args:
        src: a pipeline's folder in diffusers' layout: unet/, vae/, image_encoder/, scheduler/.
        dtype: dtype of the weights; by default the stored one, and float32 for the actions' layers.
        size: height and width of a frame.

    Raises:
        UserError: ``dst`` exists, or ``src`` is incomplete, damaged or of another type.
        ConfigError: the networks do not fit each other or the size.
    """
    pipeline.refuse_existing(dst)
    stored = dtype or pipeline.specs(UNET, src)["conv_out/kernel"].dtype.name
    config = config_of(src, dst, stored, size)
    parts: dict[str, pipeline.Part] = {
        name: pipeline.part(network, src, dtype)
        for name, network in (("backbone", UNET), ("codec", VAE), ("image", IMAGE_ENCODER))
    }
    parts["control"] = pipeline.fresh_actions(config, dtype)
    pipeline.write_world(dst, config, parts)
