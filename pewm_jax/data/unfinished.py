"""A split in the making: what is there already, what is made anew, and when it is finished.

A split folder that holds ``collecting.json`` and no ``dataset.json`` is unfinished. The same
settings go on with what is missing; other settings are refused, or replace it where that is asked.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
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


def examine(folder: Path, settings: Mapping[str, Any], *, overwrite: bool = False) -> State:
    """Find out what exists of a split, and refuse to mix settings. Nothing is changed.

    Args:
        folder: the split's folder.
        settings: what determines its bytes, as plain values.
        overwrite: begin anew where it was made with other settings.

    Raises:
        ConfigError: it was made with other settings.
        UserError: what lies there cannot be read.
    """
    finished = (folder / MANIFEST).is_file()
    if finished:
        there = read_manifest(folder, check_files=False).settings
    elif (folder / UNFINISHED).is_file():
        there = _read_settings(folder / UNFINISHED)
    else:
        return "fresh"
    differ = [name for name in {**settings, **there} if settings.get(name) != there.get(name)]
    if differ and not overwrite:
        name = differ[0]
        raise ConfigError(
            f"{folder} was made with other settings ({name.replace('_', '-')} was "
            f"{there.get(name)}, now {settings.get(name)}); choose another folder, or replace it "
            "with --overwrite."
        )
    if differ:
        return "fresh"
    if finished:
        try:
            read_manifest(folder)
        except UserError:  # a file is missing or was cut short: that one is made again
            return "resume"
        return "complete"
    return "resume"


def prepare(
    folder: Path, settings: Mapping[str, Any], state: State, wanted: Mapping[Path, int]
) -> dict[str, Shard]:
    """Mark a split as unfinished, delete incomplete files, and return the complete shards.

    Args:
        folder: the split's folder.
        settings: as for ``examine``.
        state: what ``examine`` found.
        wanted: the files that it will have, with their numbers of records.
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
    """Write ``dataset.json``: the split is finished."""
    write_manifest(folder, Manifest(folder.name, tuple(shards), settings, frames))
    (folder / UNFINISHED).unlink(missing_ok=True)


def frames_of(folder: Path, shard: Shard) -> int:
    """Return the number of frames of a shard's episodes, which may differ in length."""
    path = folder / shard.file
    return sum(read_episode(read_record(path, i)).length for i in range(shard.records))


def _complete_shard(path: Path, records: int) -> Shard | None:
    """Return the description of a shard that exists with all its records, else None."""
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
