"""Stray Scanner, an application for iPhones: ``rgb.mp4``, ``depth/``, ``odometry.csv``.

Depth is in millimetres, in smaller images than the video; ``confidence/`` has 0, 1 or 2 for each of
its pixels. A line of ``odometry.csv`` is the camera-to-world pose of one frame of the video, in the
axes of OpenCV; the world's y points up. A held phone sees its images lying on their side: they are
turned upright. ``camera_matrix.csv`` has the intrinsics of the video; newer versions write those of
each frame into ``odometry.csv``.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from pewm_jax.config import UserError
from pewm_jax.data.formats import video
from pewm_jax.data.formats.options import ImportConfig
from pewm_jax.data.formats.posed_files import Files, paired
from pewm_jax.data.formats.reader import (
    BadFrameError,
    Entry,
    FolderFormat,
    Load,
    Picture,
    RawSequence,
    read_depth,
    read_numbers,
    read_table,
)
from pewm_jax.registry import register

COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
FOCAL = ("fx", "fy", "cx", "cy")
TAIL = 2
"""Frames at the end of a recording that may lack their counterpart."""


@register("format", "stray")
@dataclasses.dataclass(frozen=True)
class Stray(FolderFormat):
    """The layout of Stray Scanner."""

    NAME: ClassVar[str] = "stray"
    LAYOUT: ClassVar[str] = "rgb.mp4, depth/, odometry.csv and camera_matrix.csv"
    UP: ClassVar[str] = "y"
    CENTRES: ClassVar[str] = "half"
    SIDEWAYS: ClassVar[bool] = True
    USES: ClassVar[tuple[str, ...]] = ("min_confidence",)

    def found(self, folder: Path) -> str:
        """Return what shows that a folder is a recording."""
        there = all((folder / name).is_file() for name in ("rgb.mp4", "odometry.csv"))
        return "rgb.mp4 and odometry.csv" if there else ""

    def entry(self, folder: Path, options: ImportConfig) -> Entry:
        """Return the sequence of one recording."""
        table = _odometry(folder / "odometry.csv")
        depths = Files("depth images", folder / "depth", "", (".png", ".npy"))
        times = video.frame_times(folder / "rgb.mp4")
        frames = table.get("frame", np.arange(len(table["x"]))).astype(int)
        seen = [k for k in depths.names if k < len(times)]
        frames, table = paired(frames, table, seen, TAIL)
        recording = _Recording(folder, options, table, frames, depths, times)
        return Entry(folder.resolve().name, len(frames), recording.open)


@dataclasses.dataclass(frozen=True)
class _Recording:
    folder: Path
    options: ImportConfig
    table: dict[str, np.ndarray]
    frames: np.ndarray
    depths: Files
    times: np.ndarray

    def open(self) -> RawSequence:
        """Return the sequence."""
        path = self.folder / "rgb.mp4"
        counts = (
            f"{len(self.depths.names)} depth images, {np.isfinite(self.table['x']).sum()} poses"
        )
        counts = f"there are {len(self.times)} frames in rgb.mp4, {counts}"
        faults = {}
        for k, number in enumerate(self.frames):
            if number >= len(self.times):
                faults[k] = f"{path} has no frame {number} ({counts})."
            elif number not in self.depths.names:
                faults[k] = f"{self.depths.path(number)} is missing ({counts})."
        rows = np.stack([self.table[name] for name in COLUMNS], -1)
        known = np.isfinite(rows).all(1) & (np.linalg.norm(rows[:, 3:], axis=1) > 0.5)
        pose = np.full((len(rows), 4, 4), np.nan)
        pose[known] = np.eye(4)
        pose[known, :3, :3] = Rotation.from_quat(rows[known, 3:]).as_matrix()
        pose[known, :3, 3] = rows[known, :3]
        own = None
        if set(FOCAL) <= self.table.keys() and self.options.intrinsics is None:
            own = np.stack([self.table[name] for name in FOCAL], -1)
        return RawSequence(
            pose,
            np.nanmedian(own, 0) if own is not None else self._matrix(),
            video.video_size(path),
            functools.partial(self._read, own),
            lambda k: f"{path}, frame {self.frames[k]}",
            faults=faults,
        )

    def _matrix(self) -> np.ndarray | None:
        """Return the intrinsics of ``camera_matrix.csv``; None if there is no such file."""
        path = self.folder / "camera_matrix.csv"
        if not path.is_file():
            return None
        fx, _, cx, _, fy, cy, *_ = read_numbers(path, 9, ",")
        return np.array([fx, fy, cx, cy])

    def _read(self, own: np.ndarray | None, chosen: Sequence[int]) -> Iterator[Load]:
        numbers = self.frames[list(chosen)]
        shown = video.frames_at(self.folder / "rgb.mp4", list(self.times[numbers]), 1e-4)
        for k, number, frame in zip(chosen, numbers, shown, strict=True):
            yield functools.partial(self._load, frame, int(number), None if own is None else own[k])

    def _load(self, frame: Any, number: int, own: np.ndarray | None) -> Picture:
        path = self.depths.path(number)
        try:
            depth = np.load(path, allow_pickle=False) if path.suffix == ".npy" else read_depth(path)
        except (OSError, ValueError, EOFError) as error:
            raise BadFrameError(f"{path} cannot be read as an array ({error}).") from None
        trust = self.folder / "confidence" / f"{path.stem}.png"
        if self.options.min_confidence > 0 and trust.is_file():
            kept = read_depth(trust) >= self.options.min_confidence
            if kept.shape != depth.shape:
                raise BadFrameError(f"{trust} has another size than {path}.")
            depth = np.where(kept, depth, depth.dtype.type(0))
        return Picture(video.bgr(frame), depth, own)


def _odometry(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of the file by name; old versions have no heading and 7 columns."""
    with path.open(encoding="utf-8", errors="replace") as file:
        names = [word.strip().lower() for word in file.readline().split(",")]
    if not names[0][:1].isalpha():
        names = list(COLUMNS) if len(names) == len(COLUMNS) else ["timestamp", "frame", *COLUMNS]
    if not set(COLUMNS) <= set(names):
        raise UserError(f"{path} lacks one of the columns {', '.join(COLUMNS)}.")
    return dict(zip(names, read_table(path, len(names), ",").T, strict=True))
