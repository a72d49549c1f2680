"""Sources of published tensors: one safetensors file, shards with an index, or memory.

Headers are read immediately and checked against the file sizes; tensors are read one by one on
demand, so at most one of them is in memory.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.io import tensor_files, tree
from pewm_jax.types import Array


class Source(Protocol):
    """Named tensors that are read one by one."""

    @property
    def where(self) -> str:
        """Return the file or folder, for error messages."""
        ...

    def names(self) -> Iterable[str]:
        """Return the names of all tensors."""
        ...

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of a tensor without reading it."""
        ...

    def dtype(self, name: str) -> np.dtype:
        """Return the dtype of a tensor without reading it."""
        ...

    def read(self, name: str) -> Array:
        """Read a tensor."""
        ...


@dataclasses.dataclass(frozen=True)
class Arrays:
    """Tensors in memory, as a ``Source``."""

    tensors: Mapping[str, Array]
    where: str

    def names(self) -> Iterable[str]:
        """Return the names of all tensors."""
        return self.tensors.keys()

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of a tensor."""
        return tuple(self.tensors[name].shape)

    def dtype(self, name: str) -> np.dtype:
        """Return the dtype of a tensor."""
        return np.dtype(self.tensors[name].dtype)

    def read(self, name: str) -> Array:
        """Return a tensor."""
        return self.tensors[name]


@dataclasses.dataclass(frozen=True)
class Files:
    """Tensors in safetensors files, as a ``Source``."""

    where: str
    places: Mapping[str, tuple[Path, tensor_files.Place]]

    def names(self) -> Iterable[str]:
        """Return the names of all tensors."""
        return self.places.keys()

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of a tensor without reading it."""
        return self.places[name][1].shape

    def dtype(self, name: str) -> np.dtype:
        """Return the dtype of a tensor without reading it."""
        return self.places[name][1].dtype

    def read(self, name: str) -> Array:
        """Read a tensor.

        Raises:
            UserError: the file ends before the tensor does.
        """
        path, place = self.places[name]
        return tensor_files.read_at(path, place)


@dataclasses.dataclass(frozen=True)
class Renamed:
    """A view of another source with renamed tensors, or with equal parts of their first axis.

    Attributes:
        inner: the other source.
        views: name → (name in ``inner``, index of the part, number of parts).
    """

    inner: Source
    views: Mapping[str, tuple[str, int, int]]

    @property
    def where(self) -> str:
        """Return the file or folder, for error messages."""
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


def open_folder(folder: Path) -> Files:
    """Open the weights of one network in the layout of diffusers and transformers.

    Args:
        folder: contains ``*.safetensors.index.json`` and the shards it names, or one
            ``*.safetensors``. If there are several precisions (``model.fp16.safetensors``), the
            file without a precision in its name is used.

    Returns:
        The tensors, not read yet.

    Raises:
        UserError: no weights, an index that names missing files or tensors, shards without their
            index, tensors missing from the index, a truncated or damaged file.
    """
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder; give the folder that contains the weights.")
    indices = list(folder.glob("*.safetensors.index*.json"))
    files = list(folder.glob("*.safetensors"))
    whole = [path for path in files if "-of-" not in path.name]
    candidates = sorted([*indices, *whole], key=lambda path: (_precision(path), path in whole))
    if not candidates:
        raise _without_weights(folder, files)
    chosen = candidates[0]
    source = _open_shards(folder, chosen) if chosen in indices else open_file(chosen)
    used = {path for path, _ in source.places.values()}
    beside = [p.name for p in files if p not in used and _precision(p) == _precision(chosen)]
    if beside:
        raise UserError(
            f"{folder} contains {tree.listing(beside)} besides the weights of {chosen.name}; move "
            "the files of other networks away."
        )
    return source


