"""7-Scenes: ``seq-01/frame-000000.{color.png,depth.png,pose.txt}``, one file of each per frame.

Copies with colours as JPEG (``color.jpg``) are read, too. Depth is in millimetres, 65535 is no
measurement; poses are camera-to-world, of a world that begins at the first camera. The
focal length is 585 pixels at 640 × 480, the centre that of the image.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import ClassVar

import numpy as np

from pewm_jax.data.formats.options import ImportConfig
from pewm_jax.data.formats.posed_files import Files, PosedFiles
from pewm_jax.data.formats.reader import Entry, FolderFormat, has_numbered
from pewm_jax.registry import register

FOCAL, WIDTH = 585.0, 640
"""Focal length of the published images, and their width, pixels."""
COLOURS = "color.png", "color.jpg"
"""Endings of colour images: those of the data set, and of copies."""


@register("format", "7scenes")
@dataclasses.dataclass(frozen=True)
class SevenScenes(FolderFormat):
    """The layout of 7-Scenes."""

    NAME: ClassVar[str] = "7scenes"
    LAYOUT: ClassVar[str] = "frame-000000.color.png or .jpg, .depth.png, .pose.txt, as in seq-01/"
    UP: ClassVar[str] = "-y"
    CENTRES: ClassVar[str] = "half"

    def found(self, folder: Path) -> str:
        """Return what shows that a folder is a sequence."""
        ends = (end for end in COLOURS if has_numbered(folder, "frame-", f".{end}"))
        return next((f"frame-*.{end}" for end in ends), "")

    def entry(self, folder: Path, options: ImportConfig) -> Entry:
        """Return the sequence of one folder."""
        del options
        colours = self.found(folder).removeprefix("frame-*.") or COLOURS[0]
        kinds = (colours, "colour images"), ("depth.png", "depth images"), ("pose.txt", "poses")
        files = PosedFiles(*(Files(what, folder, "frame-", f".{end}") for end, what in kinds))
        return Entry(folder.name, len(files.numbers), lambda: files.open(None, _intrinsics))


def _intrinsics(size: tuple[int, int]) -> np.ndarray:
    """Return the published intrinsics, scaled to the width of the images."""
    focal = FOCAL * size[0] / WIDTH
    return np.array([focal, focal, size[0] / 2, size[1] / 2])
