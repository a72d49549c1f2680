"""NoMaD and NWM: ``SET/TRAJECTORY/{0.jpg, …, traj_data.pkl}``, a robot on the ground; no depth.

``traj_data.pkl`` is a pickled table with ``position`` (T, 2), metres, and ``yaw`` (T,), radians; it
is read without executing anything (``pewm_jax.io.pickles``).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.data.formats.options import ImportConfig
from pewm_jax.data.formats.reader import (
    Entry,
    FolderFormat,
    Load,
    Picture,
    RawSequence,
    image_size,
    numbered,
    read_colour,
)
from pewm_jax.geometry.cameras import pose_from_yaw
from pewm_jax.io import pickles
from pewm_jax.registry import register

FILE = "traj_data.pkl"
REMEDY = "only arrays of numbers are read, position and yaw: copy it again, or write them alone"
METRES_PER_STEP = {"recon": 0.25, "scand": 0.38, "tartan": 0.72, "sacson": 0.255, "huron": 0.255}
"""Words in a data set's name → length of a step of its robot, metres."""


@register("format", "nomad")
@dataclasses.dataclass(frozen=True)
class NoMaD(FolderFormat):
    """The layout of the data sets of NoMaD and NWM."""

    NAME: ClassVar[str] = "nomad"
    LAYOUT: ClassVar[str] = "folders with 0.jpg, 1.jpg, … and traj_data.pkl"
    DEPTH_SCALE: ClassVar[float | None] = None
    USES: ClassVar[tuple[str, ...]] = ("metres_per_step",)

    def found(self, folder: Path) -> str:
        """Return what shows that a folder is a trajectory."""
        return FILE if (folder / FILE).is_file() else ""

    def entry(self, folder: Path, options: ImportConfig) -> Entry:
        """Return one trajectory; its frames are those that have both an image and a position."""
        table = pickles.read(folder / FILE, REMEDY)
        position, yaw = (np.asarray(table.get(k, np.empty(0)), float) for k in ("position", "yaw"))
        yaw = yaw.reshape(-1)
        if position.ndim != 2 or position.shape[1] < 2 or len(position) != len(yaw):
            raise UserError(
                f"{folder / FILE}: position has shape {position.shape} and yaw {yaw.shape}, "
                "expected (T, 2) and (T,)."
            )
        return Entry(folder.name, len(yaw), lambda: self._open(folder, options, position, yaw))

    def _open(
        self, folder: Path, options: ImportConfig, position: np.ndarray, yaw: np.ndarray
    ) -> RawSequence:
        names = numbered(folder, "", (".jpg", ".jpeg", ".png"))
        faults = {
            k: f"{folder / f'{k}.jpg'} is missing ({len(names)} images, {len(yaw)} poses)."
            for k in range(len(yaw))
            if k not in names
        }
        if not names:
            raise UserError(f"{folder} has no images 0.jpg, 1.jpg, …")
        pose = np.full((len(yaw), 4, 4), np.nan)
        for k in np.flatnonzero(np.isfinite(position).all(1) & np.isfinite(yaw)):
            pose[k] = pose_from_yaw(np.array([*position[k, :2], 0.0]), float(yaw[k]))

        def load(k: int) -> Picture:
            return Picture(read_colour(folder / names[k]))

        def read(chosen: Sequence[int]) -> Iterator[Load]:
            return (functools.partial(load, k) for k in chosen)

        step = options.metres_per_step or self._step(folder)
        return RawSequence(
            pose,
            None,
            image_size(folder / next(iter(names.values()))),
            read,
            lambda k: str(folder / names.get(k, f"{k}.jpg")),
            None,
            faults=faults,
            info={} if step is None else {"step_m": step},
        )

    @staticmethod
    def _step(folder: Path) -> float | None:
        """Return the length of a step that the folders' names tell, None if they do not."""
        inside = folder.resolve()
        for name in (inside.parent.name.lower(), inside.name.lower(), inside.parent.parent.name):
            for word, metres in METRES_PER_STEP.items():
                if word in name:
                    return metres
        return None
