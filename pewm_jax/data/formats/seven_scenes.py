"""7-Scenes: ``seq-01/frame-000000.{color.png,depth.png,pose.txt}``, one file of each per frame.

Copies with colours as JPEG (``color.jpg``) are read, too. Depth is in millimetres, 65535 is no
measurement; poses are camera-to-world, of a world that begins at the first camera.

The images of the Kinect's two cameras are published as they are, and the poses are those of the
depth camera, whose focal length is 585 pixels at 640 × 480. Here depth is projected into the colour
camera: focal length 525 pixels, 22 mm to the right. With these values edges of depth coincide with
edges of colour in the scene redkitchen (``docs/trials.md``); scripts of others use 525 pixels and
17 to 26 mm. The centre is that of the image, and the cameras are assumed to be parallel.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from pewm_jax.data.formats.options import ImportConfig
from pewm_jax.data.formats.posed_files import Files, PosedFiles
from pewm_jax.data.formats.reader import (
    Entry,
    FolderFormat,
    Load,
    Picture,
    RawSequence,
    has_numbered,
)
from pewm_jax.registry import register

DEPTH_FOCAL, COLOUR_FOCAL, WIDTH = 585.0, 525.0, 640
"""Focal lengths of the two cameras, and the width of the published images, pixels."""
BESIDE_M = 0.022
"""Metres from the depth camera to the colour camera, to the right."""
PER_METRE = 1000.0
"""Stored depth of one metre."""
UNMEASURED = 65535
"""Stored depth of a pixel without a measurement, beside 0."""
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
        colours = self.found(folder).removeprefix("frame-*.") or COLOURS[0]
        kinds = (colours, "colour images"), ("depth.png", "depth images"), ("pose.txt", "poses")
        files = PosedFiles(*(Files(what, folder, "frame-", f".{end}") for end, what in kinds))
        per_metre = options.depth_scale or PER_METRE
        return Entry(folder.name, len(files.numbers), lambda: _registered(files, per_metre))


def _intrinsics(size: tuple[int, int]) -> np.ndarray:
    """Return the intrinsics of the colours, scaled to the width of the images."""
    focal = COLOUR_FOCAL * size[0] / WIDTH
    return np.array([focal, focal, size[0] / 2, size[1] / 2])


def _registered(files: PosedFiles, per_metre: float) -> RawSequence:
    """Return the sequence with depth as the colour camera would see it."""
    raw = files.open(None, _intrinsics)
    depth_from_colour = np.eye(4)
    depth_from_colour[0, 3] = BESIDE_M

    def load(of_both: Load) -> Picture:
        picture = of_both()
        assert picture.depth_HW is not None
        return dataclasses.replace(picture, depth_HW=to_colours(picture.depth_HW, per_metre))

    def read(chosen: Sequence[int]) -> Iterator[Load]:
        return (functools.partial(load, of_both) for of_both in raw.read(chosen))

    return dataclasses.replace(
        raw,
        read=read,
        note=f"Depth is projected into the colour camera (focal length {COLOUR_FOCAL:g} pixels at "
        f"a width of {WIDTH}, {1000 * BESIDE_M:g} mm to the right)",
        posed_from_colour_44=depth_from_colour,
    )


def to_colours(depth_HW: np.ndarray, per_metre: float = PER_METRE) -> np.ndarray:
    """Return the depth that the colour camera would see, 0 where it is not measured.

    Both images have the same size; of several pixels that fall on one the nearest counts.
    ``per_metre`` is the stored depth of one metre.
    """
    high, wide = depth_HW.shape
    rows, columns = np.nonzero((depth_HW > 0) & (depth_HW < UNMEASURED))
    depth = depth_HW[rows, columns]
    far_first = np.argsort(depth, kind="stable")[::-1]
    rows, columns, depth = rows[far_first], columns[far_first], depth[far_first]
    smaller = COLOUR_FOCAL / DEPTH_FOCAL
    parallax = BESIDE_M * COLOUR_FOCAL * wide / WIDTH / (depth / per_metre)
    x = np.floor((columns + 0.5 - wide / 2) * smaller - parallax + wide / 2).astype(int)
    y = np.floor((rows + 0.5 - high / 2) * smaller + high / 2).astype(int)
    inside = (x >= 0) & (x < wide) & (y >= 0) & (y < high)
    found = np.zeros_like(depth_HW)
    found[y[inside], x[inside]] = depth[inside]
    return found
