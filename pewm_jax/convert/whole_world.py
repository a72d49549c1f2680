"""A world model's folder, written part by part: one network is in memory at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import jax
import numpy as np

from pewm_jax import config as configuration
from pewm_jax.config import Config
from pewm_jax.controls import interface as controls
from pewm_jax.convert import output
from pewm_jax.convert.cogvideox import CONFIG, WEIGHTS
from pewm_jax.io import tensor_files, tree
from pewm_jax.types import Array, Params

Specs = dict[str, jax.ShapeDtypeStruct]
"""Shape and dtype of every leaf, by path."""
Part = tuple[Specs, Callable[[], Params]]
"""What a part's parameters are like, and the function that reads or makes them."""


def write(dst: Path, config: Config, parts: Mapping[str, Part]) -> None:
    """Write ``config.json`` and ``weights.safetensors``, whole or not at all.

    Args:
        dst: the folder to make.
        config: the settings.
        parts: by the names that parameters have in a world model.

    Raises:
        UserError: ``dst`` exists.
    """
    specs = {f"{part}/{p}": spec for part, (like, _) in parts.items() for p, spec in like.items()}

    def tensors() -> Iterator[tuple[str, Array]]:
        for part, (_, make) in parts.items():
            for path, leaf in tree.flatten({part: make()}).items():
                yield path, np.asarray(leaf).astype(specs[path].dtype, copy=False)

    with output.new_folder(dst) as folder:
        header = tensor_files.header({"stage": "0"})
        with output.megabytes(f"write {dst.name}", tensor_files.size(specs)) as progress:
            tensor_files.write(folder / WEIGHTS, specs, tensors(), header, progress)
        configuration.save(config, folder / CONFIG)


def actions(config: Config, dtype: str | None) -> Part:
    """Return fresh layers for the control's actions, which change nothing yet.

    Args:
        config: the settings.
        dtype: of the weights; by default float32.
    """

    def make() -> Params:
        return jax.jit(controls.init, static_argnums=0)(config.model, jax.random.key(0))

    return like(jax.eval_shape(make), dtype), make


def like(params: Params, dtype: str | None) -> Specs:
    """Return what parameters are like in another dtype, by default float32."""
    new = np.dtype(jax.numpy.dtype(dtype or "float32"))
    flat = tree.flatten(params)
    return {path: jax.ShapeDtypeStruct(leaf.shape, new) for path, leaf in flat.items()}
