"""Safetensors files: flat tables of named arrays, with checksums in our header.

The ``safetensors`` library reads files and checks that header and size agree. This module adds
three functions that the library (0.8) lacks:

- Writing tensor by tensor: ``serialize_file`` needs all tensors in host memory at once.
- Checksums. The header of our files contains the SHA-256 of every tensor and of the header itself.
- Memory-mapping a file, so that only the indexed part of an array is read. The result of
  ``get_slice`` has neither ``shape`` nor ``dtype``, and cannot be indexed by a list.
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
"""The key of our metadata, one JSON text with sorted keys, so that equal weights give equal
files."""
_TENSORS, _HEADER = "sha256", "header_sha256"
"""The keys of checksums: of each tensor, and of the header with zeros in place of this one."""
_NO_DIGEST = "0" * 64
_BLOCK = 1 << 20
"""Bytes of an array in another order of axes that are copied at once when it is written."""
_DTYPES = {"BOOL": np.dtype(bool), "BF16": np.dtype(jnp.bfloat16)} | {
    f"{letter}{8 * size}": np.dtype(f"{letter.lower()}{size}")
    for letter, sizes in (("U", (1, 2, 4, 8)), ("I", (1, 2, 4, 8)), ("F", (2, 4, 8)))
    for size in sizes
}
_NAMES = {dtype: name for name, dtype in _DTYPES.items()}


@dataclasses.dataclass(frozen=True)
class Place:
    """Location of one tensor in a safetensors file.

    Attributes:
        begin: offset of its first byte in the file.
        sha256: hash of its bytes, empty if the file has none.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    begin: int
    sha256: str = ""

    @property
    def size(self) -> int:
        """Return its size in bytes."""
        return math.prod(self.shape) * self.dtype.itemsize


def header(metadata: Mapping[str, str]) -> dict[str, str]:
    """Return the ``metadata`` argument of ``write`` for a file with our metadata and checksums."""
    return {OURS: json.dumps(dict(metadata), sort_keys=True)}


def write(
    path: Path,
    like: Mapping[str, Array | jax.ShapeDtypeStruct],
    tensors: Iterable[tuple[str, Array]],
    metadata: Mapping[str, str],
    progress: Callable[[int], None] = lambda _: None,
) -> None:
    """Write a safetensors file tensor by tensor, atomically.

    Args:
        path: the file; its folder is created.
        like: name → anything with the tensor's shape and dtype.
        tensors: the tensors, in any order, each once: whole, or in consecutive blocks of their
            values in C order, so that only a block is in memory.
        metadata: the ``__metadata__`` of the header. Checksums are added if it comes from
            ``header``.
        progress: called after every tensor with the bytes just written.

    Raises:
        ValueError: the tensors differ from ``like``.
    """
    specs = {name: (tuple(x.shape), np.dtype(x.dtype)) for name, x in like.items()}
    order = sorted(specs, key=lambda name: (-specs[name][1].itemsize, name))
    facts, ours = dict(metadata), OURS in metadata
    table: dict[str, Any] = {"__metadata__": facts}
    digests = dict.fromkeys(order, _NO_DIGEST)
    if ours:
        facts |= {_TENSORS: json.dumps(digests), _HEADER: _NO_DIGEST}
    end = 0
    for name in order:
        shape, dtype = specs[name]
        begin, end = end, end + math.prod(shape) * dtype.itemsize
        table[name] = {"dtype": _NAMES[dtype], "shape": list(shape), "data_offsets": [begin, end]}
    text = _text(table)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic.replacing(path) as partial, partial.open("wb") as file:
        file.write(struct.pack("<Q", len(text)) + text)
        start = file.tell()
        left = {name: math.prod(shape) for name, (shape, _) in specs.items()}
        hashes = {name: hashlib.sha256() for name in order} if ours else {}
        for name, tensor in tensors:
            array = np.asarray(jax.device_get(tensor))
            shape, dtype = specs.get(name, ((), None))
            whole = array.size == math.prod(shape)
            if (
                array.dtype != dtype
                or array.size > left.get(name, -1)
                or (whole and array.shape != shape)
            ):
                raise ValueError(f"{name} {array.shape} {array.dtype} differs from ``like``.")
            file.seek(start + table[name]["data_offsets"][1] - left[name] * array.itemsize)
            left[name] -= array.size
            for raw in _contiguous(array):
                file.write(raw)
                if ours:
                    hashes[name].update(raw)
            progress(array.nbytes)
            if not left[name]:
                del left[name]
                digests[name] = hashes.pop(name).hexdigest() if ours else ""
            del tensor, array  # free memory before the next one is made
        if left:
            raise ValueError(f"{tree.listing(left)} are in ``like`` but were not yielded.")
        if ours:
            facts[_TENSORS] = json.dumps(digests)
            facts[_HEADER] = hashlib.sha256(_text(table)).hexdigest()
            file.seek(8)
            file.write(_text(table))
        file.flush()
        os.fsync(file.fileno())


