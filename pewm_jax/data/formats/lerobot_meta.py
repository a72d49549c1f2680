"""The tables of a LeRobot data set, version 3: features, episodes, rows; read with pyarrow."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pewm_jax.config import ConfigError, UserError
from pewm_jax.data.episodes import SATURATED, decode_image
from pewm_jax.data.formats import video

INFO = "meta/info.json"
CODES = 4096
"""Number of depth codes; the lowest and the highest are no measurement."""
POSES = ("world_from_camera", "camera_to_world", "camera_pose", "pose")
"""Ends of the names of features that hold the camera's pose."""
DEFAULT_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DEFAULT_VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"


@dataclasses.dataclass(frozen=True)
class Row:
    """One episode: number, frames, task, file of its rows, file and start time of each video."""

    index: int
    length: int
    task: str
    data: Path
    videos: Mapping[str, tuple[Path, float]]


class Meta:
    """The features of a data set; UserError for a damaged file or another version."""

    def __init__(self, root: Path):
        self.root = root
        path = root / INFO
        try:
            self.info = json.loads(path.read_text("utf-8"))
            self.features: dict[str, dict[str, Any]] = dict(self.info["features"])
            self.fps = float(self.info["fps"])
            version = str(self.info["codebase_version"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"{path} does not have LeRobot's entries ({error!r}).") from None
        if not version.startswith("v3."):
            raise UserError(
                f"{path} has version {version}, and v3 is read: convert the data set with "
                "LeRobot's script convert_dataset_v21_to_v30."
            )
        self.action = "action" if "action" in self.features else None

    def is_video(self, key: str) -> bool:
        """Tell whether a feature is stored as a video."""
        return self.features[key]["dtype"] == "video"

    def _about(self, key: str) -> dict[str, Any]:
        own = self.features[key]
        return {**(own.get("video_info") or {}), **(own.get("info") or {})}

    def _is_depth(self, key: str) -> bool:
        about = self._about(key)
        return bool(about.get("is_depth_map") or about.get("video.is_depth_map"))

    def _images(self, depth: bool) -> list[str]:
        kinds = ("video", "image")
        keys = [key for key, own in self.features.items() if own.get("dtype") in kinds]
        return [key for key in keys if self._is_depth(key) == depth]

    def camera(self, wanted: str | None) -> str:
        """Return the feature of the colour images; ``wanted`` may be the end of its name."""
        known = self._images(depth=False)
        found = [k for k in known if wanted in (None, k) or k.endswith(f".{wanted}")]
        if not found:
            what = "has no colour images" if wanted is None else f"has no camera {wanted!r}"
            raise ConfigError(f"{self.root} {what}; its cameras are {', '.join(known) or 'none'}.")
        return found[0]

    def depth_of(self, camera: str) -> str | None:
        """Return the feature of the depth images of a camera: of the most similar name."""

        def shared(key: str) -> int:
            same = (a == b for a, b in zip(key, camera, strict=False))
            return next((k for k, equal in enumerate(same) if not equal), len(camera))

        known = self._images(depth=True)
        stem = camera.rpartition(".")[2]
        named = [key for key in known if key.rpartition(".")[2].startswith(stem)]
        others = [key for key in self._images(depth=False) if key != camera]
        if not named and others:  # the depth may belong to another camera
            return None
        return max(named or known, key=shared, default=None)

    def pose(self, wanted: str | None) -> str | None:
        """Return the feature of the camera's pose, None if no name tells one."""
        if wanted is not None:
            if wanted not in self.features:
                raise ConfigError(
                    f"--pose {wanted}: {self.root} has no such feature; it has "
                    f"{', '.join(self.features)}."
                )
            return wanted
        for end in POSES:
            for key, own in self.features.items():
                if key.endswith(end) and math.prod(own.get("shape") or [0]) in (7, 12, 16):
                    return key
        return None

    def intrinsics(self) -> str | None:
        """Return the feature of the camera's intrinsics, 4 numbers or a matrix; or None."""
        for key, own in self.features.items():
            if "intrinsics" in key and math.prod(own.get("shape") or [0]) in (4, 9):
                return key
        return None

    def fixed_intrinsics(self, camera: str) -> np.ndarray | None:
        """Return intrinsics that ``info.json`` has for a camera, or None."""
        values = self._about(camera).get("intrinsics")
        known = isinstance(values, list) and len(values) == 4
        return np.array(values, np.float64) if known else None

    @functools.lru_cache(maxsize=4)  # noqa: B019 - few, and they live as long as an import
    def depth_codes(self, key: str) -> tuple[np.ndarray, float]:
        """Return the stored depth (4096,) uint16 of each code, and the value of one metre."""
        about = self._about(key)
        if not self.is_video(key):
            return np.zeros(0, np.uint16), 1.0 if about.get("depth_unit") == "m" else 1000.0
        low, high = (
            float(about.get(f"video.depth_{e}", d)) for e, d in (("min", 0.01), ("max", 10))
        )
        shift, log = float(about.get("video.shift", 3.5)), about.get("video.use_log", True)
        share = np.arange(CODES) / (CODES - 1)
        if log:
            ends = np.log([low + shift, high + shift])
            metres = np.exp(ends[0] + share * (ends[1] - ends[0])) - shift
        else:
            metres = low + share * (high - low)
        per_metre = float(math.floor((SATURATED - 1) / high))
        stored = np.rint(metres * per_metre)
        stored[[0, -1]] = 0
        return stored.astype(np.uint16), per_metre

    def episodes(self, cameras: Sequence[str]) -> list[Row]:
        """Return the episodes in order, with the files that hold them."""
        paths = sorted((self.root / "meta" / "episodes").rglob("*.parquet"))
        if not paths:
            raise UserError(f"{self.root / 'meta' / 'episodes'} has no .parquet file.")
        keys = [key for key in cameras if self.is_video(key)]
        parts = [
            f"videos/{k}/{n}" for k in keys for n in ("chunk_index", "file_index", "from_timestamp")
        ]
        names = ["episode_index", "length", "data/chunk_index", "data/file_index", *parts]
        found = []
        for path in paths:
            table = _table(path, names, optional=("tasks",))
            found += [self._row(one, keys) for one in table.to_pylist()]
        return sorted(found, key=lambda row: row.index)

    def _row(self, one: dict[str, Any], keys: Sequence[str]) -> Row:
        def path(kind: str, start: str, default: str, **more: str) -> Path:
            numbers = {n: one[f"{start}/{n}"] for n in ("chunk_index", "file_index")}
            return self.root / (self.info.get(kind) or default).format(**numbers, **more)

        videos = {
            key: (
                path("video_path", f"videos/{key}", DEFAULT_VIDEO, video_key=key),
                float(one[f"videos/{key}/from_timestamp"]),
            )
            for key in keys
        }
        tasks = one.get("tasks") or [""]
        task = tasks if isinstance(tasks, str) else str(tasks[0])
        data = path("data_path", "data", DEFAULT_DATA)
        return Row(int(one["episode_index"]), int(one["length"]), task, data, videos)

    def rows(self, row: Row, columns: Sequence[str]) -> dict[str, Any]:
        """Return columns of an episode's rows by name: arrays (T, …), or T encoded images."""
        wanted = list(dict.fromkeys(columns))
        table = _table(row.data, [*wanted, "frame_index"], episode=row.index)
        table = table.sort_by("frame_index")
        if len(table) != row.length:
            raise UserError(
                f"{row.data} has {len(table)} rows of episode {row.index}, but meta/episodes lists "
                f"{row.length}: the data set is incomplete, copy it again."
            )
        return {name: self._column(table[name].to_pylist(), name) for name in wanted}

    def _column(self, values: list[Any], name: str) -> Any:
        if self.features.get(name, {}).get("dtype") == "image":
            return [
                one["bytes"] or (self.root / one["path"]).read_bytes()
                if isinstance(one, dict)
                else one
                for one in values
            ]
        return np.array(values, np.float64)

    def image_size(self, row: Row, key: str) -> tuple[int, int]:
        """Return width and height of a camera's images."""
        if self.is_video(key):
            return video.video_size(row.videos[key][0])
        image = decode_image(self.rows(row, [key])[key][0], cv2.IMREAD_COLOR)
        if image is None:
            raise UserError(f"{row.data}: the first image of {key} does not decode.")
        return image.shape[1], image.shape[0]


def _table(
    path: Path, columns: Sequence[str], *, optional: Sequence[str] = (), episode: int = -1
) -> Any:
    """Read columns of a Parquet file, of one episode or of all."""
    try:
        import pyarrow as pa  # noqa: PLC0415 - optional
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError:
        raise UserError(
            "LeRobot's tables need pyarrow: install it with `pip install 'pewm-jax[lerobot]'`."
        ) from None
    try:
        known = parquet.read_schema(path).names
        missing = [name for name in columns if name not in known]
        if missing:
            raise UserError(f"{path} has no column {missing[0]}; the data set is damaged.")
        chosen = [*columns, *(name for name in optional if name in known)]
        rows = None if episode < 0 else [("episode_index", "==", episode)]
        return parquet.read_table(path, columns=chosen, filters=rows)
    except (OSError, pa.ArrowException) as error:
        reason = " ".join(str(error).split())[:120]
        raise UserError(f"{path} cannot be read as Parquet ({reason}); copy it again.") from None
