"""Network weights as one safetensors file: flat ``a/b/c`` keys, nothing to execute on loading.

Files are written and read tensor by tensor, so that no more than one is held beside what the caller
holds. The header of ours has the SHA-256 of every tensor and of itself: no bit flips unnoticed.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import os
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import tree
from pewm_jax.config import UserError
from pewm_jax.types import Array, Params

_WORDS = "pewm_jax"
"""The header's key for what we say of a file, as one text: equal weights are equal files."""
_TENSORS, _HEADER = "sha256", "header_sha256"
"""The keys of checksums: of each tensor, and of the header with zeros in place of this one."""
_NONE = "0" * 64
_DTYPES = {
    "BOOL": np.dtype(bool),
    "U8": np.dtype(np.uint8),
    "I8": np.dtype(np.int8),
    "I16": np.dtype(np.int16),
    "U16": np.dtype(np.uint16),
    "I32": np.dtype(np.int32),
    "U32": np.dtype(np.uint32),
    "I64": np.dtype(np.int64),
    "U64": np.dtype(np.uint64),
    "F16": np.dtype(np.float16),
    "BF16": np.dtype(jnp.bfloat16),
    "F32": np.dtype(np.float32),
    "F64": np.dtype(np.float64),
}
_NAMES = {dtype: name for name, dtype in _DTYPES.items()}


@dataclasses.dataclass(frozen=True)
class Place:
    """One tensor of a safetensors file.

    Attributes:
        shape: its shape.
        dtype: its dtype.
        begin: its first byte in the file.
        sha256: of its bytes, empty if the file does not say.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    begin: int
    sha256: str = ""

    @property
    def size(self) -> int:
        """Return the bytes it takes."""
        return math.prod(self.shape) * self.dtype.itemsize


def save(
    path: Path,
    params: Params,
    words: Mapping[str, str] | None = None,
    told: Callable[[int], None] = lambda _: None,
) -> None:
    """Write parameters to ``path``, aside and then renamed.

    Args:
        path: the file to write, by custom ``weights.safetensors``; its folder is made.
        params: nested dictionaries of arrays, on any device.
        words: a few facts about them, kept in the file's header.
        told: called with the bytes written after every leaf.
    """
    leaves = tree.flatten(params)
    like = {name: jax.ShapeDtypeStruct(np.shape(x), _dtype(x)) for name, x in leaves.items()}
    write(path, like, leaves.items(), header(words or {}), told)


def header(words: Mapping[str, str]) -> dict[str, str]:
    """Return the header of ``write`` that ``metadata`` reads the words of."""
    return {_WORDS: json.dumps(dict(words), sort_keys=True)}


def write(
    path: Path,
    like: Mapping[str, Array | jax.ShapeDtypeStruct],
    tensors: Iterable[tuple[str, Array]],
    words: Mapping[str, str],
    told: Callable[[int], None] = lambda _: None,
) -> None:
    """Write a safetensors file tensor by tensor, aside and then renamed.

    Args:
        path: the file; its folder is made.
        like: name → anything with the tensor's shape and dtype.
        tensors: the tensors, in any order, each once.
        words: the file's header, words by name; checksums are added to those of ``header``.
        told: called with the bytes written after every tensor.

    Raises:
        ValueError: the tensors are not those announced.
    """
    order = sorted(like, key=lambda name: (-like[name].dtype.itemsize, name))
    said, ours = dict(words), _WORDS in words
    table: dict[str, object] = {"__metadata__": said}
    digests = dict.fromkeys(order, _NONE)
    if ours:
        said |= {_TENSORS: json.dumps(digests), _HEADER: _NONE}
    end = 0
    for name in order:
        dtype = np.dtype(like[name].dtype)
        begin, end = end, end + math.prod(like[name].shape) * dtype.itemsize
        table[name] = {
            "dtype": _NAMES[dtype],
            "shape": list(like[name].shape),
            "data_offsets": [begin, end],
        }
    text = _text(table)
    with aside(path) as file:
        file.write(struct.pack("<Q", len(text)) + text)
        start, left = file.tell(), set(order)
        for name, tensor in tensors:
            array = np.asarray(jax.device_get(tensor))
            if name not in left or (array.shape, array.dtype) != (
                tuple(like[name].shape),
                np.dtype(like[name].dtype),
            ):
                raise ValueError(f"{name} {array.shape} {array.dtype} was not announced so.")
            left.remove(name)
            offset: int = table[name]["data_offsets"][0]  # type: ignore[index]
            file.seek(start + offset)
            raw = np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
            file.write(raw)
            digests[name] = hashlib.sha256(raw).hexdigest() if ours else ""
            told(array.nbytes)
            del tensor, array, raw  # before the next one is made
        if left:
            raise ValueError(f"{tree.listing(left)} were announced and not given.")
        if ours:
            said[_TENSORS] = json.dumps(digests)
            said[_HEADER] = hashlib.sha256(_text(table)).hexdigest()
            file.seek(8)
            file.write(_text(table))


def _text(table: Mapping[str, object]) -> bytes:
    """Return a header as it stands in the file, padded to words of 8 bytes."""
    text = json.dumps(table, separators=(",", ":")).encode()
    return text + b" " * (-len(text) % 8)


def size(like: Mapping[str, Array | jax.ShapeDtypeStruct]) -> int:
    """Return the bytes that tensors take, of anything with shape and dtype by name."""
    return sum(math.prod(x.shape) * np.dtype(x.dtype).itemsize for x in like.values())


@contextlib.contextmanager
def aside(path: Path) -> Iterator[BinaryIO]:
    """Open a file beside ``path`` and rename it when all is written; nothing stays otherwise."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def load(path: Path, part: str = "") -> Params:
    """Read parameters written by ``save``.

    Args:
        path: a safetensors file.
        part: read only this branch of the tree, such as ``backbone``; by default all of it.

    Returns:
        Nested dictionaries of NumPy arrays.

    Raises:
        UserError: the file is absent or damaged, or holds no such branch.
    """
    prefix = f"{part}/" if part else ""
    found = {n.removeprefix(prefix): p for n, p in places(path).items() if n.startswith(prefix)}
    if part and not found:
        raise UserError(f"{path} holds no {part}; give weights that have it.")
    return tree.unflatten({name: read_at(path, place) for name, place in found.items()})


