"""A checkpoint of Stable Video Diffusion as a world model, before any training on actions.

The folder has the settings of the preset ``egowm_svd`` around the checkpoint's networks, and fresh
layers for the actions, which change nothing yet. It is written part by part, so that no more than
one network is in memory at a time.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

import jax

from pewm_jax.config import Config
from pewm_jax.convert import assemble, clip_vision, cogvideox, output, sources, svd, whole_world
from pewm_jax.models.clip import model as clip_model
from pewm_jax.worlds.egowm import paper as egowm_paper


def config_of(src: Path, dst: Path, dtype: str | None, size: tuple[int, int]) -> Config:
    """Return the settings of the world model around a pipeline's networks.

    Args:
        src: the pipeline's folder.
        dst: the folder to be made, whose name the runs have.
        dtype: of the weights; 16 bits are computed in bfloat16.
        size: height and width of a frame.

    Raises:
        UserError: a network of another class, or settings that are not known.
        ConfigError: the networks do not fit each other or the size.
    """
    unet, vae = (
        network.config(cogvideox.settings(network, src), network.folder)
        for network in (svd.UNET, svd.VAE)
    )
    image = sources.component(src, "image_encoder") / "config.json"
    encoder = clip_vision.config_from_transformers(sources.read_json(image), str(image))
    precision: Literal["float32", "bfloat16"] = "float32" if dtype == "float32" else "bfloat16"
    return egowm_paper.experiment(
        dataclasses.replace(unet, image=encoder),
        vae,
        svd.read_scheduler(src),
        run=dst.name,
        size=size,
        dtype=precision,
    )


def import_world(
    src: Path, dst: Path, dtype: str | None = None, size: tuple[int, int] = (512, 512)
) -> None:
    """Write the folder: ``config.json`` and ``weights.safetensors``.

    Args:
        src: a pipeline's folder as diffusers writes it: unet/, vae/, image_encoder/, scheduler/.
        dst: the folder to make.
        dtype: of the weights; by default the stored one, and float32 for the actions' layers.
        size: height and width of a frame.

    Raises:
        UserError: ``dst`` exists, or ``src`` is incomplete, damaged or of another kind.
        ConfigError: the networks do not fit each other or the size.
    """
    output.refuse_existing(dst)
    stored = dtype or _stored(src)
    config = config_of(src, dst, stored, size)
    parts: dict[str, whole_world.Part] = {
        "backbone": (
            cogvideox.stored_specs(svd.UNET, src, dtype),
            lambda: svd.read_unet(src, dtype)[1],
        ),
        "codec": (
            cogvideox.stored_specs(svd.VAE, src, dtype),
            lambda: svd.read_vae(src, dtype)[1],
        ),
        "image": (_image_specs(src, dtype), lambda: svd.read_image_encoder(src, dtype)[1]),
        "control": whole_world.actions(config, dtype),
    }
    whole_world.write(dst, config, parts)


def _stored(src: Path) -> str:
    """Return the dtype that the U-Net's weights have."""
    return cogvideox.stored_specs(svd.UNET, src, None)["conv_out/kernel"].dtype.name


def _image_specs(src: Path, dtype: str | None) -> whole_world.Specs:
    """Return what reading the image encoder will give."""
    inside = sources.component(src, "image_encoder")
    path = inside / "config.json"
    config = clip_vision.config_from_transformers(sources.read_json(path), str(path))
    like = jax.eval_shape(lambda: clip_model.init(config, jax.random.key(0)))
    entries = clip_vision.entries(config)
    source = clip_vision.without_positions(sources.open_folder(inside))
    assemble.require(entries, source, like)
    return assemble.leaf_specs(entries, source, like, dtype)
