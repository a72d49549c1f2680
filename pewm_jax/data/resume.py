"""Make the shards of a split so that an interrupted command can be resumed.

A split folder that holds ``collecting.json`` and no ``dataset.json`` is unfinished. Running the
same command again makes the missing shards. Other settings are refused, unless ``--overwrite``
replaces the split.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

from pewm_jax.config import ConfigError, UserError
from pewm_jax.data import dataset
from pewm_jax.data.episodes import read_episode


@dataclasses.dataclass
class SplitProgress:
    """A split that a command makes: its shards, and which of them exist.

    Attributes:
        folder: the split's folder; its name is the split's.
        settings: the values that determine its bytes.
        wanted: the episodes of each file.
        overwrite: replace the split if it was made with other settings.
        done: the complete shards by file name; ``prepare`` fills it.
        state: the state in which the command found the split.

    Raises:
        ConfigError: the split was made with other settings.
        UserError: its files cannot be read.
    """

    folder: Path
    settings: Mapping[str, Any]
    wanted: Mapping[Path, range]
    overwrite: bool = False
    done: dict[str, dataset.Shard] = dataclasses.field(default_factory=dict)
    state: Literal["fresh", "resume", "complete"] = dataclasses.field(init=False)

    def __post_init__(self):
        """Examine the folder; change nothing."""
        finished = (self.folder / dataset.MANIFEST).is_file()
        self.state = "fresh"
        if finished:
            found = dataset.read_manifest(self.folder, check_files=False).settings
        elif (self.folder / dataset.UNFINISHED).is_file():
            found = _read_settings(self.folder / dataset.UNFINISHED)
        else:
            return
        now = self.settings
        differ = [name for name in {**now, **found} if now.get(name) != found.get(name)]
        if differ and not self.overwrite:
            name = differ[0]
            raise ConfigError(
                f"{self.folder} was made with other settings ({name.replace('_', '-')} was "
                f"{found.get(name)}, now {now.get(name)}); choose another folder, or replace "
                "it with --overwrite."
            )
        if not differ:
            self.state = "resume"
            if finished:
                with contextlib.suppress(UserError):  # for a missing or truncated shard
                    dataset.read_manifest(self.folder)
                    self.state = "complete"

    def prepare(self) -> None:
        """Mark the split as unfinished, delete incomplete files, and find the complete shards."""
        folder, resumed = self.folder, self.state == "resume"
        folder.mkdir(parents=True, exist_ok=True)
        listed = {}
        if resumed and (folder / dataset.MANIFEST).is_file():
            manifest = dataset.read_manifest(folder, check_files=False)
            listed = {shard.file: shard for shard in manifest.shards}
        if self.state == "fresh":
            (folder / dataset.MANIFEST).unlink(missing_ok=True)
        dataset.write_json(folder / dataset.UNFINISHED, dict(self.settings))
        (folder / dataset.MANIFEST).unlink(missing_ok=True)
        for path, indices in self.wanted.items() if resumed else ():
            shard = _complete_shard(path, len(indices))
            if shard is not None and listed.get(shard.file, shard) == shard:
                self.done[shard.file] = shard
        for path in (*folder.glob("*.array_record"), *folder.glob("*.partial")):
            if path.name not in self.done:
                path.unlink(missing_ok=True)

    def missing(self) -> dict[Path, range]:
        """Return the files that are not complete, and their episodes."""
        return {path: rows for path, rows in self.wanted.items() if path.name not in self.done}

    def write(self, path: Path, records: Iterable[bytes]) -> None:
        """Write a missing file."""
        self.done[path.name] = dataset.write_shard(path, records)

    def publish(self, frames: int | None = None) -> None:
        """Write ``dataset.json``, which marks the split as finished.

        Args:
            frames: frames of all its episodes; by default they are counted.
        """
        shards = tuple(self.done[path.name] for path in self.wanted)
        if frames is None:  # episodes may differ in length
            frames = sum(
                read_episode(dataset.read_record(self.folder / shard.file, k)).length
                for shard in shards
                for k in range(shard.records)
            )
        dataset.write_manifest(
            self.folder, dataset.Manifest(self.folder.name, shards, self.settings, frames)
        )
        (self.folder / dataset.UNFINISHED).unlink(missing_ok=True)


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
        UserError: ``out`` is a file, or as for ``SplitProgress``.
    """
    if out.exists() and not out.is_dir():
        raise UserError(f"{out} is a file; give a folder to write the dataset to.")
    found = []
    for split, count in episodes.items():
        if count:
            starts = range(0, count, shard_episodes)
            wanted = {
                out / split / f"shard-{i:05d}-of-{len(starts):05d}.array_record": range(
                    start, min(count, start + shard_episodes)
                )
                for i, start in enumerate(starts)
            }
            found.append(SplitProgress(out / split, settings(split), wanted, overwrite))
    return [split for split in found if split.state != "complete"]


def _complete_shard(path: Path, records: int) -> dataset.Shard | None:
    """Return the description of a shard, None if it is missing or incomplete."""
    with contextlib.suppress(UserError, FileNotFoundError):
        shard = dataset.describe_shard(path)
        return shard if shard.records == records else None
    return None


def _read_settings(path: Path) -> Mapping[str, Any]:
    try:
        return json.loads(path.read_text("utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError):
        raise UserError(f"{path} does not parse; delete its folder and collect again.") from None
