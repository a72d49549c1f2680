"""Episodes: their fields, and writing and reading them as records.

One record is one episode. Its header gives the offset of every array and every encoded image, so
single frames can be decoded without the others (``record_format.py``, ``docs/data_format.md``).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from pewm_jax.config import UserError
from pewm_jax.data import voxels as voxel_frames
from pewm_jax.data.record_format import (
    FINE,
    UNITS,
    DamagedError,
    array_shapes,
    check_span,
    new_header,
    pack_record,
    read_header,
    shape_fits,
    shape_text,
)
from pewm_jax.data.voxels import VoxelFrames, VoxelGrid, check_voxels
from pewm_jax.types import Camera, Frames

MILLIMETRES = 1000.0
SATURATED = 65535
"""The largest 16-bit value: sensors mark missing or too large depth with it. Never written."""
DEPTH_LIMIT_M = (SATURATED - 1) / MILLIMETRES
"""The largest depth stored; depths beyond it become 0, "no measurement"."""
PNG_LEVEL = 1


@dataclasses.dataclass(frozen=True)
class EpisodeArrays:
    """The arrays of an episode to write.

    Attributes:
        rgb_THWC: uint8.
        depth_THW: float metres along z, 0 = no measurement.
        intrinsics_4: fx, fy, cx, cy in pixels, centres at +0.5.
        world_from_camera: (T, 4, 4) camera-to-world.
        actions: (T − 1, 3) dx, dy, dyaw, or (T − 1, A) of another kind of control, or None if the
            camera does not move like the agent.
        action_ids: (T − 1,) discrete actions.
        ids_THW: instance ids from −1 (nothing) to 65534.
        voxels: the grid of class ids around the agent at each frame.
        states: (T, S) the agent's own state at each frame, such as the angles of its joints.
    """

    rgb_THWC: np.ndarray
    depth_THW: np.ndarray
    intrinsics_4: np.ndarray
    world_from_camera: np.ndarray
    actions: np.ndarray | None = None
    action_ids: np.ndarray | None = None
    ids_THW: np.ndarray | None = None
    voxels: VoxelFrames | None = None
    states: np.ndarray | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Episode:
    """An episode read from disk; small arrays are decoded at once, images on request.

    Attributes:
        name: name of the episode, e.g. ``house-000012/follow``.
        scene: name of the scene it was recorded in.
        length: T, its number of frames.
        world_from_camera: (T, 4, 4) float32.
        actions: (T − 1, A) float32 or None; A = 3 is (dx, dy, dyaw).
        action_ids: (T − 1,) int32 or None.
        voxel_origin_T3: float32 lowest corners of the grids around the agent, or None.
        states: (T, S) float32 state of the agent at each frame, or None.
        info: further JSON values, e.g. ``return_frame`` of a revisit episode.
        header: the whole JSON header.
        record: the bytes.
    """

    name: str
    scene: str
    length: int
    height: int
    width: int
    intrinsics_4: np.ndarray
    world_from_camera: np.ndarray
    actions: np.ndarray | None
    action_ids: np.ndarray | None
    voxel_origin_T3: np.ndarray | None
    info: Mapping[str, Any]
    header: Mapping[str, Any] = dataclasses.field(repr=False)
    record: bytes = dataclasses.field(repr=False)
    states: np.ndarray | None = None

    @property
    def has_depth(self) -> bool:
        """Whether depth was recorded; without it, ``frames`` returns 0 everywhere."""
        return "depth" in self.header["streams"]

    @property
    def depth_per_metre(self) -> float:
        """Value of a stored depth that means one metre."""
        stream = self.header["streams"].get("depth", {})
        return float(stream.get("per_metre", MILLIMETRES))

    @property
    def has_ids(self) -> bool:
        """Whether instance ids were recorded."""
        return "ids" in self.header["streams"]

    def camera(self, indices: Sequence[int] | np.ndarray | None = None) -> Camera:
        """Return the cameras of some frames (all by default), intrinsics repeated per frame."""
        pose = self.world_from_camera if indices is None else self.world_from_camera[indices]
        return Camera(np.broadcast_to(self.intrinsics_4, (len(pose), 4)).copy(), pose)

    def frames(self, indices: Sequence[int] | np.ndarray | None = None) -> Frames:
        """Decode some frames (all by default), in the order of ``indices``.

        Returns:
            NumPy frames: rgb uint8, depth float32 in metres (0 everywhere if none was recorded).

        Raises:
            DamagedError: an image does not decode; the message names the frame.
        """
        chosen = self._chosen(indices)
        rgb = np.empty((len(chosen), self.height, self.width, 3), np.uint8)
        depth = np.zeros((len(chosen), self.height, self.width), np.float32)
        for row, index in enumerate(chosen):
            rgb[row] = self._image("rgb", index)[..., ::-1]
            if self.has_depth:
                depth[row] = self._image("depth", index)
        depth /= self.depth_per_metre
        return Frames(rgb, depth, self.camera(chosen))

    def ids(self, indices: Sequence[int] | np.ndarray | None = None) -> np.ndarray:
        """Decode instance ids (T, H, W) int32, −1 = nothing; UserError if the episode has none."""
        if not self.has_ids:
            raise UserError(f"episode {self.name} has no instance ids; collect it with --ids.")
        chosen = self._chosen(indices)
        return np.stack([self._image("ids", i).astype(np.int32) - 1 for i in chosen])

    @property
    def voxel_grid(self) -> VoxelGrid | None:
        """The grids' cell, side and classes, or None; DamagedError for an inconsistent header."""
        stream = self.header["streams"].get("voxels")
        return None if stream is None else voxel_frames.grid_in(stream, f"episode {self.name}")

    def voxels(self, indices: Sequence[int] | np.ndarray | None = None) -> VoxelFrames:
        """Decode the grids around the agent of some frames (all by default), in that order.

        Raises:
            UserError: the episode has no voxels.
            DamagedError: a grid does not decode; the message names the frame.
        """
        grid, origin = self.voxel_grid, self.voxel_origin_T3
        if grid is None or origin is None:
            raise UserError(f"episode {self.name} has no voxels; collect it with --voxels.")
        chosen = self._chosen(indices)
        found = np.empty((len(chosen), *(grid.side,) * 3), grid.dtype)
        for row, index in enumerate(chosen):
            where = f"episode {self.name}, frame {index}"
            found[row] = voxel_frames.decode(self._code("voxels", index), grid, where)
        return VoxelFrames(found, origin[chosen], grid.cell_m, grid.names)

    def _chosen(self, indices: Sequence[int] | np.ndarray | None) -> np.ndarray:
        return np.arange(self.length) if indices is None else np.asarray(indices, np.int64)

    def _code(self, stream: str, index: int) -> memoryview:
        """Return the bytes of one frame in a stream."""
        if not 0 <= index < self.length:
            raise IndexError(f"frame {index} of {self.name}, which has {self.length} frames")
        offset, size = self.header["streams"][stream]["spans"][index]
        return memoryview(self.record)[offset : offset + size]

    def encoded(self, stream: str, index: int) -> bytes:
        """Return the PNG image of a frame in the stream ``rgb``, ``depth`` or ``ids``."""
        return bytes(self._code(stream, index))

    def _image(self, stream: str, index: int) -> np.ndarray:
        image = decode_image(self._code(stream, index), cv2.IMREAD_UNCHANGED)
        shape = (self.height, self.width, 3) if stream == "rgb" else (self.height, self.width)
        if image is None or image.shape != shape:
            raise DamagedError(
                f"episode {self.name}, frame {index}, {stream}: the image does not decode to "
                f"{self.width}×{self.height} pixels; the record is damaged, collect or import it "
                "again."
            )
        return image


