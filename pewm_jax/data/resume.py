"""Make the shards of a split so that an interrupted command can be resumed.

A split folder that holds ``collecting.json`` and no ``dataset.json`` is unfinished. Running the
same command again makes the missing shards. Other settings are refused, unless ``--overwrite``
replaces the split.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pewm_jax.config import ConfigError, UserError
from pewm_jax.data.dataset import (
    MANIFEST,
    UNFINISHED,
    Manifest,
    Shard,
    count_records,
    describe_shard,
    read_manifest,
    read_record,
    write_json,
    write_manifest,
)
from pewm_jax.data.episodes import read_episode

State = Literal["fresh", "resume", "complete"]


@dataclasses.dataclass
class SplitProgress:
    """A split that a command makes: its shards, and which of them exist.

    Attributes:
        folder: the split's folder; its name is the split's.
        settings: the values that determine its bytes.
        wanted: the episodes of each file.
        state: the state in which the command found it.
        done: the complete shards by file name; ``prepare`` fills it.
    """

    folder: Path
    settings: Mapping[str, Any]
    wanted: Mapping[Path, range]
    state: State
    done: dict[str, Shard] = dataclasses.field(default_factory=dict)

    def prepare(self) -> None:
        """Mark the split as unfinished and find the complete shards."""
        records = {path: len(indices) for path, indices in self.wanted.items()}
        self.done = prepare(self.folder, self.settings, self.state, records)

    def missing(self) -> dict[Path, range]:
        """Return the files that are not complete, and their episodes."""
        return {
            path: indices for path, indices in self.wanted.items() if path.name not in self.done
        }

    def publish(self, frames: int | None = None) -> None:
        """Mark the split as finished.

        Args:
            frames: frames of all its episodes; by default they are counted.
        """
        shards = [self.done[path.name] for path in self.wanted]
        total = sum(frames_of(self.folder, one) for one in shards) if frames is None else frames
        publish(self.folder, self.settings, shards, total)


def unfinished_splits(
    out: Path,
    episodes: Mapping[str, int],
    settings: Callable[[str], Mapping[str, Any]],
    shard_episodes: int,
    *,
    overwrite: bool,
) -> list[SplitProgress]:
    """Return the splits of a dataset that are not complete; change nothing.

    Args:
        out: the dataset's folder.
        episodes: the number of episodes of each split; splits with 0 are left out.
        settings: the values that determine a split's bytes, by its name.
        shard_episodes: episodes per file.
        overwrite: replace splits that were made with other settings.

    Raises:
        ConfigError: a split was made with other settings.
        UserError: ``out`` is a file, or a split's files cannot be read.
    """
    if out.exists() and not out.is_dir():
        raise UserError(f"{out} is a file; give a folder to write the dataset to.")
    found = []
    for split, count in episodes.items():
        if count:
            values, shards = settings(split), -(-count // shard_episodes)
            wanted = {
                out / split / f"shard-{i:05d}-of-{shards:05d}.array_record": range(
                    i * shard_episodes, min(count, (i + 1) * shard_episodes)
                )
                for i in range(shards)
            }
            state = examine(out / split, values, overwrite=overwrite)
            found.append(SplitProgress(out / split, values, wanted, state))
    return [split for split in found if split.state != "complete"]


def examine(folder: Path, settings: Mapping[str, Any], *, overwrite: bool = False) -> State:
    """Return the state of a split; raise an error if its settings differ; change nothing.

    Args:
        folder: the split's folder.
        settings: the values that determine its bytes.
        overwrite: replace a split that was made with other settings.

    Raises:
        ConfigError: the split was made with other settings.
        UserError: its files cannot be read.
    """
    finished = (folder / MANIFEST).is_file()
    if finished:
        found = read_manifest(folder, check_files=False).settings
    elif (folder / UNFINISHED).is_file():
        found = _read_settings(folder / UNFINISHED)
    else:
        return "fresh"
    differ = [name for name in {**settings, **found} if settings.get(name) != found.get(name)]
    if differ and not overwrite:
        name = differ[0]
        raise ConfigError(
            f"{folder} was made with other settings ({name.replace('_', '-')} was "
            f"{found.get(name)}, now {settings.get(name)}); choose another folder, or replace "
            "it with --overwrite."
        )
    if differ:
        return "fresh"
    if finished:
        try:
            read_manifest(folder)
        except UserError:  # a shard is missing or truncated: only that shard is made again
            return "resume"
        return "complete"
    return "resume"


def prepare(
    folder: Path, settings: Mapping[str, Any], state: State, wanted: Mapping[Path, int]
) -> dict[str, Shard]:
    """Mark a split as unfinished, delete incomplete files, and return the complete shards by name.

    Args:
        folder: the split's folder.
        settings: as for ``examine``.
        state: the result of ``examine``.
        wanted: the split's files and their numbers of records.
    """
    folder.mkdir(parents=True, exist_ok=True)
    listed = {}
    if state == "resume" and (folder / MANIFEST).is_file():
        manifest = read_manifest(folder, check_files=False)
        listed = {shard.file: shard for shard in manifest.shards}
    if state == "fresh":
        (folder / MANIFEST).unlink(missing_ok=True)
    write_json(folder / UNFINISHED, dict(settings))
    (folder / MANIFEST).unlink(missing_ok=True)
    complete: dict[str, Shard] = {}
    if state == "resume":
        for path, records in wanted.items():
            shard = _complete_shard(path, records)
            if shard is not None and listed.get(shard.file, shard) == shard:
                complete[shard.file] = shard
    for path in (*folder.glob("*.array_record"), *folder.glob("*.partial")):
        if path.name not in complete:
            path.unlink(missing_ok=True)
    return complete


def publish(
    folder: Path, settings: Mapping[str, Any], shards: Sequence[Shard], frames: int
) -> None:
    """Write ``dataset.json``, which marks the split as finished."""
    write_manifest(folder, Manifest(folder.name, tuple(shards), settings, frames))
    (folder / UNFINISHED).unlink(missing_ok=True)


def frames_of(folder: Path, shard: Shard) -> int:
    """Return the total number of frames of a shard's episodes, which may differ in length."""
    path = folder / shard.file
    return sum(read_episode(read_record(path, i)).length for i in range(shard.records))


def _complete_shard(path: Path, records: int) -> Shard | None:
    """Return the description of a shard, None if it is missing or incomplete."""
    if not path.is_file():
        return None
    try:
        return describe_shard(path) if count_records(path) == records else None
    except UserError:
        return None


def _read_settings(path: Path) -> Mapping[str, Any]:
    try:
        return json.loads(path.read_text("utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError):
        raise UserError(f"{path} does not parse; delete its folder and collect again.") from None
