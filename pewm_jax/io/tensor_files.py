"""Safetensors files: flat tables of named arrays, with checksums in the header of our own.

The ``safetensors`` library reads files and checks that header and size agree. Three things that it
does not do (0.8) are done here:

- Writing tensor by tensor. ``serialize_file`` wants all tensors in host memory at once; here no
  more than one is held beside what the caller holds.
- Checksums. The header of our files has the SHA-256 of every tensor and of itself.
- Mapping a file, so that only the indexed part of an array is read. ``get_slice`` returns no array:
  it has neither ``shape`` nor ``dtype``, and cannot be indexed by a list.
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
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors

from pewm_jax.errors import UserError
from pewm_jax.io import atomic, tree
from pewm_jax.types import Array

OURS = "pewm_jax"
"""The key of our own metadata, one JSON text with sorted keys: equal weights are equal files."""
_TENSORS, _HEADER = "sha256", "header_sha256"
"""The keys of checksums: of each tensor, and of the header with zeros in place of this one."""
_NO_DIGEST = "0" * 64
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
    """Where one tensor lies in a safetensors file.

    Attributes:
        name: its name.
        shape: its shape.
        dtype: its dtype.
        begin: its first byte in the file.
        sha256: of its bytes, empty if the file does not say.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    begin: int
    sha256: str = ""

    @property
    def size(self) -> int:
        """Return the bytes it takes."""
        return math.prod(self.shape) * self.dtype.itemsize


def header(metadata: Mapping[str, str]) -> dict[str, str]:
    """Return what ``write`` takes to write a file of ours, with metadata and checksums."""
    return {OURS: json.dumps(dict(metadata), sort_keys=True)}


def write(
    path: Path,
    like: Mapping[str, Array | jax.ShapeDtypeStruct],
    tensors: Iterable[tuple[str, Array]],
    metadata: Mapping[str, str],
    progress: Callable[[int], None] = lambda _: None,
) -> None:
    """Write a safetensors file tensor by tensor, whole or not at all.

    Args:
        path: the file; its folder is made.
        like: name → anything with the tensor's shape and dtype.
        tensors: the tensors, in any order, each once.
        metadata: the ``__metadata__`` of the header. Checksums are added if it is of ``header``.
        progress: called after every tensor with the bytes just written.

    Raises:
        ValueError: the tensors are not those announced.
    """
    order = sorted(like, key=lambda name: (-like[name].dtype.itemsize, name))
    facts, ours = dict(metadata), OURS in metadata
    table: dict[str, Any] = {"__metadata__": facts}
    digests = dict.fromkeys(order, _NO_DIGEST)
    if ours:
        facts |= {_TENSORS: json.dumps(digests), _HEADER: _NO_DIGEST}
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
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic.replacing(path) as partial, partial.open("wb") as file:
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
            file.seek(start + table[name]["data_offsets"][0])
            raw = np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
            file.write(raw)
            digests[name] = hashlib.sha256(raw).hexdigest() if ours else ""
            progress(array.nbytes)
            del tensor, array, raw  # before the next one is made
        if left:
            raise ValueError(f"{tree.listing(left)} were announced and not given.")
        if ours:
            facts[_TENSORS] = json.dumps(digests)
            facts[_HEADER] = hashlib.sha256(_text(table)).hexdigest()
            file.seek(8)
            file.write(_text(table))
        file.flush()
        os.fsync(file.fileno())


def _text(table: Mapping[str, object]) -> bytes:
    """Return a header as it stands in the file, padded to words of 8 bytes."""
    text = json.dumps(table, separators=(",", ":")).encode()
    return text + b" " * (-len(text) % 8)


def size(like: Mapping[str, Array | jax.ShapeDtypeStruct]) -> int:
    """Return the bytes that tensors take, of anything with shape and dtype by name."""
    return sum(math.prod(x.shape) * np.dtype(x.dtype).itemsize for x in like.values())


def places(path: Path) -> dict[str, Place]:
    """Return where each tensor of a safetensors file lies, having read its header only.

    Raises:
        UserError: the file is absent, truncated or damaged, or of a dtype that is not known.
    """
    with _opened(path) as file:
        return _places(path, file)