def write_episode(
    arrays: EpisodeArrays, name: str, scene: str, info: Mapping[str, Any] | None = None
) -> bytes:
    """Encode an episode as one record; the same input gives the same bytes.

    ``info`` has JSON values to store in the header.

    Raises:
        UserError: the arrays' shapes or dtypes do not fit together.
    """
    _check_arrays(arrays, name)
    streams: dict[str, list[bytes]] = {
        "rgb": [encode_png(image[..., ::-1]) for image in arrays.rgb_THWC],
        "depth": [encode_png(image) for image in to_millimetres(arrays.depth_THW)],
    }
    if arrays.ids_THW is not None:
        streams["ids"] = [encode_png((image + 1).astype(np.uint16)) for image in arrays.ids_THW]
    about, voxels = {}, arrays.voxels
    if voxels is not None:
        streams["voxels"] = [voxel_frames.encode(grid) for grid in voxels.classes_TXYZ]
        about["voxels"] = voxel_frames.header_of(voxels)
    small = {
        "intrinsics": arrays.intrinsics_4,
        "world_from_camera": arrays.world_from_camera,
        "actions": arrays.actions,
        "action_ids": arrays.action_ids,
        "voxel_origins": None if voxels is None else voxels.origin_T3,
        "states": arrays.states,
    }
    header = new_header(name, scene, arrays.depth_THW.shape, info or {})
    return pack_encoded(header, small, streams, about)


def pack_encoded(
    header: dict[str, Any],
    small: Mapping[str, np.ndarray | None],
    streams: Mapping[str, list[bytes]],
    about: Mapping[str, dict[str, Any]] | None = None,
) -> bytes:
    """Return the record of an episode whose images are encoded already.

    Args:
        header: as of ``new_header``; it is changed.
        small: arrays by the names of ``array_shapes``; None for one that the episode lacks.
        streams: the encoded images of each frame; ``depth`` may be absent.
        about: header entries of streams. That of ``depth`` may have ``per_metre``, the stored value
            that means one metre, by default 1000.
    """
    types = {"action_ids": "<i4"}
    kept = {
        field: np.asarray(x, types.get(field, "<f4")) for field, x in small.items() if x is not None
    }
    per_metre = (about or {}).get("depth", {}).get("per_metre", MILLIMETRES)
    if "depth" not in streams or per_metre != MILLIMETRES:
        unit = f"1/{per_metre:g} metre on disk, metre once decoded"
        header |= {"version": FINE, "units": UNITS | {"depth": unit}}
    return pack_record(header, kept, streams, about)


