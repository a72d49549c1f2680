"""Cosmos-Predict2 in the layout of diffusers: read its networks and write them back.

A pipeline's folder has ``transformer/``, ``vae/`` and ``scheduler/``. Every tensor of a folder must
be used. The text encoder (T5) is not read.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pewm_jax.config import CosmosConfig, WanVAEConfig
from pewm_jax.convert import (
    cogvideox,
    cosmos_scheduler,
    cosmos_transformer,
    output,
    sources,
    wan_vae,
)
from pewm_jax.convert.cogvideox import Network
from pewm_jax.diffusion.edm import EDMConfig
from pewm_jax.models.cosmos import model as transformer_model
from pewm_jax.models.wan import vae as vae_model
from pewm_jax.types import Params

TRANSFORMER = Network(
    "transformer",
    cosmos_transformer.CLASS,
    CosmosConfig,
    cosmos_transformer,
    transformer_model.init,
)
VAE = Network("vae", wan_vae.CLASS, WanVAEConfig, wan_vae, vae_model.init)


def read_transformer(folder: str | Path, dtype: str | None = None) -> tuple[CosmosConfig, Params]:
    """Read the diffusion transformer of a checkpoint.

    Args:
        folder: a diffusers pipeline's folder, or the transformer's folder in it.
        dtype: of the parameters, ``float32``, ``bfloat16`` or ``float16``; by default the stored
            one.

    Returns:
        ``(config, params)`` for ``pewm_jax.models.cosmos.model.apply``, NumPy arrays.

    Raises:
        UserError: a tensor that is missing, left over or of another shape, a damaged file, a
            class or setting that is not known.
    """
    return cogvideox.read_network(TRANSFORMER, Path(folder), dtype)


def write_transformer(
    config: CosmosConfig, params: Params, folder: str | Path, dtype: str | None = None
) -> None:
    """Write the transformer as diffusers' ``from_pretrained`` reads it.

    The inverse of ``read_transformer``. How attention is computed and what is recomputed are not
    part of it.

    Args:
        config: the network.
        params: its parameters.
        folder: to make.
        dtype: of the tensors; by default that of the parameters.

    Raises:
        UserError: the folder exists.
    """
    _write(TRANSFORMER, config, params, Path(folder), dtype)


def read_vae(folder: str | Path, dtype: str | None = None) -> tuple[WanVAEConfig, Params]:
    """Read the autoencoder of a checkpoint; see ``read_transformer``.

    Returns:
        ``(config, params)`` for ``pewm_jax.models.wan.vae.encode`` and ``decode``.
    """
    return cogvideox.read_network(VAE, Path(folder), dtype)


def write_vae(
    config: WanVAEConfig, params: Params, folder: str | Path, dtype: str | None = None
) -> None:
    """Write the autoencoder as diffusers' ``from_pretrained`` reads it; the inverse of reading."""
    _write(VAE, config, params, Path(folder), dtype)


def read_scheduler(folder: str | Path) -> EDMConfig:
    """Read the scheduler of a checkpoint: settings only, it has no weights.

    Args:
        folder: a diffusers pipeline's folder, or the scheduler's folder in it.

    Raises:
        UserError: a class or setting that is not known.
    """
    path = sources.component(Path(folder), "scheduler") / "scheduler_config.json"
    return cosmos_scheduler.config_from_diffusers(
        sources.read_config(path, [cosmos_scheduler.CLASS])
    )


def _write(network: Network, config: Any, params: Params, dst: Path, dtype: str | None) -> None:
    values = network.converter.config_to_diffusers(config)
    with output.new_folder(dst) as whole:
        cogvideox.write_diffusers(network, values, params, whole, dtype)
