"""LeRobot's format v3: Parquet tables, and videos of many episodes each.

::

    meta/info.json       features, number of episodes and frames, paths
         stats.json      statistics of every feature
         tasks.parquet   the text of each task
         episodes/chunk-000/file-000.parquet   rows and seconds of each episode, its statistics
    data/chunk-000/file-000.parquet            a row for each frame
    videos/KEY/chunk-000/file-000.mp4          its images

Depth is a 12-bit HEVC video without loss of the logarithm of depth from 0.01 to 10 m, as the
package ``lerobot`` 0.6 writes it; smaller, larger and missing depths are clipped, so missing depth
has code 0. The last frame of an episode has no action: zeros, and ``next.done``.
"""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pewm_jax.bodies.humanoid import BODIES
from pewm_jax.config import UserError
from pewm_jax.data.episodes import Episode
from pewm_jax.data.exports.options import Chosen, ExportConfig, require_alike
from pewm_jax.data.exports.video import GOP, open_video
from pewm_jax.io.progress import Meter

RGB, DEPTH = "observation.images.camera", "observation.images.camera_depth"
POSE, INTRINSICS = "observation.world_from_camera", "observation.camera_intrinsics"
STATE = "observation.state"
DATA_MB, VIDEO_MB, CHUNK = 100, 200, 1000
"""Largest size of a table and of a video, and number of files in a folder."""
NEAR_M, FAR_M, SHIFT_M, CODES = 0.01, 10.0, 3.5, 4095
"""Depths of the lowest and the highest code, the shift before the logarithm, and that code."""
FULL = 0.8
"""Part of the largest size from which a video is full."""
DEFAULTS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)
SAMPLED = 32
"""Frames of an episode of which the statistics of images are taken."""


def depth_codes(depth_m: np.ndarray) -> np.ndarray:
    """Return the 12-bit codes, uint16, of depths in metres."""
    low, high = math.log(NEAR_M + SHIFT_M), math.log(FAR_M + SHIFT_M)
    share = (np.log(np.maximum(depth_m, 0) + np.float32(SHIFT_M)) - low) / (high - low)
    return np.rint(share * CODES).clip(0, CODES).astype(np.uint16)


def depth_of_codes(codes: np.ndarray) -> np.ndarray:
    """Return the depths in metres, float32, of 12-bit codes."""
    low, high = math.log(NEAR_M + SHIFT_M), math.log(FAR_M + SHIFT_M)
    return (np.exp(low + codes * ((high - low) / CODES)) - SHIFT_M).astype(np.float32)


def export(config: ExportConfig, chosen: Chosen, folder: Path) -> None:
    """Write episodes into a folder.

    Raises:
        UserError: pyarrow is not installed, episodes are not alike, or images are below 16 pixels.
    """
    arrow, parquet = _arrow()
    first = next(iter(chosen))[1]
    if min(first.height, first.width) < 16:
        raise UserError(
            f"the images of {first.name} have {first.width}×{first.height} pixels, and LeRobot's "
            "depth video needs at least 16×16; collect larger ones."
        )
    with Meter(f"write {config.dst}", len(chosen), "episodes") as meter:
        tasks: dict[str, int] = {}
        rows: list[dict[str, Any]] = []
        videos = {key: _Videos(folder, key, config.fps) for key in (RGB, DEPTH)}
        tables = _Tables(folder, arrow, parquet)
        for _, episode in chosen:
            require_alike([first, episode], "LeRobot")
            task = tasks.setdefault(
                str(episode.info.get("task", episode.info.get("policy", ""))), len(tasks)
            )
            columns = _columns(episode, config.fps, len(rows), tables.frames, task)
            images = _write_images(episode, videos)
            stats = {name: _stats(x) for name, x in columns.items()} | images
            places = {**tables.add(columns)}
            for video in videos.values():
                places |= video.end(episode.length)
            name = next(text for text, number in tasks.items() if number == task)
            rows.append({
                "episode_index": len(rows), "tasks": [name], "length": episode.length, **places,
                "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0,
                **{f"stats/{key}/{stat}": value.tolist()
                   for key, own in stats.items() for stat, value in own.items()},
            })  # fmt: skip
            meter.advance(1)
        tables.close()
        for video in videos.values():
            video.close()
    _write_meta(config, chosen, folder, first, rows, tasks, videos)


