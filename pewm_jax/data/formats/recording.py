"""Recordings of Open3D and TUM: folders of images and a trajectory (``data/recordings.py``)."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from pewm_jax.data.formats.options import ImportConfig
from pewm_jax.data.formats.reader import (
    BadFrameError,
    Entry,
    Format,
    Load,
    Picture,
    RawSequence,
    image_size,
    read_colour,
    read_depth,
)
from pewm_jax.data.recordings import (
    COLOUR_FOLDERS,
    DEPTH_FOLDERS,
    RecordedFrame,
    read_recording,
    read_voxels,
)
from pewm_jax.registry import register


@register("format", "open3d")
@dataclasses.dataclass(frozen=True)
class Open3D(Format):
    """A folder of colour images, one of depth images, and a ``.log`` trajectory."""

    NAME: ClassVar[str] = "open3d"
    LAYOUT: ClassVar[str] = "image/ (or color/, rgb/), depth/ and a .log file"
    UP: ClassVar[str] = "-y"
    USES: ClassVar[tuple[str, ...]] = ("trajectory",)
    LAST: ClassVar[int] = 1

    def recognise(self, src: Path) -> str:
        """Return the names of the folders of images, and of the trajectory."""
        folders = [
            next((name for name in names if (src / name).is_dir()), "")
            for names in (COLOUR_FOLDERS, DEPTH_FOLDERS)
        ]
        logs = [path.name for path in sorted(src.glob("*.log"))]
        return ", ".join([*(f"{name}/" for name in folders), *logs]) if all(folders) else ""

    def entries(self, options: ImportConfig) -> list[Entry]:
        """Return the recording as one sequence."""
        frames = read_recording(options.src, options.trajectory)
        name = options.src.resolve().name
        return [Entry(name, len(frames), lambda: self._open(options.src, frames))]

    def _open(self, src: Path, frames: list[RecordedFrame]) -> RawSequence:
        def load(frame: RecordedFrame) -> Picture:
            picture = Picture(read_colour(frame.colour), read_depth(frame.depth))
            return _registered(picture, frame)

        def read(numbers: Sequence[int]) -> Iterator[Load]:
            return (functools.partial(load, frames[k]) for k in numbers)

        def voxels(numbers: Sequence[int], turn: np.ndarray) -> object:
            return read_voxels(src, [frames[k].colour for k in numbers], turn)

        return RawSequence(
            np.stack([frame.world_from_camera for frame in frames]),
            None,
            image_size(frames[0].colour),
            read,
            lambda k: str(frames[k].depth),
            self.DEPTH_SCALE,
            voxels=voxels if (src / "voxels").is_dir() else None,
        )


@register("format", "tum")
@dataclasses.dataclass(frozen=True)
class TUM(Open3D):
    """Lists of images and of poses with time stamps, as of TUM RGB-D; depth in 1/5000 m."""

    NAME: ClassVar[str] = "tum"
    LAYOUT: ClassVar[str] = "rgb.txt, depth.txt and groundtruth.txt"
    UP: ClassVar[str] = "z"
    DEPTH_SCALE: ClassVar[float | None] = 5000.0
    LAST: ClassVar[int] = 0

    def recognise(self, src: Path) -> str:
        """Return the names of the lists."""
        names = ("rgb.txt", "depth.txt", "groundtruth.txt")
        found = [name for name in names if (src / name).is_file()]
        return " and ".join(found) if len(found) >= 2 else ""


def _registered(picture: Picture, frame: RecordedFrame) -> Picture:
    """Return a frame; BadFrameError if colours and depth have different sizes."""
    assert picture.depth_HW is not None
    sizes = [image.shape[1::-1] for image in (picture.bgr_HWC, picture.depth_HW)]
    if sizes[0] != sizes[1]:
        raise BadFrameError(
            f"{frame.depth} has {sizes[1][0]}×{sizes[1][1]} pixels, {frame.colour.name} "
            f"{sizes[0][0]}×{sizes[0][1]}: colour and depth must be registered and have the same "
            "size."
        )
    return picture
