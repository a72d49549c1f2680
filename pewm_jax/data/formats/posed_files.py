"""Sequences whose frames are files with a number or a time in their names."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax.data.formats.reader import (
    BadFrameError,
    Load,
    Picture,
    RawSequence,
    image_size,
    numbered,
    read_colour,
    read_depth,
    read_numbers,
)

TOLERANCE_S = 0.006
"""Largest difference in time between the files of one frame, seconds."""


@dataclasses.dataclass(frozen=True)
class Files:
    """The files of one kind: their folder, and their names by the number of the frame."""

    what: str
    folder: Path
    start: str
    end: str | tuple[str, ...]

    @functools.cached_property
    def names(self) -> dict[int, str]:
        """Names by number, increasing."""
        return numbered(self.folder, self.start, self.end)

    def path(self, number: int) -> Path:
        """Return the path of a frame's file, also if it is missing."""
        if number in self.names:
            return self.folder / self.names[number]
        end = self.end if isinstance(self.end, str) else self.end[0]
        like = next(iter(self.names.values()), "").removeprefix(self.start)
        zeros = like.index(".") if like.startswith("0") and "." in like else 1
        return self.folder / f"{self.start}{number:0{zeros}d}{end}"


@dataclasses.dataclass(frozen=True)
class PosedFiles:
    """The frames of a sequence, in the order of their numbers; one file of each kind per frame."""

    colours: Files
    depths: Files
    poses: Files | None = None

    @functools.cached_property
    def numbers(self) -> list[int]:
        """Numbers of the frames: all that a file has."""
        kinds = [self.colours, self.depths, *([self.poses] if self.poses else [])]
        return sorted(set().union(*(kind.names for kind in kinds)))

    def open(
        self,
        pose_T44: np.ndarray | None,
        intrinsics: Callable[[tuple[int, int]], np.ndarray | None],
        **facts: Any,
    ) -> RawSequence:
        """Return the sequence.

        Args:
            pose_T44: camera-to-world, by the order of the frames; None if there are files of poses.
            intrinsics: returns those of the colours, whose width and height it gets.
            facts: further fields of the sequence; ``depth_intrinsics_4`` for its depth images.
        """
        faults = self._faults()
        first = next(iter(self.colours.names), None)
        size = (1, 1) if first is None else image_size(self.colours.path(first))
        depth_4 = facts.pop("depth_intrinsics_4", None)
        if pose_T44 is None:
            pose_T44 = self._read_poses(faults)

        def load(number: int) -> Picture:
            colours = read_colour(self.colours.path(number))
            return Picture(colours, read_depth(self.depths.path(number)), None, depth_4)

        def read(chosen: Sequence[int]) -> Iterator[Load]:
            return (functools.partial(load, self.numbers[k]) for k in chosen)

        def label(k: int) -> str:
            return str(self.colours.path(self.numbers[k]))

        return RawSequence(pose_T44, intrinsics(size), size, read, label, faults=faults, **facts)

    def _faults(self) -> dict[int, str]:
        """Return the frames that lack a file, with a sentence for each."""
        kinds = [self.colours, self.depths, *([self.poses] if self.poses else [])]
        counts = ", ".join(f"{len(kind.names)} {kind.what}" for kind in kinds)
        found = {}
        for k, number in enumerate(self.numbers):
            for kind in kinds:
                if number not in kind.names:
                    found[k] = f"{kind.path(number)} is missing (there are {counts})."
        return found

    def _read_poses(self, faults: dict[int, str]) -> np.ndarray:
        """Return the matrices of the files of poses; unreadable ones are added to ``faults``."""
        assert self.poses is not None
        found = np.tile(np.eye(4), (len(self.numbers), 1, 1))
        for k, number in enumerate(self.numbers):
            if number in self.poses.names:
                try:
                    found[k] = read_numbers(self.poses.path(number), 16).reshape(4, 4)
                except BadFrameError as error:
                    faults[k] = str(error)
        return found


def paired(
    frames: np.ndarray, table: dict[str, np.ndarray], seen: Sequence[int], tail: int
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the frames that have images or a row of ``table``, in order, and their rows.

    Frames that are seen and have no row get one that is not a number. Up to ``tail`` frames at the
    end that have only one of both are left out.
    """
    lost, last = np.setdiff1d(seen, frames), frames.max(initial=-1)
    if (lost > last).sum() <= tail:
        lost = lost[lost < last]
    unseen = frames > max(seen, default=-1)
    kept = ~unseen if unseen.sum() <= tail else np.ones(len(frames), bool)
    together = np.append(frames[kept], lost)
    order = np.argsort(together, kind="stable")
    gaps = np.full(len(lost), np.nan)
    rows = {name: np.append(column[kept], gaps)[order] for name, column in table.items()}
    return together[order].astype(int), rows


def by_time(folder: Path, end: str) -> dict[float, Path]:
    """Return files by the time in their names, ``SCAN_TIME.png``."""
    found = {}
    for path in folder.iterdir() if folder.is_dir() else ():
        time = path.name.removesuffix(end).rpartition("_")[2]
        if path.name.endswith(end) and time.replace(".", "", 1).isdecimal():
            found[float(time)] = path
    return found


def matched(folder: Path, end: str, times: np.ndarray) -> list[Path | None]:
    """Return the file of each time, None if none is near."""
    files = by_time(folder, end)
    there = np.array(sorted(files))
    index, fits = nearest(times, there)
    return [files[float(there[i])] if fit else None for i, fit in zip(index, fits, strict=True)]


def nearest(times: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the position of the nearest of increasing times, and whether it is near enough."""
    if not len(there):
        return np.zeros(len(times), int), np.zeros(len(times), bool)
    right = np.searchsorted(there, times).clip(0, len(there) - 1)
    left = (right - 1).clip(0)
    index = np.where(np.abs(there[left] - times) < np.abs(there[right] - times), left, right)
    return index, np.abs(there[index] - times) <= TOLERANCE_S
