"""LeRobot v3: ``meta/``, ``data/*.parquet`` and ``videos/*.mp4``; colour, perhaps depth, actions.

Depth is a 12-bit video, quantized by the logarithm between two depths that ``info.json`` has; the
lowest code is no measurement. The format has no standard for the camera's pose and intrinsics:
features named so are used, or those that ``--pose`` and ``--intrinsics`` give.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np

from pewm_jax.config import ConfigError
from pewm_jax.data.formats import video
from pewm_jax.data.formats.lerobot_features import INFO, STATE, Features, focal_of, poses_of
from pewm_jax.data.formats.lerobot_tables import Row, Tables
from pewm_jax.data.formats.options import ImportConfig
from pewm_jax.data.formats.reader import (
    BadFrameError,
    Entry,
    Format,
    Load,
    Picture,
    RawSequence,
    decode_image,
)
from pewm_jax.registry import register


@register("format", "lerobot")
@dataclasses.dataclass(frozen=True)
class LeRobot(Format):
    """A LeRobot data set, version 3."""

    NAME: ClassVar[str] = "lerobot"
    LAYOUT: ClassVar[str] = f"{INFO}, meta/episodes/, data/ and videos/"
    CENTRES: ClassVar[str] = "half"
    DEPTH_SCALE: ClassVar[float | None] = None
    USES: ClassVar[tuple[str, ...]] = ("camera", "pose", "actions")

    def recognise(self, src: Path) -> str:
        """Return what shows that a folder is a LeRobot data set."""
        return INFO if (src / INFO).is_file() else ""

    def entries(self, options: ImportConfig) -> list[Entry]:
        """Return the episodes."""
        features = Features(options.src)
        tables = Tables(options.src, features)
        seen = _Cameras(features, tables, options)
        return [
            Entry(f"episode_{row.index:06d}", row.length, functools.partial(seen.open, row))
            for row in tables.episodes([key for key in (seen.colour, seen.depth) if key])
        ]


@dataclasses.dataclass
class _Cameras:
    """The features of a data set that are imported."""

    meta: Features
    tables: Tables
    options: ImportConfig

    def __post_init__(self) -> None:
        self.colour = self.meta.camera(self.options.camera)
        self.depth = self.meta.depth_of(self.colour)
        self.pose = self.meta.pose(self.options.pose, self.colour)
        self.intrinsics = self.meta.intrinsics(self.colour)
        self.by_state = self.options.actions == "state"
        if self.by_state and self.meta.state is None:
            raise ConfigError(
                f"--actions state: {self.meta.root} has no feature {STATE} of numbers along one "
                f"axis; it has {', '.join(self.meta.features)}."
            )

    def open(self, row: Row) -> RawSequence:
        """Return the sequence of one episode."""
        numbers = (self.pose, self.intrinsics, self.meta.action, self.meta.state)
        columns = [c for c in numbers if c]
        images = [c for c in (self.colour, self.depth) if c and not self.meta.is_video(c)]
        table = self.tables.rows(row, [*columns, "timestamp"])
        size = self.tables.image_size(row, self.colour)
        actions = table.get(self.meta.action or "")
        states = table.get(self.meta.state or "")
        states = None if states is None else states.reshape(row.length, -1)
        scale = None
        if self.depth:
            scale = self.meta.depth_codes(self.depth)[1]
        known = self.meta.fixed_intrinsics(self.colour)
        if self.intrinsics:
            known = focal_of(table[self.intrinsics][0])
        note = (
            f"the poses are those of the feature {self.pose}"
            if self.pose
            else (
                "no feature holds the camera's pose (name one with --pose): the episodes fit "
                "worlds that need no pose, such as egowm_tiny"
            )
        )
        return RawSequence(
            None if self.pose is None else poses_of(table[self.pose], self.pose),
            known,
            size,
            functools.partial(self._read, row, table["timestamp"], images),
            lambda k: f"{self.meta.root}, episode {row.index}, frame {k}",
            scale,
            actions_TA=None if actions is None else actions.reshape(row.length, -1)[:-1],
            states_TS=states,
            state_is_action=self.by_state,
            info={"task": row.task, "fps": self.meta.fps, "camera": self.colour},
            note=note,
        )

    def _read(
        self, row: Row, stamps: np.ndarray, images: list[str], chosen: Sequence[int]
    ) -> Iterator[Load]:
        """Yield a loader per frame; videos are decoded here, in order."""
        stored = self.tables.rows(row, images) if images else {}
        streams: list[Iterator[Any]] = []
        for key in (self.colour, self.depth):
            if key is None:
                streams.append(iter([None] * len(chosen)))
            elif key in images:
                streams.append(iter([stored[key][k] for k in chosen]))
            else:
                path, first = row.videos[key]
                times = [first + float(stamps[k]) for k in chosen]
                streams.append(video.frames_at(path, times, 0.5 / self.meta.fps))
        for k, colour, depth in zip(chosen, *streams, strict=True):
            yield functools.partial(self._load, k, colour, depth)

    def _load(self, k: int, colour: Any, depth: Any) -> Picture:
        def decoded(code: bytes, flags: int) -> np.ndarray:
            image = decode_image(code, flags)
            if image is None:
                raise BadFrameError(f"{self.meta.root}: image {k} does not decode; it is damaged.")
            return image

        image = (
            decoded(colour, cv2.IMREAD_COLOR) if isinstance(colour, bytes) else video.bgr(colour)
        )
        if depth is None or self.depth is None:
            return Picture(image)
        if isinstance(depth, bytes):
            return Picture(image, decoded(depth, cv2.IMREAD_UNCHANGED))
        codes = depth.to_ndarray(format="gray12le")
        return Picture(image, self.meta.depth_codes(self.depth)[0][codes.clip(0, 4095)])
