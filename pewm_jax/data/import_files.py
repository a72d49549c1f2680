"""The files of an import: which episodes each holds, which are finished, and the list of all.

A file appears under its name only when it is complete. ``dataset.json`` is written after the last
file, so the split shows all episodes of an import or none. An interrupted import is resumed: files
that were made from the same sequences with the same settings are kept.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import itertools
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from pewm_jax.config import UserError
from pewm_jax.data import dataset
from pewm_jax.data.episodes import Episode, read_episode
from pewm_jax.data.formats.options import ImportConfig
from pewm_jax.data.formats.reader import Entry
from pewm_jax.data.voxels import VoxelGrid, require_alike
from pewm_jax.io.progress import Meter

PIXELS = 120_000_000
"""Largest number of pixels of an episode: its encoded images are in memory at once."""
FEWEST_FRAMES = 16
FILES = 256
"""Approximate largest number of files of an import; a loader holds all of them open."""
FIELDS = ("frames", "actions", "voxels", "depth")
"""What ``dataset.json`` lists of each file."""


@dataclasses.dataclass(frozen=True)
class Part:
    """An episode to make: some frames of a sequence.

    Attributes:
        name: name of the episode.
        scene: name of the place: that of the sequence.
        entry: its sequence.
        frames: numbers of the frames in the sequence.
        mark: identifies the settings and the sequence; stored in the record.
    """

    name: str
    scene: str
    entry: Entry
    frames: range
    mark: str


@dataclasses.dataclass(frozen=True)
class _Listed:
    """A file and what ``dataset.json`` lists of it."""

    shard: dataset.Shard
    frames: int
    actions: bool
    voxels: bool
    depth: bool


def plan(entries: Sequence[Entry], config: ImportConfig) -> dict[Path, list[Part]]:
    """Return the episodes of each file: long sequences are cut, short ones share a file."""
    width, height = config.size or entries[0].open().size
    longest = min(config.episode_frames, max(FEWEST_FRAMES, PIXELS // (width * height)))
    settings = dataclasses.asdict(config)
    for name in ("out", "split", "overwrite", "check", "skip_bad", "names", "src"):
        del settings[name]
    parts = []
    for entry in entries:
        count = -(-entry.frames // config.stride)
        pieces = max(1, -(-count // longest))
        name = config.called if len(entries) == 1 else f"{config.called}/{entry.name}"
        about = json.dumps([settings, config.src.name, entry.name, entry.frames], default=str)
        for k in range(pieces):
            first, last = k * count // pieces, (k + 1) * count // pieces
            frames = range(first * config.stride, last * config.stride, config.stride)
            frames = range(frames.start, min(frames.stop, entry.frames), config.stride)
            part = f"{name}/part-{k:03d}" if pieces > 1 else name
            mark = hashlib.sha256(f"{about} {frames}".encode()).hexdigest()[:16]
            parts.append(Part(part, name, entry, frames, mark))
    most = max(1000, sum(len(part.frames) for part in parts) // FILES)
    groups: list[list[Part]] = []
    for part in parts:
        full = not groups or sum(len(one.frames) for one in groups[-1]) + len(part.frames) > most
        if full or len(part.frames) * 2 > longest:
            groups.append([])
        groups[-1].append(part)
    folder, stem = config.out / config.split, f"recording-{config.called}"
    if len(groups) == 1:
        return {folder / f"{stem}.array_record": groups[0]}
    return {
        folder / f"{stem}-{k:05d}-of-{len(groups):05d}.array_record": group
        for k, group in enumerate(groups)
    }


class ImportFiles:
    """The files of one import beside those that the split has already.

    Raises:
        UserError: the split was not made by imports, or has a recording of the same name.
    """

    def __init__(self, config: ImportConfig, parts: dict[Path, list[Part]]):
        self.config, self.parts = config, parts
        self.folder = config.out / config.split
        self.others = self._other_files()
        self.done: dict[Path, _Listed | None] = {}

    def missing(self, meter: Meter) -> dict[Path, list[Part]]:
        """Return the files that have to be made; frames of the others are counted as done."""
        rest = {}
        for path, parts in self.parts.items():
            kept = self._finished(path, parts)
            if kept is None:
                rest[path] = parts
            else:
                self.done[path] = kept
                meter.advance(sum(len(part.frames) for part in parts))
        return rest

    def write(self, path: Path, records: Iterator[bytes]) -> None:
        """Write a file of one record or more; none if there are no records."""
        box, found = list(itertools.islice(records, 1)), []
        self.done[path] = None
        if not box:
            path.unlink(missing_ok=True)
            return

        def every() -> Iterator[bytes]:
            while box:
                found.append(self._contents(box[0]))
                yield box.pop()  # not kept here, as it is large
                box.extend(itertools.islice(records, 1))

        shard = dataset.write_shard(path, every())
        self.done[path] = _listed(shard, found)

    def publish(self) -> None:
        """Write ``dataset.json``, and remove files of an earlier import of the same name.

        Raises:
            UserError: no frame of the import can be used.
        """
        mine = [one for path in self.parts if (one := self.done[path]) is not None]
        if not mine:
            raise UserError(
                f"{self.config.src}: every frame has a lost pose; nothing was added, check the "
                "trajectory."
            )
        listed = [*self.others, *mine]
        settings: dict[str, Any] = {"made_by": "import"}
        for field in FIELDS:
            values = {one.shard.file: getattr(one, field) for one in listed}
            unusual = {"voxels": any(values.values()), "depth": not all(values.values())}
            if unusual.get(field, True):
                settings[field] = values
        shards, total = tuple(one.shard for one in listed), sum(one.frames for one in listed)
        manifest = dataset.Manifest(self.folder.name, shards, settings, total)
        dataset.write_manifest(self.folder, manifest)
        names = {shard.file for shard in shards}
        for path in self._same_name():
            if path.name not in names:
                path.unlink(missing_ok=True)

    def lines(self, size: tuple[int, int], moves: str) -> Iterator[str]:
        """Yield a line about what was added: images of a width and height, and their motion."""
        mine = [one for one in self.done.values() if one is not None]
        episodes, frames = sum(m.shard.records for m in mine), sum(m.frames for m in mine)
        depth = "" if all(one.depth for one in mine) else ", no depth"
        parts = "" if episodes == 1 else f"{episodes} episodes, "
        pixels = f"{size[0]}×{size[1]} pixels" if size[0] else "images"
        yield (
            f"{self.folder}: added {self.config.called}, {parts}{frames} frames of {pixels}, "
            f"{moves}{depth}."
        )

    def _finished(self, path: Path, parts: list[Part]) -> _Listed | None:
        """Return a file that holds these episodes, made with these settings; else None."""
        if not path.is_file():
            return None
        with contextlib.suppress(UserError, OSError):
            shard = dataset.describe_shard(path)
            if self.config.overwrite and self._replaced.get(shard.file) == shard:
                return None
            marks = {part.mark for part in parts}
            last = read_episode(dataset.read_record(path, shard.records - 1))
            first = read_episode(dataset.read_record(path, 0))
            known = {episode.info.get("import") for episode in (first, last)}
            if known <= marks:
                return _inspect(path, shard)
        return None

    def _same_name(self) -> list[Path]:
        """Return the files of this recording's name, of this import or an earlier one."""
        name = re.escape(self.config.called)
        mine = re.compile(rf"recording-{name}(-\d{{5}}-of-\d{{5}})?\.array_record")
        return [path for path in self.folder.glob("*.array_record") if mine.fullmatch(path.name)]

    def _other_files(self) -> list[_Listed]:
        """Return the files of other recordings in the split."""
        self._replaced: dict[str, dataset.Shard] = {}
        if not self.folder.exists():
            return []
        mine = {path.name for path in self._same_name()}
        if not (self.folder / dataset.MANIFEST).is_file():
            return self._strays(mine)
        # A file to replace may be newer than the list, if an import was killed between the two.
        manifest = dataset.read_manifest(self.folder, check_files=False)
        if manifest.settings.get("made_by") != "import":
            raise UserError(
                f"{self.folder} was made by `collect`; import into another --split or folder."
            )
        mine |= {shard.file for shard in manifest.shards if shard.file in mine}
        expected = {path.name for path in self.parts}
        kept = [s for s in manifest.shards if s.file not in mine and s.file not in expected]
        self._replaced = {s.file: s for s in manifest.shards if s not in kept}
        if self._replaced and not self.config.overwrite:
            raise UserError(
                f"{self.folder} already has an episode named {self.config.called}; give another "
                "--name or --overwrite."
            )
        for shard in kept:
            dataset.check_size(self.folder / shard.file, shard)
        settings = manifest.settings
        return [
            _Listed(
                shard,
                settings["frames"][shard.file],
                settings["actions"][shard.file],
                settings.get("voxels", {}).get(shard.file, False),
                settings.get("depth", {}).get(shard.file, True),
            )
            if shard.file in settings.get("actions", {})
            else _inspect(self.folder / shard.file, shard)  # imported before actions were listed
            for shard in kept
        ]

    def _strays(self, mine: set[str]) -> list[_Listed]:
        """Return files of killed imports that are complete, in a split without ``dataset.json``."""
        paths = sorted(self.folder.glob("recording-*.array_record"))
        if len(paths) < len([*self.folder.glob("*.array_record"), *self.folder.glob("*.json")]):
            raise UserError(
                f"{self.folder} holds an unfinished collection; finish it, or give another --split."
            )
        names, whole = {path.name for path in paths}, []
        for path in paths:
            of = re.fullmatch(r"(.*)-\d{5}-of-(\d{5})\.array_record", path.name)
            if of is not None:
                count = int(of[2])
                if not {f"{of[1]}-{k:05d}-of-{of[2]}.array_record" for k in range(count)} <= names:
                    continue  # not all files of that import are there
            if path.name not in mine:
                whole.append(_inspect(path, dataset.describe_shard(path)))
        return whole

    def _contents(self, record: bytes) -> _Contents:
        """Return what a record contains; UserError if its voxels are not like the split's."""
        episode = read_episode(record)
        grid, there = episode.voxel_grid, next((one for one in self.others if one.voxels), None)
        if grid is not None and there is not None:
            other = self.folder / there.shard.file
            known = read_episode(dataset.read_record(other, 0), str(other)).voxel_grid
            assert isinstance(known, VoxelGrid)
            require_alike(known, grid, str(self.config.src / "voxels"))
        return _contents(episode)


_Contents: TypeAlias = tuple[int, bool, bool, bool]
"""Frames of an episode, and whether it has actions, voxels and depth."""


def _contents(episode: Episode) -> _Contents:
    actions, voxels = episode.actions is not None, episode.voxel_grid is not None
    return episode.length, actions, voxels, episode.has_depth


def _inspect(path: Path, shard: dataset.Shard) -> _Listed:
    """Open a file and return what it contains."""
    every = range(shard.records)
    return _listed(
        shard, [_contents(read_episode(dataset.read_record(path, k), str(path))) for k in every]
    )


def _listed(shard: dataset.Shard, contents: Sequence[_Contents]) -> _Listed:
    """Return a file with the sum of its frames, and what all of its episodes have."""
    frames, *fields = zip(*contents, strict=True)
    return _Listed(shard, sum(frames), *(all(each) for each in fields))
