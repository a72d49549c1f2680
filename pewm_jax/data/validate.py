"""Validate a dataset on disk: every file, record and frame; each problem is one line."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import tyro

from pewm_jax.config import UserError
from pewm_jax.data.checks import Problem, check_episode
from pewm_jax.data.dataset import (
    MANIFEST,
    UNFINISHED,
    Manifest,
    count_records,
    describe_shard,
    read_manifest,
    read_record,
    splits,
)
from pewm_jax.data.episodes import read_episode
from pewm_jax.data.record_format import DamagedError
from pewm_jax.data.voxels import VoxelGrid, require_alike
from pewm_jax.io.progress import Meter

SHOWN = 20
"""Largest number of problems printed."""


@dataclasses.dataclass(frozen=True)
class ValidateConfig:
    """Check a dataset, a split or a single file: sizes, hashes, counts, units, geometry."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """A dataset folder, one of its splits, or an .array_record file."""


@dataclasses.dataclass(frozen=True)
class ValidationResult:
    """The number of episodes checked, their total number of frames, and all problems found."""

    episodes: int
    frames: int
    problems: list[Problem]


def validate(config: ValidateConfig, log: Callable[[str], None] = print) -> ValidationResult:
    """Check everything under a path.

    Raises:
        UserError: there is nothing to check at the path, or a split is unfinished or truncated.
    """
    path = config.path
    files, problems = ([path], []) if path.is_file() else _files(path)
    counts = {file: count_records(file) for file in files}
    frames = 0
    grids: dict[Path, VoxelGrid] = {}
    with Meter(f"validating {path}", sum(counts.values()), "episodes") as meter:
        for file, count in counts.items():
            for index in range(count):
                length, found = _check_record(file, index, grids)
                frames, problems = frames + length, problems + found
                meter.advance(1)
    for problem in problems[:SHOWN]:
        log(str(problem))
    if len(problems) > SHOWN:
        log(f"… and {len(problems) - SHOWN} more.")
    if not problems:
        log(f"{path}: {meter.done} episodes, {frames} frames, no problems.")
    return ValidationResult(meter.done, frames, problems)


def _files(path: Path) -> tuple[list[Path], list[Problem]]:
    """Return the files of all splits under a path, and the problems of the files themselves."""
    inside = splits(path) if path.is_dir() and not (path / MANIFEST).is_file() else []
    files: list[Path] = []
    problems = _unfinished(path) if inside else []
    for folder in [path / name for name in inside] or [path]:
        manifest = read_manifest(folder)
        problems += _check_hashes(folder, manifest)
        files += [folder / shard.file for shard in manifest.shards]
    return files, problems


def _unfinished(path: Path) -> list[Problem]:
    """Return a problem for every unfinished split of a dataset."""
    begun = {
        file.parent for mark in ("*.array_record", UNFINISHED) for file in path.glob(f"*/{mark}")
    }
    what = "is missing: the split is unfinished and cannot be read; run the same command again."
    missing = sorted(folder for folder in begun if not (folder / MANIFEST).is_file())
    return [Problem(str(folder), None, MANIFEST, what) for folder in missing]


def _check_hashes(folder: Path, manifest: Manifest) -> list[Problem]:
    problems = []
    for shard in manifest.shards:
        found = describe_shard(folder / shard.file)
        for field in ("records", "sha256"):
            if getattr(found, field) != getattr(shard, field):
                what = (
                    f"is {getattr(found, field)} but {MANIFEST} lists {getattr(shard, field)}: the "
                    "file was changed after it was made; make the split again."
                )
                problems.append(Problem(str(folder / shard.file), None, field, what))
    return problems


def _check_record(
    file: Path, index: int, grids: dict[Path, VoxelGrid]
) -> tuple[int, list[Problem]]:
    """Return the frames of a record and its problems; ``grids`` gets each folder's first grid."""
    where = f"{file}, record {index}"
    try:
        episode = read_episode(read_record(file, index), where)
    except UserError as error:
        return 0, [Problem(where, None, "record", str(error).removeprefix(where).lstrip(":, "))]
    found = check_episode(episode, where)
    try:
        grid = episode.voxel_grid
        if grid is not None:
            require_alike(grids.setdefault(file.parent, grid), grid, "it")
    except DamagedError:
        pass  # reported by check_episode
    except UserError as error:
        found.append(Problem(where, None, "voxels", str(error)))
    return episode.length, found
