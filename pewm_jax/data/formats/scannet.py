"""ScanNet, exported by its SensReader: ``color/N.jpg``, ``depth/N.png``, ``pose/N.txt``.

Depth is in millimetres, poses are camera-to-world, −inf where tracking was lost. ``intrinsic/`` has
a 4×4 matrix for the colours and one for the depth images, which are smaller.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import ClassVar

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.data.formats.options import ImportConfig
from pewm_jax.data.formats.posed_files import Files, PosedFiles
from pewm_jax.data.formats.reader import (
    Entry,
    FolderFormat,
    RawSequence,
    has_numbered,
    read_numbers,
)
from pewm_jax.registry import register

CENTRE = np.array([0, 0, 0.5, 0.5])
"""From centres of pixels at integers to ours."""


@register("format", "scannet")
@dataclasses.dataclass(frozen=True)
class ScanNet(FolderFormat):
    """The layout of ScanNet's exported folders."""

    NAME: ClassVar[str] = "scannet"
    LAYOUT: ClassVar[str] = "color/N.jpg, depth/N.png, pose/N.txt and intrinsic/"

    def found(self, folder: Path) -> str:
        """Return what shows that a folder is a scan."""
        there = has_numbered(folder / "pose", "", ".txt") and (folder / "color").is_dir()
        return "color/, depth/ and pose/*.txt" if there else ""

    def entry(self, folder: Path, options: ImportConfig) -> Entry:
        """Return the sequence of one scan."""
        given = options.intrinsics is not None
        files = PosedFiles(
            Files("colour images", folder / "color", "", (".jpg", ".png")),
            Files("depth images", folder / "depth", "", ".png"),
            Files("poses", folder / "pose", "", ".txt"),
        )
        inside = folder.resolve()
        name = inside.parent.name if inside.name == "frames" else inside.name
        return Entry(name, len(files.numbers), lambda: self._open(folder, files, given))

    def _open(self, folder: Path, files: PosedFiles, given: bool) -> RawSequence:
        colours_4, depth_4 = (_intrinsics(folder, kind) for kind in ("color", "depth"))
        if colours_4 is None and not given:
            raise UserError(
                f"{folder} has no intrinsic/intrinsic_color.txt: export the intrinsics as well, or "
                "give --intrinsics."
            )
        return files.open(None, lambda _: colours_4, depth_intrinsics_4=depth_4)


def _intrinsics(folder: Path, kind: str) -> np.ndarray | None:
    """Return fx, fy, cx, cy with centres at +0.5; None if there is no file."""
    for inside in (folder / "intrinsic", folder, folder.parent / "intrinsic"):
        path = inside / f"intrinsic_{kind}.txt"
        if path.is_file():
            matrix = read_numbers(path, 16).reshape(4, 4)
            return np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]) + CENTRE
    return None