def to_millimetres(depth: np.ndarray) -> np.ndarray:
    """Return metres as uint16 millimetres, rounded; 0 beyond 65.534 m and where not finite."""
    millimetres = np.rint(np.asarray(depth, np.float64) * MILLIMETRES)
    with np.errstate(invalid="ignore"):
        kept = (millimetres > 0) & (millimetres < SATURATED)
    return np.where(kept, millimetres, 0).astype(np.uint16)


def read_episode(record: bytes, where: str = "record") -> Episode:
    """Open a record, named ``where`` in messages, and decode its small arrays; images stay encoded.

    Raises:
        UserError: the record has another format version.
        DamagedError: the record is damaged, or its counts do not match.
    """
    header = read_header(record, where)
    frames = header["frames"]
    arrays: dict[str, np.ndarray] = {}
    for field, place in header["arrays"].items():
        shape, expected = tuple(place["shape"]), array_shapes(frames).get(field)
        if expected is None or not shape_fits(shape, expected):
            raise DamagedError(
                f"{where}, field {field}: shape {shape} for {frames} frames, expected "
                f"{shape_text(expected)}; the counts do not match, write it again."
            )
        dtype, count = np.dtype(place["dtype"]), int(np.prod(shape))
        check_span(record, place["offset"], count * dtype.itemsize, where, field)
        arrays[field] = np.frombuffer(record, dtype, count, place["offset"]).reshape(shape).copy()
    required = ("rgb",) if header["version"] == FINE else ("rgb", "depth")
    for stream in (*required, *header["streams"]):
        spans = header["streams"].get(stream, {"spans": []})["spans"]
        if len(spans) != frames:
            raise DamagedError(
                f"{where}, field {stream}: {len(spans)} images for {frames} frames; the counts do "
                "not match, write it again."
            )
        if spans:
            check_span(record, spans[-1][0], spans[-1][1], where, stream)
    if not {"intrinsics", "world_from_camera"} <= arrays.keys():
        raise DamagedError(f"{where} lacks intrinsics or world_from_camera; write it again.")
    if ("voxels" in header["streams"]) != ("voxel_origins" in arrays):
        raise DamagedError(f"{where} lacks voxels or voxel_origins; write it again.")
    return Episode(
        **{field: header[field] for field in ("name", "scene", "height", "width", "info")},
        length=frames,
        intrinsics_4=arrays["intrinsics"],
        world_from_camera=arrays["world_from_camera"],
        actions=arrays.get("actions"),
        action_ids=arrays.get("action_ids"),
        voxel_origin_T3=arrays.get("voxel_origins"),
        states=arrays.get("states"),
        header=header,
        record=record,
    )


def decode_image(code: bytes | memoryview, flags: int) -> np.ndarray | None:
    """Decode an image with ``cv2.imdecode``; return None for bytes that are not an image."""
    try:
        return cv2.imdecode(np.frombuffer(code, np.uint8), flags)
    except cv2.error:  # raised for empty input and for impossible sizes
        return None


def encode_png(image: np.ndarray) -> bytes:
    """Return an image (BGR or one channel, 8 or 16 bits) as PNG."""
    done, code = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])
    assert done
    return code.tobytes()


def _check_arrays(arrays: EpisodeArrays, name: str) -> None:
    """Raise UserError if the arrays' shapes or dtypes are inconsistent."""
    rgb, depth = arrays.rgb_THWC, arrays.depth_THW
    if depth.ndim != 3 or len(depth) == 0:
        raise UserError(f"episode {name}: depth has shape {depth.shape}, expected (T, H, W).")
    frames = len(depth)
    expected = {"rgb": (*depth.shape, 3), "ids": depth.shape, **array_shapes(frames)}
    arrays_by_field = {
        "rgb": rgb,
        "ids": arrays.ids_THW,
        "intrinsics": arrays.intrinsics_4,
        "world_from_camera": arrays.world_from_camera,
        "actions": arrays.actions,
        "action_ids": arrays.action_ids,
        "states": arrays.states,
    }
    for field, array in arrays_by_field.items():
        if array is not None and not shape_fits(np.shape(array), expected[field]):
            raise UserError(
                f"episode {name}, field {field}: shape {np.shape(array)} for {frames} frames of "
                f"depth, expected {shape_text(expected[field])}; the counts do not match."
            )
    if arrays.voxels is not None:
        check_voxels(arrays.voxels, frames, f"episode {name}")
    if rgb.dtype != np.uint8:
        raise UserError(f"episode {name}, field rgb: dtype {rgb.dtype}, expected uint8 in 0…255.")