def _contiguous(array: np.ndarray) -> Iterator[memoryview]:
    """Yield the bytes of an array in C order, without a second copy of a large one."""
    rows = len(array) if array.ndim else 1
    step = rows if array.flags.c_contiguous else max(1, rows * _BLOCK // max(array.nbytes, 1))
    for row in range(0, rows, max(step, 1)):
        block = array[row : row + step] if array.ndim else array
        yield np.ascontiguousarray(block).reshape(-1).view(np.uint8).data


def _text(table: Mapping[str, object]) -> bytes:
    """Return a header as stored in the file, padded to a multiple of 8 bytes."""
    text = json.dumps(table, separators=(",", ":")).encode()
    return text + b" " * (-len(text) % 8)


def size(like: Mapping[str, Any]) -> int:
    """Return the size in bytes of tensors, given anything with shape and dtype by name."""
    return sum(math.prod(x.shape) * np.dtype(x.dtype).itemsize for x in like.values())


def places(path: Path) -> dict[str, Place]:
    """Return the location of each tensor of a safetensors file; reads only its header.

    Raises:
        UserError: the file is missing, truncated or damaged, or has an unsupported dtype.
    """
    with _open(path) as file:
        return _places(path, file)


def metadata(path: Path) -> dict[str, str]:
    """Return the ``__metadata__`` of a safetensors file; raises as ``places``."""
    with _open(path) as file:
        _places(path, file)
        return file.metadata() or {}


def read(
    path: Path, wanted: Callable[[str], bool] = lambda _: True
) -> Iterator[tuple[str, np.ndarray]]:
    """Read tensors one by one, each into its own memory.

    Args:
        path: a safetensors file.
        wanted: returns, by name, whether to read a tensor; all by default.

    Raises:
        UserError: the file is missing or damaged, or a checksum is wrong.
    """
    with _open(path) as file:
        for name, place in _places(path, file).items():
            if wanted(name):
                yield name, _read(path, file, place)


def mapped(path: Path) -> dict[str, np.ndarray]:
    """Memory-map a file: only indexed parts are read, and checksums are not verified."""
    found = places(path)
    whole = np.memmap(path, np.uint8, "r")
    return {
        name: whole[place.begin : place.begin + place.size].view(place.dtype).reshape(place.shape)
        for name, place in found.items()
    }


def read_at(path: Path, place: Place) -> np.ndarray:
    """Read one tensor into its own memory; raises as ``read``."""
    with _open(path) as file:
        return _read(path, file, place)


@contextlib.contextmanager
def _open(path: Path) -> Iterator[Any]:
    """Open a file with the library; raise its errors as ``UserError``."""
    if not path.is_file():
        raise UserError(f"{path} does not exist; train.py writes it at the end of a stage.")
    try:
        # Not memory-mapped: a disk error in a mapped file kills the process (SIGBUS).
        with safetensors.safe_open(path, framework="numpy", backend="pread") as file:
            yield file
    except OSError as error:
        raise _damaged(path, error.strerror or str(error)) from None
    except safetensors.SafetensorError as error:
        reason = str(error).removeprefix("Error while deserializing header: ")
        raise _damaged(path, reason[:160]) from None


def _places(path: Path, file: Any) -> dict[str, Place]:
    """Return the locations in an opened file; the library has checked that there are no gaps."""
    with path.open("rb") as raw:
        (length,) = struct.unpack("<Q", raw.read(8))
        begin, text = 8 + length, raw.read(length)
    facts = file.metadata() or {}
    digests = json.loads(facts[_TENSORS]) if _has_checksums(path, facts, text) else {}
    found = {}
    for name in file.offset_keys():
        part = file.get_slice(name)
        kind = part.get_dtype()
        if kind not in _DTYPES:
            raise UserError(
                f"{path} contains {name} in {kind}, which is not supported; save it in float32, "
                "bfloat16 or float16."
            )
        place = Place(name, tuple(part.get_shape()), _DTYPES[kind], begin, digests.get(name, ""))
        found[name] = place
        begin += place.size
    return found


def _has_checksums(path: Path, facts: Mapping[str, str], text: bytes) -> bool:
    """Return whether a file has checksums; raise UserError if the header's checksum is wrong."""
    if _TENSORS not in facts and _HEADER not in facts:
        return False
    digest = facts.get(_HEADER, "")
    zeroed = text.replace(digest.encode(), _NO_DIGEST.encode())
    if hashlib.sha256(zeroed).hexdigest() != digest:
        raise _damaged(path, "its header has a wrong checksum")
    return True


def _read(path: Path, file: Any, place: Place) -> np.ndarray:
    """Read one tensor of an opened file and verify its checksum."""
    array = file.get_tensor(place.name)
    if place.sha256:
        raw = array.reshape(-1).view(np.uint8).data
        if hashlib.sha256(raw).hexdigest() != place.sha256:
            raise _damaged(path, "a tensor has a wrong checksum")
    return array


def _damaged(path: Path, why: str) -> UserError:
    return UserError(f"{path} is damaged or truncated ({why}); copy it again or create it again.")