def _arrow() -> tuple[Any, Any]:
    try:
        return importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise UserError(
            "LeRobot's tables need pyarrow: install it with `pip install 'pewm-jax[lerobot]'`."
        ) from None


def _columns(
    episode: Episode, fps: int, number: int, before: int, task: int
) -> dict[str, np.ndarray]:
    """Return the rows of an episode, by feature."""
    count, pose = episode.length, np.asarray(episode.world_from_camera, np.float32)
    turn = Rotation.from_matrix(np.asarray(pose[:, :3, :3], np.float64)).as_quat()
    steps = np.arange(count)
    last = steps == count - 1
    own = episode.states
    placed = np.concatenate([pose[:, :3, 3], turn], 1) if own is None else own
    columns = {
        STATE: np.asarray(placed, np.float32),
        POSE: pose.reshape(count, 16),
        INTRINSICS: np.tile(np.asarray(episode.intrinsics_4, np.float32), (count, 1)),
    }
    if episode.actions is not None:
        actions = np.asarray(episode.actions, np.float32)
        columns["action"] = np.concatenate([actions, np.zeros_like(actions[:1])])[:count]
        if len(actions) == 0:
            columns["action"] = np.zeros((count, episode.actions.shape[1]), np.float32)
    if episode.action_ids is not None:
        columns["action_id"] = np.append(episode.action_ids, -1).astype(np.int64)
    return columns | {
        "next.done": last,
        "timestamp": (steps / fps).astype(np.float32),
        "frame_index": steps,
        "episode_index": np.full(count, number),
        "index": before + steps,
        "task_index": np.full(count, task),
    }


