"""The video of a drive: a file of its own, never half-written under its name."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from pewm_jax.report.video import Film

FPS = 6
"""Steps shown a second."""


class DriveFilm:
    """A video that is being recorded; the first number that is free is its name."""

    def __init__(self, folder: Path, picture_HWC: np.ndarray):
        """Begin one.

        Args:
            folder: where it will be; made if it is not there.
            picture_HWC: its first frame, uint8.
        """
        folder.mkdir(parents=True, exist_ok=True)
        numbers = [path.stem.removeprefix("drive-") for path in folder.glob("drive-*.mp4")]
        number = 1 + max((int(text) for text in numbers if text.isdigit()), default=0)
        self._path = folder / f"drive-{number:03d}.mp4"
        self._partial = self._path.with_name(f"{self._path.name}.{os.getpid()}.partial")
        self._film = Film(str(self._partial), picture_HWC.shape[:2], FPS)
        self._film.add(picture_HWC)

    def add(self, picture_HWC: np.ndarray) -> None:
        """Add a frame."""
        self._film.add(picture_HWC)

    def close(self) -> Path:
        """End the video and return its file."""
        self._film.close()
        self._partial.replace(self._path)
        return self._path
