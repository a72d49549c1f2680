"""The layout of a record: magic word, header, payload.

``docs/data_format.md`` describes it byte by byte.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from pewm_jax.config import UserError

MAGIC = b"PEWMEPIS"
VERSION = 1
FINE = 2
"""Version of records without depth, or with depth in another unit than millimetres."""

CONVENTIONS = {
    "camera": "OpenCV axes: x right, y down, z forward",
    "world": "gravity-aligned, z up",
    "world_from_camera": "4x4 rigid transform, camera to world, one per frame",
    "intrinsics": "fx, fy, cx, cy; the centre of the top-left pixel is (0.5, 0.5)",
    "depth": "along z, not along the ray; 0 = no measurement",
    "actions": "dx forward, dy left, dyaw counter-clockwise; first move, then turn; "
    "action k leads from frame k to frame k + 1",
    "action_ids": "0 forward, 1 turn left, 2 turn right",
    "ids": "instance per pixel plus 1; 0 = nothing",
}
UNITS = {
    "world_from_camera": "metre",
    "depth": "millimetre on disk, metre once decoded",
    "intrinsics": "pixel",
    "actions": "metre, metre, radian",
}


def new_header(
    name: str, scene: str, shape_THW: tuple[int, int, int], info: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the header of an episode without arrays and streams; it has all required fields."""
    return {
        "format": "pewm-episode",
        "version": VERSION,
        "name": name,
        "scene": scene,
        **dict(zip(("frames", "height", "width"), shape_THW, strict=True)),
        "units": UNITS,
        "conventions": CONVENTIONS,
        "info": dict(info),
        "arrays": {},
        "streams": {},
    }


class DamagedError(UserError):
    """A damaged record; it can be skipped, or must be made again."""


def array_shapes(frames: int) -> dict[str, tuple[int | str, ...]]:
    """Return the shapes of the arrays of an episode; a letter stands for any number."""
    return {
        "intrinsics": (4,),
        "world_from_camera": (frames, 4, 4),
        "actions": (frames - 1, "A"),
        "action_ids": (frames - 1,),
        "states": (frames, "S"),
        "voxel_origins": (frames, 3),
    }


def shape_fits(shape: tuple[int, ...], expected: tuple[int | str, ...]) -> bool:
    """Return whether a shape matches an expected shape of ``array_shapes``."""
    return len(shape) == len(expected) and all(
        isinstance(wanted, str) or size == wanted
        for size, wanted in zip(shape, expected, strict=True)
    )


def shape_text(expected: tuple[int | str, ...] | None) -> str:
    """Return an expected shape as text; "no such field" for None."""
    return "no such field" if expected is None else f"({', '.join(map(str, expected))})"


def pack_record(
    header: dict[str, Any],
    arrays: Mapping[str, np.ndarray],
    streams: Mapping[str, list[bytes]],
    about: Mapping[str, dict[str, Any]] | None = None,
) -> bytes:
    """Concatenate header, arrays and images; offsets count from the end of the header.

    ``arrays`` and ``streams`` of the header are filled in. A stream has the encoded images, or
    grids, of each frame; ``about`` has header entries of the streams that are not PNG images.
    """
    blobs: list[bytes] = []
    offset = 0
    for field, array in arrays.items():
        place = {"offset": offset, "dtype": array.dtype.str, "shape": list(array.shape)}
        header["arrays"][field] = place
        blobs.append(array.tobytes())
        offset += array.nbytes
    for stream, images in streams.items():
        spans = []
        for image in images:
            spans.append([offset, len(image)])
            blobs.append(image)
            offset += len(image)
        own = (about or {}).get(stream, {})
        header["streams"][stream] = {"codec": "png", **own, "spans": spans}
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    return b"".join([MAGIC, struct.pack("<I", len(text)), text, *blobs])


def _absolute(header: dict[str, Any], payload: int) -> dict[str, Any]:
    for place in header["arrays"].values():
        place["offset"] += payload
    for stream in header["streams"].values():
        stream["spans"] = [(offset + payload, size) for offset, size in stream["spans"]]
    return header


def check_span(record: bytes, offset: int, size: int, where: str, field: str) -> None:
    """Raise DamagedError if a record ends before a field does."""
    if offset + size > len(record):
        raise DamagedError(
            f"{where}, field {field}: the record ends after {len(record)} bytes but the field "
            f"reaches to {offset + size}; it is truncated, collect or import it again."
        )


def read_header(record: bytes, where: str = "record") -> dict[str, Any]:
    """Parse the header of a record; spans become offsets from the start of the record.

    Raises:
        UserError: the record has another format version.
        DamagedError: the record is not an episode, or its header does not parse.
    """
    if len(record) < len(MAGIC) + 4 or record[: len(MAGIC)] != MAGIC:
        raise DamagedError(
            f"{where} is not a pewm episode (its first bytes differ); read a file made by "
            "`pewm-jax data collect` or `pewm-jax data import`."
        )
    (length,) = struct.unpack_from("<I", record, len(MAGIC))
    start = len(MAGIC) + 4
    try:
        header = json.loads(record[start : start + length])
        version = header["version"]
        if version in (VERSION, FINE):
            required = new_header("", "", (0, 0, 0), {})
            header = _absolute({field: header[field] for field in required}, start + length)
    except (UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError, AttributeError):
        raise DamagedError(
            f"{where}: the episode's header does not parse; the record is damaged, collect or "
            "import it again."
        ) from None
    if version not in (VERSION, FINE):
        raise UserError(
            f"{where} has format version {version}, this library reads versions {VERSION} and "
            f"{FINE}; collect or import it again."
        )
    return header
