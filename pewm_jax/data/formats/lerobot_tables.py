"""The tables and files of a LeRobot data set, version 3: episodes and their rows (pyarrow)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pewm_jax.config import UserError
from pewm_jax.data.episodes import decode_image
from pewm_jax.data.formats import video
from pewm_jax.data.formats.lerobot_features import Features

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


@dataclasses.dataclass(frozen=True)
class Tables:
    """The episodes of a data set; UserError for a damaged file."""

    root: Path
    features: Features

    def episodes(self, cameras: Sequence[str]) -> list[Row]:
        """Return the episodes in order, with the files that hold them."""
        paths = sorted((self.root / "meta" / "episodes").rglob("*.parquet"))
        if not paths:
            raise UserError(f"{self.root / 'meta' / 'episodes'} has no .parquet file.")
        keys = [key for key in cameras if self.features.is_video(key)]
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
            return self.root / (self.features.info.get(kind) or default).format(**numbers, **more)

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
        if self.features.features.get(name, {}).get("dtype") == "image":
            return [
                one["bytes"] or (self.root / one["path"]).read_bytes()
                if isinstance(one, dict)
                else one
                for one in values
            ]
        return np.array(values, np.float64)

    def image_size(self, row: Row, key: str) -> tuple[int, int]:
        """Return width and height of a camera's images."""
        if self.features.is_video(key):
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
