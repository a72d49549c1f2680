"""Replica in the layout of NICE-SLAM: ``results/{frame,depth}000000.*`` and ``traj.txt``.

A line of ``traj.txt`` is a 4×4 camera-to-world matrix, row by row; depth is in 1/6553.5 m. The
images are 1200 × 680 with focal length 600 and centre (599.5, 339.5), pixel centres at integers;
``cam_params.json`` beside the rooms has these numbers too, and is read if it is there.
"""

from __future__ import annotations

import dataclasses
import json
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
    read_table,
)
from pewm_jax.registry import register

PUBLISHED = {"w": 1200, "h": 680, "fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5}
"""The camera of the published images."""
SCALE = 6553.5
"""Stored depth of one metre."""


@register("format", "replica")
@dataclasses.dataclass(frozen=True)
class Replica(FolderFormat):
    """The layout of Replica's rooms as rendered for NICE-SLAM."""

    NAME: ClassVar[str] = "replica"
    LAYOUT: ClassVar[str] = "results/frame*.jpg, results/depth*.png and traj.txt"
    DEPTH_SCALE: ClassVar[float | None] = SCALE

    def found(self, folder: Path) -> str:
        """Return what shows that a folder is a room."""
        frames = has_numbered(folder / "results", "frame", (".jpg", ".png"))
        there = frames and (folder / "traj.txt").is_file()
        return "results/frame*.jpg and traj.txt" if there else ""

    def entry(self, folder: Path, options: ImportConfig) -> Entry:
        """Return the sequence of one room."""
        del options
        results = folder / "results"
        files = PosedFiles(
            Files("colour images", results, "frame", (".jpg", ".png")),
            Files("depth images", results, "depth", ".png"),
        )
        return Entry(folder.name, len(files.numbers), lambda: self._open(folder, files))

    def _open(self, folder: Path, files: PosedFiles) -> RawSequence:
        rows = read_table(folder / "traj.txt", 16).reshape(-1, 4, 4)
        needed = max(files.numbers) + 1
        if len(rows) < needed:
            raise UserError(
                f"{folder / 'traj.txt'} has {len(rows)} poses, but results/ has a frame "
                f"{needed - 1}: there must be a line for each frame, counted from 0."
            )
        camera, scale = _camera(folder)

        def intrinsics(size: tuple[int, int]) -> np.ndarray:
            """Return the intrinsics, scaled if the images have another size."""
            across, down = size[0] / camera["w"], size[1] / camera["h"]
            centre = (camera["cx"] + 0.5) * across, (camera["cy"] + 0.5) * down
            return np.array([camera["fx"] * across, camera["fy"] * down, *centre])

        return files.open(rows[files.numbers], intrinsics, depth_scale=scale)


def _camera(folder: Path) -> tuple[dict[str, float], float]:
    """Return the camera and the depth scale, of ``cam_params.json`` or as published."""
    for path in (folder / "cam_params.json", folder.parent / "cam_params.json"):
        if path.is_file():
            try:
                found = json.loads(path.read_text("utf-8"))["camera"]
                camera = {name: float(found[name]) for name in PUBLISHED}
                return camera, float(found.get("scale", SCALE))
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                raise UserError(f"{path} does not have the camera's numbers ({error!r}).") from None
    return dict(PUBLISHED), SCALE
