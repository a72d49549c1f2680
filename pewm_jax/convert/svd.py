"""Stable Video Diffusion in the layout of diffusers: read its networks and write them back.

A pipeline's folder has ``unet/``, ``vae/``, ``image_encoder/`` and ``scheduler/``. Every tensor of
a folder must be used.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax

from pewm_jax.config import CLIPVisionConfig, SVDUNetConfig, SVDVAEConfig
from pewm_jax.convert import (
    assemble,
    clip_vision,
    cogvideox,
    output,
    sources,
    svd_scheduler,
    svd_unet,
    svd_vae,
)
from pewm_jax.convert.cogvideox import Network
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.io import tensor_files
from pewm_jax.models.clip import model as clip_model
from pewm_jax.models.svd import unet as unet_model
from pewm_jax.models.svd import vae as vae_model
from pewm_jax.types import Params

UNET = Network("unet", svd_unet.CLASS, SVDUNetConfig, svd_unet, unet_model.init)
VAE = Network("vae", svd_vae.CLASS, SVDVAEConfig, svd_vae, vae_model.init)


def read_unet(folder: str | Path, dtype: str | None = None) -> tuple[SVDUNetConfig, Params]:
    """Read the U-Net of a checkpoint.

    Args:
        folder: a diffusers pipeline's folder, or the U-Net's folder in it.
        dtype: of the parameters, ``float32``, ``bfloat16`` or ``float16``; by default the stored
            one.

    Returns:
        ``(config, params)`` for ``pewm_jax.models.svd.unet.apply``, NumPy arrays.

    Raises:
        UserError: a tensor that is missing, left over or of another shape, a damaged file, a
            class or setting that is not known.
    """
    return cogvideox.read_network(UNET, Path(folder), dtype)


def write_unet(
    config: SVDUNetConfig, params: Params, folder: str | Path, dtype: str | None = None
) -> None:
    """Write the U-Net as diffusers' ``from_pretrained`` reads it; the inverse of ``read_unet``.

    Args:
        config: the network.
        params: its parameters.
        folder: to make.
        dtype: of the tensors; by default that of the parameters.

    Raises:
        UserError: the folder exists.
    """
    _write(UNET, config, params, Path(folder), dtype)


def read_vae(folder: str | Path, dtype: str | None = None) -> tuple[SVDVAEConfig, Params]:
    """Read the autoencoder of a checkpoint; see ``read_unet``.

    Returns:
        ``(config, params)`` for ``pewm_jax.models.svd.vae.encode`` and ``decode``.
    """
    return cogvideox.read_network(VAE, Path(folder), dtype)


def write_vae(
    config: SVDVAEConfig, params: Params, folder: str | Path, dtype: str | None = None
) -> None:
    """Write the autoencoder as diffusers' ``from_pretrained`` reads it; see ``write_unet``."""
    _write(VAE, config, params, Path(folder), dtype)


def read_image_encoder(
    folder: str | Path, dtype: str | None = None
) -> tuple[CLIPVisionConfig, Params]:
    """Read the image encoder of a checkpoint, in the layout of transformers; see ``read_unet``.

    Returns:
        ``(config, params)`` for ``pewm_jax.models.clip.model.apply``.
    """
    inside = sources.component(Path(folder), "image_encoder")
    path = inside / "config.json"
    config = clip_vision.config_from_transformers(sources.read_json(path), str(path))
    source = sources.open_folder(inside)
    total = sum(place.size for _, place in source.places.values())
    like = jax.eval_shape(lambda: clip_model.init(config, jax.random.key(0)))
    with output.megabytes("read image_encoder", total) as progress:
        kept = clip_vision.without_positions(source)
        return config, assemble.read(clip_vision.entries(config), kept, like, dtype, progress)


def write_image_encoder(
    config: CLIPVisionConfig, params: Params, folder: str | Path, dtype: str | None = None
) -> None:
    """Write the image encoder as transformers' ``from_pretrained`` reads it; see ``write_unet``."""
    entries = clip_vision.entries(config)
    specs = assemble.specs(entries, params, dtype)
    with output.new_folder(Path(folder)) as whole:
        output.write_json(whole / "config.json", clip_vision.config_to_transformers(config))
        path, tensors = whole / "model.safetensors", assemble.write(entries, params, dtype)
        with output.megabytes("write image_encoder", tensor_files.size(specs)) as progress:
            tensor_files.write(path, specs, tensors, {"format": "pt"}, progress)


def read_scheduler(folder: str | Path) -> EDMConfig:
    """Read the scheduler of a checkpoint: settings only, it has no weights.

    Args:
        folder: a diffusers pipeline's folder, or the scheduler's folder in it.

    Raises:
        UserError: a class or setting that is not known.
    """
    path = sources.component(Path(folder), "scheduler") / "scheduler_config.json"
    return svd_scheduler.config_from_diffusers(sources.read_config(path, [svd_scheduler.CLASS]))


def _write(network: Network, config: Any, params: Params, dst: Path, dtype: str | None) -> None:
    values = network.converter.config_to_diffusers(config)
    with output.new_folder(dst) as whole:
        cogvideox.write_diffusers(network, values, params, whole, dtype)
