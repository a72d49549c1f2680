"""DINOv2's tensors in a file or folder of any layout, under ``transformers``' names."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pewm_jax.config import UserError
from pewm_jax.convert import sources
from pewm_jax.convert.sources import Source
from pewm_jax.io import tree
from pewm_jax.types import Array

_LEFT_BEHIND = re.compile(r"(embeddings\.)?mask_token|classifier\.(weight|bias)")
_BODY = re.compile(r"^(dinov2|dinov2_with_registers)\.")
_HUB = (
    (r"cls_token|register_tokens|mask_token", r"embeddings.\g<0>"),
    (r"pos_embed", r"embeddings.position_embeddings"),
    (r"patch_embed\.proj\.(\w+)", r"embeddings.patch_embeddings.projection.\1"),
    (r"blocks\.(\d+)\.(norm[12]\.\w+|mlp\.fc[12]\.\w+)", r"encoder.layer.\1.\2"),
    (r"blocks\.(\d+)\.attn\.proj\.(\w+)", r"encoder.layer.\1.attention.output.dense.\2"),
    (r"blocks\.(\d+)\.ls([12])\.gamma", r"encoder.layer.\1.layer_scale\2.lambda1"),
    (r"blocks\.(\d+)\.mlp\.w12\.(\w+)", r"encoder.layer.\1.mlp.weights_in.\2"),
    (r"blocks\.(\d+)\.mlp\.w3\.(\w+)", r"encoder.layer.\1.mlp.weights_out.\2"),
    (r"norm\.(\w+)", r"layernorm.\1"),
)
"""The original repository's names, as patterns, and those of ``transformers``; the fused q, k and v
are split apart from these."""
_HUB_QKV = re.compile(r"blocks\.(\d+)\.attn\.qkv\.(\w+)")
_PICKLED = (".pth", ".pt", ".bin")


@dataclasses.dataclass(frozen=True)
class Renamed:
    """Another source's tensors, or equal parts of their first axis, under other names.

    Attributes:
        inner: where the tensors are.
        views: name → (name there, which part, of how many).
    """

    inner: Source
    views: Mapping[str, tuple[str, int, int]]

    @property
    def where(self) -> str:
        """The file or folder, for messages."""
        return self.inner.where

    def names(self) -> Iterable[str]:
        """Return the names of all tensors."""
        return self.views.keys()

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of a tensor without reading it."""
        inner, _, of = self.views[name]
        whole = self.inner.shape(inner)
        return whole if of == 1 else (whole[0] // of, *whole[1:])

    def dtype(self, name: str) -> np.dtype:
        """Return the dtype of a tensor without reading it."""
        return self.inner.dtype(self.views[name][0])

    def read(self, name: str) -> Array:
        """Read a tensor."""
        inner, part, of = self.views[name]
        whole = self.inner.read(inner)
        rows = len(whole) // of if of > 1 else 0
        return whole if of == 1 else whole[part * rows : (part + 1) * rows]


def with_transformers_names(source: Source) -> Source:
    """Return DINOv2's tensors under ``transformers``' names, without those left behind."""
    views: dict[str, tuple[str, int, int]] = {}
    for theirs in source.names():
        name = _BODY.sub("", theirs)
        if _LEFT_BEHIND.fullmatch(name):
            continue
        if qkv := _HUB_QKV.fullmatch(name):
            stem = f"encoder.layer.{qkv[1]}.attention.attention"
            for part, what in enumerate(("query", "key", "value")):
                views[f"{stem}.{what}.{qkv[2]}"] = (theirs, part, 3)
            continue
        for pattern, renamed in _HUB:
            if hub := re.fullmatch(pattern, name):
                name = hub.expand(renamed)
                break
        views[name] = (theirs, 0, 1)
    return Renamed(source, views)


def open_source(src: Path) -> Source:
    """Open a file or a folder, whatever it holds."""
    if src.is_dir():
        if any(src.glob("*.safetensors")):
            return sources.open_folder(src)
        pickled = [path for path in sorted(src.iterdir()) if path.suffix in _PICKLED]
        if len(pickled) != 1:
            what = f"several: {tree.listing(p.name for p in pickled)}" if pickled else "none"
            raise UserError(
                f"{src} should hold one file of weights, .safetensors or .pth, but there are "
                f"{what}; name the file itself."
            )
        src = pickled[0]
    if not src.is_file():
        raise UserError(f"{src} does not exist; give a transformers folder or a DINOv2 state dict.")
    return _unpickled(src) if src.suffix in _PICKLED else sources.open_file(src)


def _unpickled(path: Path) -> Source:
    """Read a state dict that torch saved; nothing in it is executed."""
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
    return sources.Arrays({name: _to_numpy(torch, x) for name, x in found.items()}, str(path))


def _to_numpy(torch: Any, tensor: Any) -> np.ndarray:
    """Return a torch tensor's values, bfloat16 included."""
    if tensor.dtype == torch.bfloat16:
        return tensor.contiguous().view(torch.uint16).numpy().view(jax.numpy.bfloat16)
    return tensor.numpy()