def metadata(path: Path) -> dict[str, str]:
    """Return the ``__metadata__`` of a safetensors file; raises as ``places``."""
    with _opened(path) as file:
        _places(path, file)
        return file.metadata() or {}


def read(
    path: Path, wanted: Callable[[str], bool] = lambda _: True
) -> Iterator[tuple[str, np.ndarray]]:
    """Read tensors one by one, each into memory of its own.

    Args:
        path: a safetensors file.
        wanted: tells by its name whether a tensor is read; by default all are.

    Yields:
        Names and arrays.

    Raises:
        UserError: the file is absent or damaged, or holds other bytes than were written.
    """
    with _opened(path) as file:
        for name, place in _places(path, file).items():
            if wanted(name):
                yield name, _read(path, file, place)


def mapped(path: Path) -> dict[str, np.ndarray]:
    """Map a file into memory: what is not indexed is not read, and checksums are not compared.

    Raises:
        UserError: as ``places``.
    """
    found = places(path)
    whole = np.memmap(path, np.uint8, "r")
    return {
        name: whole[place.begin : place.begin + place.size].view(place.dtype).reshape(place.shape)
        for name, place in found.items()
    }


def read_at(path: Path, place: Place) -> np.ndarray:
    """Read one tensor into memory of its own.

    Raises:
        UserError: the file is absent or damaged, or holds other bytes than were written.
    """
    with _opened(path) as file:
        return _read(path, file, place)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a file with the library, and turn what goes wrong in reading it into a sentence."""
    if not path.is_file():
        raise UserError(f"{path} does not exist; train.py writes it when a stage is finished.")
    try:
        # Not mapped into memory: of a mapped file, an error of the disk ends the process (SIGBUS).
        with safetensors.safe_open(path, framework="numpy", backend="pread") as file:
            yield file
    except OSError as error:
        raise _damaged(path, error.strerror or str(error)) from None
    except safetensors.SafetensorError as error:
        reason = str(error).removeprefix("Error while deserializing header: ")
        raise _damaged(path, reason[:160]) from None


def _places(path: Path, file: Any) -> dict[str, Place]:
    """Compute the places of an opened file; the library has checked that there are no gaps."""
    begin, text = _header(path)
    facts = file.metadata() or {}
    digests = json.loads(facts[_TENSORS]) if _has_checksums(path, facts, text) else {}
    found = {}
    for name in file.offset_keys():
        part = file.get_slice(name)
        kind = part.get_dtype()
        if kind not in _DTYPES:
            raise UserError(
                f"{path} holds {name} in {kind}, which cannot be read here; save it in float32, "
                "bfloat16 or float16."
            )
        place = Place(name, tuple(part.get_shape()), _DTYPES[kind], begin, digests.get(name, ""))
        found[name] = place
        begin += place.size
    return found


def _header(path: Path) -> tuple[int, bytes]:
    """Return the byte at which the tensors begin, and the text before it."""
    with path.open("rb") as file:
        (length,) = struct.unpack("<Q", file.read(8))
        return 8 + length, file.read(length)


def _has_checksums(path: Path, facts: Mapping[str, str], text: bytes) -> bool:
    """Tell whether a file has checksums; refuse a header that is not the one they were made of."""
    if _TENSORS not in facts and _HEADER not in facts:
        return False
    digest = facts.get(_HEADER, "")
    zeroed = text.replace(digest.encode(), _NO_DIGEST.encode())
    if hashlib.sha256(zeroed).hexdigest() != digest:
        raise _damaged(path, "its header is not what was written")
    return True


def _read(path: Path, file: Any, place: Place) -> np.ndarray:
    """Read one tensor of an opened file and compare it with its checksum."""
    array = file.get_tensor(place.name)
    if place.sha256:
        raw = array.reshape(-1).view(np.uint8).data
        if hashlib.sha256(raw).hexdigest() != place.sha256:
            raise _damaged(path, "a tensor holds other bytes than were written")
    return array


def _damaged(path: Path, why: str) -> UserError:
    return UserError(f"{path} is damaged or cut short ({why}); copy it again or make it again.")