def _without_weights(folder: Path, shards: Sequence[Path]) -> UserError:
    """Return the error for a folder without an index or a single file."""
    if shards:
        return UserError(
            f"{folder} contains shards such as {min(shards).name} but no *.safetensors.index.json "
            "that lists them; copy the index there too."
        )
    pickled = [p.name for p in sorted(folder.glob("*.bin")) + sorted(folder.glob("*.pt*"))]
    instead = f", only {tree.listing(pickled)}, which can run code when loaded" * bool(pickled)
    return UserError(
        f"{folder} contains no safetensors file{instead}; save the network there with "
        "save_pretrained(…, safe_serialization=True)."
    )


def open_file(path: Path) -> Files:
    """Open one safetensors file.

    Raises:
        UserError: the file is missing, truncated or damaged.
    """
    return Files(str(path), {n: (path, p) for n, p in tensor_files.places(path).items()})


def _open_shards(folder: Path, index: Path) -> Files:
    table = read_json(index).get("weight_map")
    if not isinstance(table, dict) or not all(isinstance(v, str) for v in table.values()):
        raise UserError(f"{index} has no table weight_map of tensors and files; copy it again.")
    shards = sorted(set(table.values()))
    absent = [name for name in shards if not (folder / name).is_file()]
    if absent:
        raise UserError(
            f"{index} names files that do not exist: {tree.listing(absent)}; copy them to {folder}."
        )
    places: dict[str, tuple[Path, tensor_files.Place]] = {}
    for shard in shards:
        inside = tensor_files.places(folder / shard)
        wanted = {name for name, file in table.items() if file == shard}
        if inside.keys() != wanted:
            lacking, extra = wanted - inside.keys(), inside.keys() - wanted
            what = f"lacks {tree.listing(lacking)}" if lacking else f"holds {tree.listing(extra)}"
            word = "listed in the index" if lacking else "not listed in the index"
            raise UserError(f"{folder / shard} {what}, {word}; copy the whole folder again.")
        places |= {name: (folder / shard, place) for name, place in inside.items()}
    return Files(str(folder), places)


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON table.

    Raises:
        UserError: the file is missing, unreadable, not JSON or not a table.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"{path} does not exist; copy the whole folder again.") from None
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}); allow reading it.") from None
    except ValueError as error:
        raise UserError(f"{path} is not valid JSON ({error}); copy it again.") from None
    if not isinstance(values, dict):
        raise UserError(f"{path} contains no table of settings; copy it again.")
    return values


def read_config(path: Path, classes: Sequence[str], key: str = "_class_name") -> dict[str, Any]:
    """Read the settings of a network and check its class.

    Args:
        path: ``config.json``, ``scheduler_config.json`` or ``model_index.json``.
        classes: the supported class names.
        key: the setting that names the class.

    Returns:
        The settings in the file, including the class name.

    Raises:
        UserError: the file cannot be read or names another class.
    """
    values = read_json(path)
    name = values.get(key)
    if name not in classes:
        raise UserError(
            f"{path} is of class {name!r} ({key}); only {' and '.join(classes)} can be read."
        )
    return values


def component(folder: Path, name: str) -> Path:
    """Return the folder of one network, given that folder or the pipeline's folder around it.

    Raises:
        UserError: it does not exist.
    """
    inside = folder / name
    if inside.is_dir():
        return inside
    if any(folder.glob("*config.json")):
        return folder
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder; give a diffusers pipeline's folder.")
    raise UserError(
        f"{folder} has no folder {name}/ and no config.json; give a diffusers pipeline's folder."
    )


def _precision(path: Path) -> str:
    """Return the part of a file's name that states its precision, or an empty string.

    It is ``fp16`` in ``model.fp16.safetensors``, ``model.fp16-00001-of-00002.safetensors`` and
    ``model.safetensors.index.fp16.json``.
    """
    parts = path.name.split("-00", 1)[0].split(".")[1:]
    return ".".join(part for part in parts if part not in {"safetensors", "index", "json"})
