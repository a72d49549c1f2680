"""Read DINOv2 from a transformers folder or an original state dict, and write it in our layout."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pewm_jax import config as configuration
from pewm_jax.convert import output, pipeline
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
            A .pth is read by ``torch.load(weights_only=True)``, which runs no code.
        dtype: dtype of the parameters; by default the stored one.

    Returns:
        The configuration, and NumPy parameters for ``pewm_jax.models.dinov2.model``.

    Raises:
        UserError: not DINOv2, a tensor is missing, unexpected or has a wrong shape, a file is
            damaged, or torch is needed and not installed.
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
    with output.new_folder(dst) as folder:
        weights.save(folder / "weights.safetensors", params, {"network": "dinov2"})
        configuration.save(config, folder / "config.json")


def convert(
    src: Path | str,
    dst: Path | str,
    dtype: str | None = None,
    log: Callable[[str], None] = print,
) -> None:
    """Import DINOv2: ``read`` and ``write``.

    Args:
        src: see ``read``.
        dst: the folder to create.
        dtype: dtype of the stored parameters; by default the source's.
        log: called with a line that describes the import.

    Raises:
        UserError: ``src`` cannot be read, or ``dst`` exists.
    """
    output.refuse_existing(Path(dst))
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
    return _read_state_dict(src) if src.suffix in _PICKLED else sources.open_file(src)


def _read_state_dict(path: Path) -> Source:
    """Read a state dict saved by torch, without executing code in it."""
    try:
        import torch  # noqa: PLC0415 - an extra: only these files need it
    except ImportError:
        raise UserError(
            f"{path} is a torch file, and torch is not installed: pip install 'pewm-jax[convert]'."
        ) from None
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(
            f"{path} cannot be read as a state dict ({first}); download it again."
        ) from error
    if not isinstance(found, dict) or not all(
        isinstance(name, str) and isinstance(value, torch.Tensor) for name, value in found.items()
    ):
        raise UserError(f"{path} is not a plain table of names and tensors, a state dict.")
    return sources.in_memory({name: _to_numpy(torch, x) for name, x in found.items()}, str(path))


def _to_numpy(torch: Any, tensor: Any) -> np.ndarray:
    """Return a torch tensor's values, bfloat16 included."""
    if tensor.dtype == torch.bfloat16:
        return tensor.contiguous().view(torch.uint16).numpy().view(jax.numpy.bfloat16)
    return tensor.numpy()