def _write_images(episode: Episode, videos: Mapping[str, _Videos]) -> dict[str, Any]:
    """Append the images of an episode to the videos; return statistics of some of them."""
    every = max(1, episode.length // SAMPLED)
    seen: dict[str, list[np.ndarray]] = {RGB: [], DEPTH: []}
    for k in range(episode.length):
        frame = episode.frames([k])
        rgb, depth = frame.rgb_THWC[0], frame.depth_THW[0]
        videos[RGB].add(rgb)
        videos[DEPTH].add(depth_codes(depth))
        if k % every == 0:
            seen[RGB].append(rgb.reshape(-1, 3) / 255.0)
            seen[DEPTH].append(depth.reshape(-1, 1))
    found = {}
    for key, images in seen.items():
        own = _stats(np.concatenate(images))
        found[key] = {
            stat: np.array([len(images)]) if stat == "count" else value.reshape(-1, 1, 1)
            for stat, value in own.items()
        }
    return found


def _stats(values: np.ndarray) -> dict[str, np.ndarray]:
    """Return LeRobot's statistics of values (N, …) of a feature."""
    rows = np.asarray(values, np.float64).reshape(len(values), -1)
    levels = np.quantile(rows, QUANTILES, axis=0)
    return {
        "min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0),
        "count": np.array([len(rows)]),
        **{f"q{round(100 * q):02d}": level for q, level in zip(QUANTILES, levels, strict=True)},
    }  # fmt: skip


def _pooled(every: Iterable[Mapping[str, np.ndarray]]) -> dict[str, list[Any]]:
    """Return the statistics of several episodes together; quantiles are averaged."""
    every = list(every)
    counts = np.array([float(one["count"][0]) for one in every])
    weights = counts / counts.sum()

    def average(stat: str) -> np.ndarray:
        return np.tensordot(weights, np.stack([one[stat] for one in every]), 1)

    mean = average("mean")
    spread = [one["std"] ** 2 + (one["mean"] - mean) ** 2 for one in every]
    pooled = {
        "min": np.min([one["min"] for one in every], 0),
        "max": np.max([one["max"] for one in every], 0),
        "mean": mean,
        "std": np.sqrt(np.tensordot(weights, np.stack(spread), 1)),
        "count": np.array([int(counts.sum())]),
    }
    levels = (f"q{round(100 * q):02d}" for q in QUANTILES)
    return {name: x.tolist() for name, x in (pooled | {q: average(q) for q in levels}).items()}


def _number(index: int) -> dict[str, int]:
    """Return the numbers of the folder and the file of the index-th file."""
    return {"chunk_index": index // CHUNK, "file_index": index % CHUNK}


class _Videos:
    """The videos of one feature; a new one is begun between episodes when one is large."""

    def __init__(self, folder: Path, key: str, fps: int):
        self.key, self.fps, self.pix_fmt = key, fps, ""
        self._folder, self._index, self._video = folder, -1, None

    def add(self, image: np.ndarray) -> None:
        """Append a frame."""
        if self._video is None:
            self._index += 1
            at = _number(self._index)
            name = f"chunk-{at['chunk_index']:03d}/file-{at['file_index']:03d}.mp4"
            path = self._folder / "videos" / self.key / name
            path.parent.mkdir(parents=True, exist_ok=True)
            size = (image.shape[0], image.shape[1])
            self._video = open_video(path, size, self.fps, grey12=self.key == DEPTH)
            self.pix_fmt = self._video.pix_fmt
        self._video.add(image)

    def end(self, length: int) -> dict[str, Any]:
        """End an episode of a number of frames; return its place in the videos."""
        assert self._video is not None
        last = self._video.frames
        at: dict[str, float] = {**_number(self._index)}
        place = {f"videos/{self.key}/{name}": value for name, value in at.items()}
        place[f"videos/{self.key}/from_timestamp"] = (last - length) / self.fps
        place[f"videos/{self.key}/to_timestamp"] = last / self.fps
        if self._video.bytes >= VIDEO_MB * 1e6 * FULL:
            self.close()
        return place

    def close(self) -> None:
        """Finish the present video."""
        if self._video is not None:
            self._video.close()
            self._video = None


class _Tables:
    """The tables of frames, with one row group per episode."""

    def __init__(self, folder: Path, arrow: Any, parquet: Any):
        self._folder, self._arrow, self._parquet = folder, arrow, parquet
        self._index, self._writer, self._bytes, self.frames = -1, None, 0, 0

    def add(self, columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
        """Append the rows of an episode; return their place."""
        table = self._arrow.table({name: _column(self._arrow, x) for name, x in columns.items()})
        if self._writer is None or self._bytes + table.nbytes > DATA_MB * 1e6:
            self.close()
            self._index += 1
            at = _number(self._index)
            name = f"chunk-{at['chunk_index']:03d}/file-{at['file_index']:03d}.parquet"
            path = self._folder / "data" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer, self._bytes = self._parquet.ParquetWriter(path, table.schema), 0
        self._writer.write_table(table)
        self._bytes += table.nbytes
        first, self.frames = self.frames, self.frames + len(table)
        place = {f"data/{name}": value for name, value in _number(self._index).items()}
        return {**place, "dataset_from_index": first, "dataset_to_index": self.frames}

    def close(self) -> None:
        """Finish the present file."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None


def _column(arrow: Any, values: np.ndarray) -> Any:
    """Return a column: scalars, or lists of a fixed length."""
    if values.ndim == 1:
        return arrow.array(values)
    flat = arrow.array(np.ascontiguousarray(values).reshape(-1))
    return arrow.FixedSizeListArray.from_arrays(flat, values.shape[1])


NAMES = {
    STATE: ["x", "y", "z", "qx", "qy", "qz", "qw"],
    INTRINSICS: ["fx", "fy", "cx", "cy"],
}


def _features(episode: Episode, fps: int, videos: Mapping[str, _Videos]) -> dict[str, Any]:
    """Return the entries of ``features`` in ``info.json``."""
    found: dict[str, Any] = {}
    for key, channels in ((RGB, 3), (DEPTH, 1)):
        depth = key == DEPTH
        info = {
            "video.height": episode.height, "video.width": episode.width,
            "video.codec": "hevc" if depth else "h264", "video.pix_fmt": videos[key].pix_fmt,
            "video.fps": fps, "video.channels": channels, "video.g": GOP, "has_audio": False,
            "is_depth_map": depth,
        }  # fmt: skip
        if depth:
            info |= {
                "video.depth_min": NEAR_M, "video.depth_max": FAR_M, "video.shift": SHIFT_M,
                "video.use_log": True, "depth_unit": "m",
                "video.extra_options": {"x265-params": "lossless=1"},
            }  # fmt: skip
        else:
            info["intrinsics"] = np.asarray(episode.intrinsics_4, float).tolist()
        found[key] = {
            "dtype": "video",
            "shape": [episode.height, episode.width, channels],
            "names": ["height", "width", "channels"],
            "info": info,
        }
    for name, values in _columns(episode, fps, 0, 0, 0).items():
        found[name] = {
            "dtype": values.dtype.name,
            "shape": [1 if values.ndim == 1 else values.shape[1]],
            "names": None if name in DEFAULTS else NAMES.get(name),
        }
    if episode.states is not None:
        names = BODIES.get((episode.info.get("body") or {}).get("name", ""))
        found[STATE]["names"] = names and [one.name for one in names.freedoms]
    if "action" in found and found["action"]["shape"] == [3]:
        found["action"]["names"] = ["dx", "dy", "dyaw"]
    return found


def _write_meta(
    config: ExportConfig,
    chosen: Chosen,
    folder: Path,
    first: Episode,
    rows: list[dict[str, Any]],
    tasks: Mapping[str, int],
    videos: Mapping[str, _Videos],
) -> None:
    """Write ``meta/``; the tables of tasks and episodes, ``stats.json`` and ``info.json``."""
    arrow, parquet = _arrow()
    splits, begin = {}, 0
    for name, count in chosen.splits.items():
        splits[name] = f"{begin}:{begin + count}"
        begin += count
    info = {
        "codebase_version": "v3.0", "robot_type": None, "fps": config.fps,
        "total_episodes": len(rows), "total_frames": sum(row["length"] for row in rows),
        "total_tasks": len(tasks), "chunks_size": CHUNK, "data_files_size_in_mb": DATA_MB,
        "video_files_size_in_mb": VIDEO_MB, "splits": splits,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": _features(first, config.fps, videos),
    }  # fmt: skip
    keys = {name.split("/")[1] for name in rows[0] if name.startswith("stats/")}
    stats = {
        key: _pooled(
            {
                name.split("/")[2]: np.asarray(value)
                for name, value in row.items()
                if name.startswith(f"stats/{key}/")
            }
            for row in rows
        )
        for key in sorted(keys)
    }
    place = folder / "meta" / "episodes" / "chunk-000"
    place.mkdir(parents=True)
    parquet.write_table(arrow.Table.from_pylist(rows), place / "file-000.parquet")
    names = arrow.table({"task_index": list(tasks.values()), "task": list(tasks)})
    kinds = (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    columns = [
        dict(zip(("name", "field_name", "pandas_type", "numpy_type", "metadata"), row, strict=True))
        for row in ((name, name, kind, dtype, None) for name, kind, dtype in kinds)
    ]
    pandas = {  # the package reads the texts as an index of pandas
        "index_columns": ["task"], "columns": columns, "column_indexes": [],
        "creator": {"library": "pyarrow", "version": arrow.__version__}, "pandas_version": "2.0.0",
    }  # fmt: skip
    names = names.replace_schema_metadata({"pandas": json.dumps(pandas)})
    parquet.write_table(names, folder / "meta" / "tasks.parquet")
    for name, value in (("stats", stats), ("info", info)):
        (folder / "meta" / f"{name}.json").write_text(json.dumps(value, indent=4) + "\n", "utf-8")
