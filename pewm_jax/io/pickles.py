"""Safe reading of pickled tensors of other libraries: nothing in the file is executed.

``pickle.load`` lets a file call any function. Here a pickle may only name stand-ins defined in this
module, which build tables and arrays; NumPy and torch are never called with data from the file. Two
kinds of files are read: tables of NumPy arrays, and the format of ``torch.save`` since torch 1.6 (a
zip with a pickle and one member per storage); torch is not needed.
"""

from __future__ import annotations

import dataclasses
import io
import math
import pickle
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from pewm_jax.errors import UserError

Tensors = dict[str, Any]
"""Nested tables of arrays."""

_STORAGES = {
    "DoubleStorage": np.dtype("<f8"),
    "FloatStorage": np.dtype("<f4"),
    "HalfStorage": np.dtype("<f2"),
    "BFloat16Storage": np.dtype(jnp.bfloat16),
    "LongStorage": np.dtype("<i8"),
    "IntStorage": np.dtype("<i4"),
    "ShortStorage": np.dtype("<i2"),
    "CharStorage": np.dtype("i1"),
    "ByteStorage": np.dtype("u1"),
    "BoolStorage": np.dtype("?"),
}
_KINDS = "fiub"
"""Kinds of NumPy dtypes that are read: numbers and booleans, no objects."""
WEIGHTS = "save its tensors as safetensors, or with torch.save of torch 1.6 or newer"
"""What to do about refused weights."""


def read(path: Path, remedy: str = WEIGHTS) -> Tensors:
    """Read nested dictionaries of arrays from a pickle of NumPy arrays or a file of ``torch.save``.

    Args:
        path: the file.
        remedy: what to do, in the sentence that refuses a file.

    Raises:
        UserError: the file is missing or damaged, contains anything but tensors in tables, or has
            torch's format before 1.6.
    """
    if not path.is_file():
        raise UserError(f"{path} does not exist; give the path of a weights file.")
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                return _require_arrays(_read_zip(archive))
        return _require_arrays(_Reader(io.BytesIO(path.read_bytes()), {}).load())
    except Exception as error:  # a damaged pickle may raise anything
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(
            f"{path} cannot be read as a table of tensors ({reason[:160]}); {remedy}."
        ) from error


