"""Splits on disk: ArrayRecord shards, and ``dataset.json``, which is written last.

A split folder without ``dataset.json`` is unfinished and is never read. ``dataset.json`` lists
every shard with its number of records, size and SHA-256, so opening a split detects truncated
shards.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import array_record.python.array_record_module as array_file
from grain import sources

from pewm_jax.config import UserError
from pewm_jax.data.episodes import Episode, read_episode
from pewm_jax.data.record_format import VERSION, DamagedError
from pewm_jax.io import atomic, store

MANIFEST = "dataset.json"
UNFINISHED = "collecting.json"
"""File in an unfinished split folder, with the split's settings."""


@dataclasses.dataclass(frozen=True)
class Shard:
    """One file of a split: its name there, its number of episodes, its size, its hash."""

    file: str
    records: int
    bytes: int
    sha256: str


@dataclasses.dataclass(frozen=True)
class Manifest:
    """The content of ``dataset.json``.

    Attributes:
        split: name of the split.
        shards: its files, in reading order.
        settings: the settings with which the split was made.
        frames: total number of frames.
    """

    split: str
    shards: tuple[Shard, ...]
    settings: Mapping[str, Any]
    frames: int

    @property
    def records(self) -> int:
        """Return the number of episodes."""
        return sum(shard.records for shard in self.shards)


def write_shard(path: Path, records: Iterable[bytes]) -> Shard:
    """Write records to an ArrayRecord file atomically; UserError if that fails (a full disk)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic.replacing(path) as partial:
        # Images are compressed already; with one record per group, reading a single one is cheap.
        with _refused_writes(path):
            writer = array_file.ArrayRecordWriter(str(partial), "group_size:1,uncompressed")
        try:
            for record in records:
                with _refused_writes(path):
                    writer.write(record)
                del record  # before the next one is made
        finally:
            with _refused_writes(path):
                writer.close()
        with partial.open("rb") as file:
            os.fsync(file.fileno())
    return describe_shard(path)


@contextlib.contextmanager
def _refused_writes(path: Path) -> Iterator[None]:
    """Raise ArrayRecord's write errors as a ``UserError``."""
    try:
        yield
    except RuntimeError as error:
        free = shutil.disk_usage(path.parent).free / 1e6
        raise UserError(
            f"{path} cannot be written ({_first_line(error)}); {free:.0f} MB are free there: free "
            "some space, or check the folder's quota and permissions, then run the same command "
            "again."
        ) from None


def describe_shard(path: Path) -> Shard:
    """Return a shard's number of records, size and hash."""
    return Shard(path.name, count_records(path), path.stat().st_size, store.file_hash(path))


def count_records(path: Path) -> int:
    """Return the number of records; UserError for a truncated file, or one of another kind."""
    state = "it is truncated or damaged"
    with _opened(path, f"{path} is not a readable ArrayRecord file", state) as reader:
        count = reader.num_records()
    if count == 0:
        raise UserError(f"{path} holds no readable record: {state}, delete it and make it again.")
    return count


def read_record(path: Path, index: int) -> bytes:
    """Read one record of an ArrayRecord file; UserError if it cannot be read."""
    failure = f"{path}, record {index} cannot be read"
    with _opened(path, failure, "the file is damaged") as reader:
        return reader.read([index])[0]


