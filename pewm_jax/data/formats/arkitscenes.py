"""ARKitScenes: ``lowres_wide/``, ``lowres_depth/``, ``lowres_wide_intrinsics/``, ``.traj``.

Files are named by scan and time, ``40753679_6791.113.png``. Depth is in millimetres. A ``.pincam``
has width, height, fx, fy, cx, cy. A line of the ``.traj`` has the time, the rotation as an axis
times its angle, and the translation of *world to camera*; z is up. A held phone sees its images
lying on their side: they are turned upright.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from pewm_jax.config import UserError
from pewm_jax.data.formats.options import ImportConfig
from pewm_jax.data.formats.posed_files import TOLERANCE_S, by_time, matched, nearest
from pewm_jax.data.formats.reader import (
    BadFrameError,
    Entry,
    FolderFormat,
    Load,
    Picture,
    RawSequence,
    image_size,
    read_colour,
    read_depth,
    read_numbers,
    read_table,
)
from pewm_jax.registry import register


@register("format", "arkitscenes")
@dataclasses.dataclass(frozen=True)
class ARKitScenes(FolderFormat):
    """The low-resolution stream of ARKitScenes."""

    NAME: ClassVar[str] = "arkitscenes"
    LAYOUT: ClassVar[str] = "lowres_wide/, lowres_depth/, lowres_wide_intrinsics/ and a .traj"
    CENTRES: ClassVar[str] = "half"
    SIDEWAYS: ClassVar[bool] = True
    USES: ClassVar[tuple[str, ...]] = ("min_confidence",)

    def found(self, folder: Path) -> str:
        """Return what shows that a folder is a scan."""
        there = (folder / "lowres_wide").is_dir() and (folder / "lowres_depth").is_dir()
        return "lowres_wide/ and lowres_depth/" if there else ""

    def entry(self, folder: Path, options: ImportConfig) -> Entry:
        """Return the sequence of one scan; its frames are the colour images."""
        images = by_time(folder / "lowres_wide", ".png")
        trajectory = read_table(_trajectory(folder), 7)
        times = np.array(sorted(images))
        _, has_pose = nearest(times, trajectory[:, 0])
        if has_pose.mean() < 0.6 and len(times):  # images at 60 Hz, poses at 10 Hz
            times = times[has_pose]
        name = folder.resolve().name.removesuffix("_frames")
        if not len(times):
            raise UserError(f"{folder} has no image at the time of a pose of its .traj file.")
        return Entry(name, len(times), lambda: _open(folder, times, images, trajectory, options))


def _open(
    folder: Path,
    times: np.ndarray,
    images: dict[float, Path],
    trajectory: np.ndarray,
    options: ImportConfig,
) -> RawSequence:
    colours = [images[time] for time in times]
    depths, cameras, trust = (
        matched(folder / name, end, times)
        for name, end in (
            ("lowres_depth", ".png"),
            ("lowres_wide_intrinsics", ".pincam"),
            ("confidence", ".png"),
        )
    )
    size = image_size(colours[0])
    faults = {
        k: f"{colours[k]} has no depth image within {TOLERANCE_S} s in lowres_depth/."
        for k, path in enumerate(depths)
        if path is None
    }
    own = np.full((len(times), 4), np.nan)
    for k, path in enumerate(cameras if options.intrinsics is None else []):
        try:
            own[k] = _pincam(
                path or folder / "lowres_wide_intrinsics" / f"{colours[k].stem}.pincam", size
            )
        except BadFrameError as error:
            faults.setdefault(k, str(error))

    def load(k: int) -> Picture:
        depth = read_depth(depths[k] or Path())
        kept = trust[k]
        if kept is not None and options.min_confidence > 0:
            depth = np.where(read_depth(kept) < options.min_confidence, depth.dtype.type(0), depth)
        given = options.intrinsics is not None
        return Picture(read_colour(colours[k]), depth, None if given else own[k])

    def read(chosen: Sequence[int]) -> Iterator[Load]:
        return (functools.partial(load, k) for k in chosen)

    known = np.isfinite(own).all(1)
    return RawSequence(
        _poses(times, trajectory),
        np.median(own[known], 0) if known.any() else None,
        size,
        read,
        lambda k: str(colours[k]),
        faults=faults,
    )


def _trajectory(folder: Path) -> Path:
    for path in (folder / "lowres_wide.traj", *sorted(folder.glob("*.traj"))):
        if path.is_file():
            return path
    raise UserError(f"{folder} has no .traj file; it has the poses of lowres_wide/.")


def _poses(times: np.ndarray, trajectory: np.ndarray) -> np.ndarray:
    """Return camera-to-world poses (T, 4, 4), not a number where the trajectory has none."""
    order = trajectory[np.argsort(trajectory[:, 0], kind="stable")]
    index, fits = nearest(times, order[:, 0])
    rows = order[index, 1:]
    fits &= np.isfinite(rows).all(1)
    pose = np.full((len(times), 4, 4), np.nan)
    pose[fits] = np.eye(4)
    rotation = Rotation.from_rotvec(rows[fits, :3]).as_matrix().swapaxes(1, 2)  # camera to world
    pose[fits, :3, :3] = rotation
    pose[fits, :3, 3] = -(rotation @ rows[fits, 3:, None])[..., 0]
    return pose


def _pincam(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Return fx, fy, cx, cy, scaled if the file is for images of another size."""
    width, height, *focal = read_numbers(path, 6)
    if min(width, height) < 1:
        raise BadFrameError(f"{path} is for images of {width:g}×{height:g} pixels.")
    return np.array(focal) * np.tile([size[0] / width, size[1] / height], 2)