@dataclasses.dataclass
class _Maker:
    """A stand-in for a callable named in a pickle; the pickle cannot modify it."""

    make: Callable[..., Any]

    def __call__(self, *arguments: Any) -> Any:
        return self.make(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError("it sets the state of a callable")


class _Table(dict):
    """A table of torch, without its version metadata."""

    def __setstate__(self, state: Any) -> None:
        del state


class _Dtype:
    """A NumPy dtype: a type code; the byte order is set later."""

    def __init__(self, code: Any, *_: Any):
        self.dtype = np.dtype(code if isinstance(code, str) and len(code) <= 3 else "O")
        if self.dtype.kind not in _KINDS:
            raise pickle.UnpicklingError(f"it contains dtype {code!r}, which is not numeric")

    def __setstate__(self, state: Any) -> None:
        if state[1] in ("<", ">"):
            self.dtype = self.dtype.newbyteorder(state[1])


class _Array:
    """A NumPy array whose content is set later."""

    array: np.ndarray | None = None

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, fortran, raw = state
        if not (isinstance(dtype, _Dtype) and isinstance(raw, bytes)):
            raise pickle.UnpicklingError("an array is not stored as raw bytes")
        flat = np.frombuffer(raw, dtype.dtype)
        self.array = flat.reshape(shape, order="F" if fortran else "C")


class _Reader(pickle.Unpickler):
    """An unpickler restricted to arrays and tables."""

    def __init__(self, file: io.BytesIO, storages: Mapping[str, bytes]):
        super().__init__(file)
        self._storages = storages

    def find_class(self, module: str, name: str) -> Any:
        if module == "torch" and name in _STORAGES:
            return _STORAGES[name]
        if (module, name) not in _NAMES:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which is not a tensor type")
        return _Maker(_NAMES[module, name])

    def persistent_load(self, pid: Any) -> np.ndarray:
        word, dtype, key, _, count = pid
        if word != "storage" or not isinstance(dtype, np.dtype) or key not in self._storages:
            raise pickle.UnpicklingError("it refers to a storage that is not in the file")
        flat = np.frombuffer(self._storages[key], dtype)
        if len(flat) != count:
            raise pickle.UnpicklingError("a storage has another length than declared")
        return flat


def _read_zip(archive: zipfile.ZipFile) -> Any:
    """Read torch's format: ``NAME/data.pkl`` and the storages ``NAME/data/KEY``."""
    (program,) = [name for name in archive.namelist() if name.endswith("/data.pkl")]
    root = program.removesuffix("data.pkl")
    if f"{root}byteorder" in archive.namelist() and archive.read(f"{root}byteorder") != b"little":
        raise pickle.UnpicklingError("it is big-endian")
    prefix = f"{root}data/"
    storages = {
        name.removeprefix(prefix): archive.read(name)
        for name in archive.namelist()
        if name.startswith(prefix)
    }
    return _Reader(io.BytesIO(archive.read(program)), storages).load()


def _tensor(storage: Any, offset: int, size: tuple, stride: tuple, *_: Any) -> np.ndarray:
    """Return a torch tensor: a view of a storage, with offset and strides in elements."""
    reach = 1 + offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if not isinstance(storage, np.ndarray) or min((0, offset, *size, *stride)) < 0:
        raise pickle.UnpicklingError("a tensor has no storage or an impossible shape")
    if 0 in size:
        return np.zeros(size, storage.dtype)
    if max(reach, math.prod(size)) > len(storage):
        raise pickle.UnpicklingError("a tensor extends beyond its storage")
    steps = tuple(step * storage.itemsize for step in stride)
    return np.lib.stride_tricks.as_strided(storage[offset:], size, steps, writeable=False).copy()


def _require_arrays(found: Any) -> Tensors:
    """Return the unpickled tables of arrays; raise an error for anything else."""
    if not isinstance(found, dict) or not all(isinstance(name, str) for name in found):
        raise pickle.UnpicklingError("it contains no table of named tensors")
    made: Tensors = {}
    for name, part in found.items():
        array = part.array if isinstance(part, _Array) else part
        made[name] = array.copy() if isinstance(array, np.ndarray) else _require_arrays(part)
    return made


def _from_buffer(raw: Any, dtype: Any, shape: Any, order: Any, *_: Any) -> _Array:
    """Return an array that protocol 5 of pickle stores as a buffer."""
    if not (isinstance(dtype, _Dtype) and isinstance(raw, bytes | bytearray)):
        raise pickle.UnpicklingError("an array is not stored as raw bytes")
    made = _Array()
    made.array = np.frombuffer(raw, dtype.dtype).reshape(shape, order="F" if order == "F" else "C")
    return made


def _bytes_of(text: Any, encoding: Any) -> bytes:
    """Return the bytes that pickles of protocol 2 store as text."""
    if not isinstance(text, str) or encoding != "latin1":
        raise pickle.UnpicklingError("it encodes something else than bytes")
    return text.encode("latin1")


_NAMES: dict[tuple[str, str], Callable[..., Any]] = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("numpy.core.multiarray", "_reconstruct"): lambda *_: _Array(),
    ("numpy._core.multiarray", "_reconstruct"): lambda *_: _Array(),
    ("numpy.core.numeric", "_frombuffer"): _from_buffer,
    ("numpy._core.numeric", "_frombuffer"): _from_buffer,
    ("_codecs", "encode"): _bytes_of,
    ("collections", "OrderedDict"): lambda *_: _Table(),
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch._utils", "_rebuild_parameter"): lambda tensor, *_: tensor,
}
"""All names that a pickle may use, and their stand-ins."""
