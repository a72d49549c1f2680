"""Read DINOv2 from a transformers folder or an original state dict, and write it in our layout."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import jax

from pewm_jax import config as configuration
from pewm_jax.convert import pipeline
from pewm_jax.errors import UserError
from pewm_jax.io import sources, tree, weights
from pewm_jax.io.sources import Source
from pewm_jax.models.dinov2 import model as dinov2
from pewm_jax.models.dinov2.config import DINOv2Config
from pewm_jax.models.dinov2.convert import (
    config_from_shapes,
    config_from_transformers,
    entries,
    with_transformers_names,
)
from pewm_jax.types import Params

_PICKLED = (".pth", ".pt", ".bin")


def read(src: Path | str, dtype: str | None = None) -> tuple[DINOv2Config, Params]:
    """Read DINOv2 from a ``transformers`` folder or an original state dict.

    Args:
        src: a folder with config.json and safetensors (single or sharded); or a state dict of the
            original repository, .safetensors or .pth, or the folder that contains only this file.
            A .pth is read as data, without torch.
        dtype: dtype of the parameters; by default the stored one.

    Returns:
        The configuration, and NumPy parameters for ``pewm_jax.models.dinov2.model``.

    Raises:
        UserError: not DINOv2, a tensor is missing, unexpected or has a wrong shape, or a file is
            damaged.
    """
    src = Path(src)
    settings = src / "config.json"
    source = with_transformers_names(open_source(src))
    if settings.is_file():
        config = config_from_transformers(sources.read_json(settings), str(settings))
    else:
        config = config_from_shapes(source)
    return config, pipeline.read_tensors(entries(config), source, _like(config), dtype)


def write(config: DINOv2Config, params: Params, dst: Path | str) -> None:
    """Write a folder {config.json, weights.safetensors} for ``dinov2.load``.

    Raises:
        UserError: ``dst`` exists.
    """
    dst = Path(dst)
    weights.check(params, _like(config), "the tree to be written")
    with pipeline.new_folder(dst) as folder:
        weights.save(folder / "weights.safetensors", params, {"network": "dinov2"})
        configuration.save(config, folder / "config.json")


def convert(
    src: Path | str,
    dst: Path | str,
    dtype: str | None = None,
    log: Callable[[str], None] = print,
) -> None:
    """Import DINOv2: ``read`` and ``write``; ``log`` is called with a line that describes it.

    Raises:
        UserError: ``src`` cannot be read, or ``dst`` exists.
    """
    pipeline.refuse_existing(Path(dst))
    config, params = read(src, dtype)
    write(config, params, dst)
    leaves = jax.tree.leaves(params)
    count = sum(leaf.size for leaf in leaves)
    registers = f", {config.registers} registers" * bool(config.registers)
    log(
        f"{dst}: DINOv2, {config.layers} layers of width {config.width}, patches of "
        f"{config.patch} pixels{registers}, {count / 1e6:.1f} M parameters in {leaves[0].dtype}"
    )


def _like(config: DINOv2Config) -> Params:
    return jax.eval_shape(lambda: dinov2.init(config, jax.random.key(0)))


def open_source(src: Path) -> Source:
    """Open a file or a folder of any supported kind."""
    if src.is_dir():
        if any(src.glob("*.safetensors")):
            return sources.open_folder(src)
        pickled = [path for path in sorted(src.iterdir()) if path.suffix in _PICKLED]
        if len(pickled) != 1:
            what = f"several: {tree.listing(p.name for p in pickled)}" if pickled else "none"
            raise UserError(
                f"{src} should contain one file of weights, .safetensors or .pth, but there are "
                f"{what}; give the path of the file itself."
            )
        src = pickled[0]
    if not src.is_file():
        raise UserError(f"{src} does not exist; give a transformers folder or a DINOv2 state dict.")
    if src.suffix in _PICKLED:
        return sources.in_memory(weights.read_others(src, "DINOv2"), str(src))
    return sources.open_file(src)
