"""Sources of published tensors: one safetensors file, shards with an index, or memory.

Headers are read immediately and checked against the file sizes; tensors are read one by one on
demand, so at most one of them is in memory.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax.errors import UserError
from pewm_jax.io import tensor_files, tree
from pewm_jax.types import Array


@dataclasses.dataclass(frozen=True)
class Tensor:
    """A tensor of known shape and dtype; ``read`` reads its values."""

    shape: tuple[int, ...]
    dtype: np.dtype
    read: Callable[[], Array]


@dataclasses.dataclass(frozen=True)
class Source:
    """Named tensors that are read one by one.

    Attributes:
        where: the file or folder, for error messages.
        tensors: the tensors by name.
    """

    where: str
    tensors: Mapping[str, Tensor]

    def names(self) -> Iterable[str]:
        """Return the names of all tensors."""
        return self.tensors.keys()

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of a tensor without reading it."""
        return self.tensors[name].shape

    def dtype(self, name: str) -> np.dtype:
        """Return the dtype of a tensor without reading it."""
        return self.tensors[name].dtype

    def read(self, name: str) -> Array:
        """Read a tensor; raises UserError if its file is damaged."""
        return self.tensors[name].read()


def in_memory(tensors: Mapping[str, Array], where: str) -> Source:
    """Return tensors in memory as a ``Source``."""
    return Source(
        where,
        {n: Tensor(tuple(x.shape), np.dtype(x.dtype), lambda x=x: x) for n, x in tensors.items()},
    )


def renamed(inner: Source, views: Mapping[str, tuple[str, int, int]]) -> Source:
    """Return a view of a source with renamed tensors, or with equal parts of their first axis.

    Args:
        inner: the source.
        views: new name → (name in ``inner``, index of the part, number of parts).
    """

    def view(name: str, part: int, of: int) -> Tensor:
        whole = inner.tensors[name]
        if of == 1:
            return whole
        rows = whole.shape[0] // of
        return dataclasses.replace(
            whole,
            shape=(rows, *whole.shape[1:]),
            read=lambda: whole.read()[part * rows : (part + 1) * rows],
        )

    return Source(inner.where, {new: view(*old) for new, old in views.items()})


def open_file(path: Path) -> Source:
    """Open one safetensors file; raises UserError if it is missing, truncated or damaged."""
    found = {}
    for name, place in tensor_files.places(path).items():
        read = functools.partial(tensor_files.read_at, path, place)
        found[name] = Tensor(place.shape, place.dtype, read)
    return Source(str(path), found)


def open_folder(folder: Path) -> Source:
    """Open the weights of one network in the layout of diffusers and transformers; read headers.

    Args:
        folder: contains ``*.safetensors.index.json`` and the shards it names, or one
            ``*.safetensors``. If there are several precisions (``model.fp16.safetensors``), the
            file without a precision in its name is used.

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
    if chosen in whole:
        used, source = {chosen}, open_file(chosen)
    else:
        shards = _read_index(folder, chosen)
        opened = [_open_shard(path, wanted).tensors.items() for path, wanted in shards.items()]
        used, source = set(shards), Source(str(folder), dict(itertools.chain(*opened)))
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


def _read_index(folder: Path, index: Path) -> dict[Path, set[str]]:
    """Return the names of the tensors that each shard must contain."""
    table = read_json(index).get("weight_map")
    if not isinstance(table, dict) or not all(isinstance(v, str) for v in table.values()):
        raise UserError(f"{index} has no table weight_map of tensors and files; copy it again.")
    shards: dict[Path, set[str]] = {folder / name: set() for name in sorted(set(table.values()))}
    absent = [path.name for path in shards if not path.is_file()]
    if absent:
        raise UserError(
            f"{index} names files that do not exist: {tree.listing(absent)}; copy them to {folder}."
        )
    for name, file in table.items():
        shards[folder / file].add(name)
    return shards


def _open_shard(path: Path, wanted: set[str]) -> Source:
    inside = open_file(path)
    if inside.tensors.keys() != wanted:
        lacking, extra = wanted - inside.tensors.keys(), inside.tensors.keys() - wanted
        what = f"lacks {tree.listing(lacking)}" if lacking else f"holds {tree.listing(extra)}"
        word = "listed in the index" if lacking else "not listed in the index"
        raise UserError(f"{path} {what}, {word}; copy the whole folder again.")
    return inside


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON table; raises UserError if the file is missing, unreadable or no JSON table."""
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
    """Read the settings in ``config.json``, ``scheduler_config.json`` or ``model_index.json``.

    The setting ``key`` names the class.

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
