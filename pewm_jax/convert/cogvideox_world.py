"""A CogVideoX checkpoint as a world model that ``pewm_jax.load`` reads, before any training.

The folder is written part by part, so at most one network is in memory at a time.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pewm_jax.config import ClipConfig, Config, Encoder, UserError
from pewm_jax.convert import cogvideox, pipeline, widen
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.io import tree
from pewm_jax.models.cogvideox import positions
from pewm_jax.models.cogvideox.backbone import DiTBackbone
from pewm_jax.models.cogvideox.convert import TRANSFORMER, VAE
from pewm_jax.models.cogvideox.vae_codec import VAECodec
from pewm_jax.types import Params
from pewm_jax.worlds.pewm import paper


def config_of(
    dit: DiTBackbone,
    vae: VAECodec,
    noise: DDPMConfig,
    size: tuple[int | None, int | None, int | None],
    dtype: str | None,
    *,
    run: str = "world",
    encoder: Encoder | None = None,
) -> Config:
    """Return the settings of the world model around a video model.

    Training and memory are those of the presets ``pewm_2b`` and ``pewm_5b``; clip, codec, backbone
    and noise are the checkpoint's. Memory blocks are not wider than the transformer.

    Args:
        dit: the video model's transformer.
        vae: its VAE.
        noise: its scheduler.
        size: frames, height and width of a clip; None for the paper's 9 × 512 × 512, or for the
            size of the learned positions if they allow no other.
        dtype: dtype of the weights; 16-bit weights are computed in bfloat16.
        run: name of the experiment, for the folder of its runs.
        encoder: the image features stored in the map, by default the colours of patches.

    Raises:
        ConfigError: the network does not support the size.
    """
    usual = dataclasses.astuple(paper.CLIP)[:3]
    if dit.positions == "rope_learned" and dit.learned in ("exact", "reference"):
        scale = vae.spatial
        usual = (dit.sample_frames, dit.sample_height * scale, dit.sample_width * scale)
    frames, height, width = (
        value if given is None else given for given, value in zip(size, usual, strict=True)
    )
    return paper.experiment(
        dit,
        vae,
        noise,
        run=run,
        clip=ClipConfig(frames=frames, height=height, width=width),
        encoder=encoder,
        dtype="float32" if dtype in (None, "float32") else "bfloat16",
    )


def require_size(config: Config) -> None:
    """Check that the transformer's positions cover a clip.

    Raises:
        UserError: they are learned for another size, or are too few.
    """
    frames, height, width = config.model.latent_shape
    frames += -frames % config.model.backbone.patch_t
    clip = config.model.clip
    try:
        positions.token_grid(config.model.backbone, (1, frames, height, width, 1))
    except UserError as error:
        raise UserError(f"A clip of {clip.frames}×{clip.height}×{clip.width}: {error}") from None


def _same(params: Params) -> Params:
    return params


def import_world(
    src: Path,
    dst: Path,
    config: Config,
    prompt_LC: np.ndarray | None,
    record: dict[str, Any],
    *,
    memory: bool,
    encoder: Params | None = None,
    dtype: str | None = None,
    seed: int = 0,
) -> None:
    """Write the folder: ``config.json``, ``weights.safetensors``, ``base.json``.

    Args:
        src: a diffusers pipeline's folder.
        dst: the folder to create.
        config: the world model, from ``config_of``.
        prompt_LC: (L, text_dim) tokens of the prompt, None without a text encoder.
        record: the content of ``base.json``.
        memory: whether to add memory blocks.
        encoder: parameters of the map's image encoder, if it has any.
        dtype: dtype of the weights; by default the stored one, and float32 for memory blocks.
        seed: seed of the memory blocks.
    """
    old = TRANSFORMER.config(record["transformer"], cogvideox.BASE)
    channels = config.model.control.channels(config.model)
    plan = widen.plan(old, config.model.codec.latent_channels, channels)

    def backbone() -> Params:
        return widen.widen(plan, cogvideox.read_transformer(src, dtype)[1])

    def blocks() -> Params:
        return jax.jit(lambda k: config.model.memory.reader.init(config.model, k))(
            jax.random.key(seed)
        )

    wide = tree.flatten(TRANSFORMER.like(plan.new))
    stored = pipeline.specs(TRANSFORMER, src, dtype)
    specs = {p: jax.ShapeDtypeStruct(wide[p].shape, spec.dtype) for p, spec in stored.items()}
    parts: dict[str, pipeline.Part] = {"backbone": (specs, backbone)}
    if memory:
        parts["memory"] = (pipeline.cast_specs(jax.eval_shape(blocks), dtype), blocks)
    parts["codec"] = pipeline.part(VAE, src, dtype)
    given: dict[str, Params] = {}
    if encoder is not None:
        given["encoder"] = encoder
    if prompt_LC is not None:
        given["text"] = {"prompt_LC": prompt_LC}
    for name, params in given.items():
        parts[name] = (pipeline.cast_specs(params, dtype), functools.partial(_same, params))
    pipeline.write_world(dst, config, parts, {cogvideox.BASE: record})