@contextlib.contextmanager
def _opened(path: Path, failure: str, state: str) -> Iterator[Any]:
    """Open an ArrayRecord file; raise its errors as a ``UserError``."""
    reader = None
    try:
        reader = array_file.ArrayRecordReader(str(path))
        yield reader
    except (RuntimeError, ValueError, IndexError) as error:
        raise UserError(
            f"{failure} ({_first_line(error)}); {state}, delete it and make it again."
        ) from None
    finally:
        if reader is not None:
            with contextlib.suppress(RuntimeError, ValueError):
                reader.close()


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0]


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_text(path, json.dumps(value, indent=2, ensure_ascii=False) + "\n")


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write ``dataset.json``, which makes a split readable."""
    value = {
        "format": "pewm-dataset",
        "version": VERSION,
        "split": manifest.split,
        "records": manifest.records,
        "frames": manifest.frames,
        "settings": dict(manifest.settings),
        "shards": [dataclasses.asdict(shard) for shard in manifest.shards],
    }
    write_json(folder / MANIFEST, value)


def read_manifest(folder: Path, check_files: bool = True) -> Manifest:
    """Read ``dataset.json`` and check the shards' sizes (``validate`` also checks hashes).

    Raises:
        UserError: the folder does not exist, the split is unfinished, or a shard is missing or
            truncated.
    """
    path = folder / MANIFEST
    if not folder.is_dir():
        raise UserError(
            f"{folder} does not exist; make it with `pewm-jax data collect` or `pewm-jax data "
            "import`."
        )
    if not path.is_file():
        inside = splits(folder)
        hint = (
            f"it contains the splits {', '.join(inside)}; choose one of them"
            if inside
            else "the collection did not finish, run the same command again to resume it"
        )
        raise UserError(f"{folder} has no {MANIFEST}: {hint}.")
    try:
        value = json.loads(path.read_text("utf-8"))
        manifest = Manifest(
            split=value["split"],
            shards=tuple(Shard(**shard) for shard in value["shards"]),
            settings=value["settings"],
            frames=value["frames"],
        )
        version = value["version"]
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        raise UserError(f"{path} does not parse ({error!r}); make the split again.") from None
    if version != VERSION:
        raise UserError(
            f"{path} has format version {version}, this library reads version {VERSION}; make the "
            "split again."
        )
    for shard in manifest.shards if check_files else ():
        check_size(folder / shard.file, shard)
    return manifest


def check_size(path: Path, shard: Shard) -> None:
    """Raise UserError if a file is missing or does not have the size listed for its shard."""
    if not path.is_file():
        raise UserError(f"{path} is missing but {MANIFEST} lists it; make the split again.")
    size = path.stat().st_size
    if size != shard.bytes:
        raise UserError(
            f"{path} has {size} bytes but {MANIFEST} lists {shard.bytes}: the shard is truncated "
            "or was changed; delete it and make the split again."
        )


def splits(path: Path) -> list[str]:
    """Return the names of the finished splits inside a dataset folder."""
    return sorted(file.parent.name for file in path.glob(f"*/{MANIFEST}"))


class EpisodeSource(Sequence[Episode]):
    """Random access to the episodes of a finished split, read through Grain.

    ``source[i]`` opens episode i; its images are decoded on request. A source can be pickled, so
    that every loader process opens its own files.

    Raises:
        UserError: the split is absent or unfinished, or a shard is truncated.
        DamagedError: (when an episode is opened) its record cannot be read.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.manifest = read_manifest(self.path)
        files = [str(self.path / shard.file) for shard in self.manifest.shards]
        try:
            self._records: Any = sources.ArrayRecordDataSource(files)
        except (RuntimeError, ValueError) as error:
            raise UserError(
                f"{self.path}: the shards do not open ({_first_line(error)}); make the split again."
            ) from None
        self._length = len(self._records)
        if self._length != self.manifest.records:
            raise UserError(
                f"{self.path}: the shards hold {self._length} records but {MANIFEST} lists "
                f"{self.manifest.records}; make the split again."
            )

    def __len__(self) -> int:
        return self._length

    def __repr__(self) -> str:
        return f"EpisodeSource({str(self.path)!r}, episodes={len(self)})"

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(f"episode {index} of {self.path}, which has {len(self)}")
        position = int(index) % len(self)
        where = self.where(position)
        try:
            record = self._records[position]
        except (RuntimeError, ValueError) as error:
            raise DamagedError(
                f"{where} cannot be read ({_first_line(error)}); the shard is damaged, delete it "
                "and make the split again."
            ) from None
        try:
            return read_episode(record, where)
        except UserError:
            raise
        except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
            raise DamagedError(
                f"{where}: the header and the payload do not match ({error!r}); the record is "
                "damaged, collect or import it again."
            ) from None

    def where(self, index: int, between: str = ", record ") -> str:
        """Return the file and the record number of an episode, for messages."""
        for shard in self.manifest.shards:
            if index < shard.records:
                return f"{self.path / shard.file}{between}{index}"
            index -= shard.records
        return str(self.path)