def lazy(path: Path) -> Params:
    """Map a file of weights into memory: of each tensor only what is looked at is read.

    Like ``load`` otherwise, but checksums are not compared; ``verify`` does that.
    """
    found = places(path)
    whole = np.memmap(path, np.uint8, "r")

    def view(place: Place) -> np.ndarray:
        return whole[place.begin : place.begin + place.size].view(place.dtype).reshape(place.shape)

    return tree.unflatten({name: view(place) for name, place in found.items()})


def places(path: Path) -> dict[str, Place]:
    """Return where each tensor of a safetensors file lies, having read its header only.

    Raises:
        UserError: the file is absent, truncated or damaged, or of a dtype that is not known.
    """
    table, start = _header(path)
    said = table.pop("__metadata__", None) or {}
    digests = json.loads(said[_TENSORS]) if _HEADER in said else {}
    found: dict[str, Place] = {}
    spans = []
    for name, entry in table.items():
        try:
            dtype, (begin, end) = _DTYPES[entry["dtype"]], entry["data_offsets"]
            whole = digests.get(name, "")
            found[name] = Place(tuple(entry["shape"]), dtype, start + begin, whole)
            length = end - begin
        except (KeyError, TypeError, ValueError):
            kind = entry.get("dtype") if isinstance(entry, dict) else None
            if isinstance(kind, str) and kind not in _DTYPES:
                raise UserError(
                    f"{path} holds {name} in {kind}, which cannot be read here; save it in "
                    "float32, bfloat16 or float16."
                ) from None
            raise _damaged(path, f"its entry of {name} cannot be read: {entry}") from None
        if length != found[name].size:
            raise _damaged(path, f"{name} takes {length} bytes, not {found[name].size}")
        spans.append((begin, end))
    end = 0
    for begin, until in sorted(spans):
        if begin != end:
            raise _damaged(path, "its tensors overlap or leave gaps")
        end = until
    size = path.stat().st_size
    if start + end != size:
        raise _damaged(path, f"it has {size} bytes and its header says {start + end}")
    return found


def read_at(path: Path, place: Place) -> np.ndarray:
    """Read one tensor into memory of its own.

    Raises:
        UserError: the file is absent, ends too early, or holds other bytes than were written.
    """
    array = np.empty(math.prod(place.shape), place.dtype)
    try:
        with path.open("rb") as file:
            file.seek(place.begin)
            raw = array.view(np.uint8).data
            if file.readinto(raw) != place.size:  # type: ignore[attr-defined]
                raise _damaged(path, "it ends too early")
    except OSError as error:
        raise _damaged(path, str(error.strerror)) from None
    if place.sha256 and hashlib.sha256(raw).hexdigest() != place.sha256:
        raise _damaged(path, "a tensor holds other bytes than were written")
    return array.reshape(place.shape)


def verify(path: Path) -> None:
    """Read a whole file, tensor by tensor, and compare it with the checksums in its header.

    Raises:
        UserError: the file is absent or damaged.
    """
    for place in places(path).values():
        read_at(path, place)


def check(params: Params, like: Params, where: str) -> None:
    """Insist that parameters have the paths and shapes that a configuration gives them.

    Args:
        params: what was read.
        like: arrays, or abstract arrays (``jax.eval_shape``), of the expected paths and shapes.
        where: the file, for the message.

    Raises:
        TreeError: with the list of differences.
    """
    tree.require_like(params, like, where)


def metadata(path: Path) -> dict[str, str]:
    """Read only the words that ``save`` put in the header.

    Raises:
        UserError: the file is absent or damaged.
    """
    places(path)
    table, _ = _header(path)
    return json.loads((table.get("__metadata__") or {}).get(_WORDS, "{}"))


def _dtype(leaf: Array) -> np.dtype:
    return np.dtype(leaf.dtype) if hasattr(leaf, "dtype") else np.asarray(leaf).dtype


def _header(path: Path) -> tuple[dict, int]:
    """Return the header's table and the byte at which the tensors begin."""
    if not path.is_file():
        raise UserError(f"{path} does not exist; train.py writes it when a stage is finished.")
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            start = file.read(8)
            if len(start) < 8:
                raise _damaged(path, "it is empty" if not start else "it ends too early")
            (length,) = struct.unpack("<Q", start)
            if length > size - 8:
                raise _damaged(path, "it ends within its header")
            text = file.read(length)
            table = json.loads(text)
    except OSError as error:
        raise _damaged(path, str(error.strerror)) from None
    except (ValueError, RecursionError) as error:
        if isinstance(error, UserError):
            raise
        raise _damaged(path, "its header is not JSON") from None
    if not isinstance(table, dict):
        raise _damaged(path, "its header is not a table")
    said = table.get("__metadata__") or {}
    if _TENSORS in said or _HEADER in said:
        digest = str(said.get(_HEADER))
        if hashlib.sha256(text.replace(digest.encode(), _NONE.encode())).hexdigest() != digest:
            raise _damaged(path, "its header is not what was written")
    return table, 8 + length


def _damaged(path: Path, why: str) -> UserError:
    return UserError(f"{path} is damaged or cut short ({why}); copy it again or make it again.")
