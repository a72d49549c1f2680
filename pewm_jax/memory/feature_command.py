"""``pewm-jax memory cache``: the image encoder's features of a data set, computed once."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from pewm_jax.config import Encoder, UserError
from pewm_jax.data import dataset
from pewm_jax.encoders.patch_colours import PatchColoursConfig
from pewm_jax.memory import feature_build
from pewm_jax.memory.feature_cache import Dtype
from pewm_jax.models.dinov2 import model as dinov2
from pewm_jax.models.dinov2.encoder import DINOv2EncoderConfig
from pewm_jax.types import Params


@dataclasses.dataclass(frozen=True)
class CacheConfig:
    """Compute the image encoder's features of every frame of a data set once, and store them.

    After an interruption, run the same command again. A cache made with other encoder weights,
    other preprocessing or other data is refused when it is read.
    """

    data: Annotated[Path, tyro.conf.Positional]
    """A dataset folder, all finished splits of which are encoded, or the folder of one split."""
    out: Annotated[Path, tyro.conf.Positional]
    """The folder to fill; for a dataset, it gets a folder per split."""
    encoder: str = ""
    """Folder of DINOv2 made by `python -m pewm_jax.convert import dinov2`; if empty, patch colours,
    which have no weights, are the encoder."""
    size: int = 518
    """Side in pixels of the square that images are resized to for DINOv2; `memory.encoder.size` of
    the experiment."""
    patch: int = 2
    """Pixels per patch of the patch colours; `memory.encoder.patch` of the experiment."""
    dtype: Dtype = "float16"
    """Dtype of the stored features."""
    batch: int = 16
    """Frames encoded at once."""


def cache(config: CacheConfig) -> None:
    """Fill the cache of a split, or of every split of a dataset.

    Raises:
        UserError: the data, the encoder or the folder to fill cannot be used.
    """
    if config.batch < 1:
        raise UserError(f"--batch is {config.batch}: encode at least 1 frame at once.")
    settings, params = _encoder(config)
    splits = {config.data: config.out}
    if not (config.data / dataset.MANIFEST).is_file():
        splits = {config.data / s: config.out / s for s in dataset.splits(config.data)} or splits
    for data, out in splits.items():
        feature_build.build(settings, params, data, out, dtype=config.dtype, batch=config.batch)


def _encoder(config: CacheConfig) -> tuple[Encoder, Params]:
    """Return the encoder's settings, as an experiment has them, and its parameters."""
    if not config.encoder:
        return PatchColoursConfig(patch=config.patch), {}
    network, params = dinov2.load(Path(config.encoder))
    return DINOv2EncoderConfig(size=config.size, network=network), params
