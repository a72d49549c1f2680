"""Collect a dataset with many workers; an interrupted collection goes on where it stopped.

The unit of work is a shard. A shard is written under another name and then renamed;
``dataset.json`` is written when all shards of a split exist. A collection that was killed goes on
with the missing shards. The files depend neither on interruptions nor on the engine (``engines``).
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

from pewm_jax.config import ConfigError, UserError
from pewm_jax.data import engines, lighting
from pewm_jax.data.dataset import (
    MANIFEST,
    UNFINISHED,
    Manifest,
    Shard,
    count_records,
    describe_shard,
    read_manifest,
    write_json,
    write_manifest,
)
from pewm_jax.data.engines import Job
from pewm_jax.data.make_episode import SPLITS, CollectConfig, dashed, settings_of
from pewm_jax.data.progress import Meter

State = Literal["fresh", "resume", "complete"]


def collect(config: CollectConfig, say: Callable[[str], None] = print) -> None:
    """Make a dataset, or its missing shards.

    Args:
        config: what to make and where.
        say: receives the lines to show.

    Raises:
        UserError: a mesh that cannot be walked in, a dataset of other settings in the way, no
            renderer, a worker process that died, or a cluster that cannot be reached.
    """
    for path in config.scene:
        if not path.is_file():
            raise UserError(f"{path} does not exist; give --scene the path of a mesh file.")
    if config.out.exists() and not config.out.is_dir():
        raise UserError(f"{config.out} is a file; give a folder to write the dataset to.")
    wanted = [split for split in SPLITS if config.episodes(split)]
    states: dict[str, State] = {split: _examine(config, split) for split in wanted}
    todo = [split for split in wanted if states[split] != "complete"]
    if not todo:
        say(f"{config.out} is complete with these settings: nothing to do.")
        return
    if config.scene and len(config.scene) < len(wanted):
        say(f"fewer meshes ({len(config.scene)}) than splits: the splits share their scenes.")
    lighting.require_embree()
    engines.require(config)
    jobs: dict[str, list[Job]] = {split: _jobs(config, split) for split in todo}
    done = {split: _prepare(config, split, states[split], jobs[split]) for split in todo}
    missing = [job for split in todo for job in jobs[split] if job.path.name not in done[split]]
    if any(done.values()):
        there = sum(len(shards) for shards in done.values())
        say(f"resuming: {there} files are there, {len(missing)} are missing.")
    frames = sum(len(job.indices) for job in missing) * config.frames
    with (
        Meter(f"collecting {config.out}", frames, "frames") as meter,
        contextlib.closing(engines.run(missing, config, say)) as made,
    ):
        for job, shard in made:
            done[job.split][shard.file] = shard
            meter.advance(len(job.indices) * config.frames)
    for split in todo:
        _publish(config, split, [done[split][job.path.name] for job in jobs[split]])
    say(meter.summary())


def _jobs(config: CollectConfig, split: str) -> list[Job]:
    episodes, per = config.episodes(split), config.shard_episodes
    count = -(-episodes // per)
    return [
        Job(
            config,
            split,
            config.out / split / f"shard-{i:05d}-of-{count:05d}.array_record",
            range(i * per, min(episodes, (i + 1) * per)),
        )
        for i in range(count)
    ]


def _examine(config: CollectConfig, split: str) -> State:
    """Find out what exists of a split, and refuse to mix settings. Nothing is changed."""
    folder = config.out / split
    finished = (folder / MANIFEST).is_file()
    if finished:
        there = read_manifest(folder, check_files=False).settings
    elif (folder / UNFINISHED).is_file():
        there = _read_settings(folder / UNFINISHED)
    else:
        return "fresh"
    wanted = settings_of(config, split)
    differ = [name for name in {**wanted, **there} if wanted.get(name) != there.get(name)]
    if differ and not config.overwrite:
        name = differ[0]
        raise ConfigError(
            f"{folder} was made with other settings ({dashed(name)} was {there.get(name)}, now "
            f"{wanted.get(name)}); choose another folder, or replace it with --overwrite."
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


def _read_settings(path: Path) -> Mapping[str, Any]:
    try:
        return json.loads(path.read_text("utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError):
        raise UserError(f"{path} does not parse; delete its folder and collect again.") from None


def _prepare(config: CollectConfig, split: str, state: State, jobs: list[Job]) -> dict[str, Shard]:
    """Mark a split as unfinished, delete incomplete files, and return the complete shards."""
    folder = config.out / split
    folder.mkdir(parents=True, exist_ok=True)
    listed = {}
    if state == "resume" and (folder / MANIFEST).is_file():
        manifest = read_manifest(folder, check_files=False)
        listed = {shard.file: shard for shard in manifest.shards}
    if state == "fresh":
        (folder / MANIFEST).unlink(missing_ok=True)
    write_json(folder / UNFINISHED, settings_of(config, split))
    (folder / MANIFEST).unlink(missing_ok=True)
    complete: dict[str, Shard] = {}
    if state == "resume":
        for job in jobs:
            shard = _complete_shard(job)
            if shard is not None and listed.get(shard.file, shard) == shard:
                complete[shard.file] = shard
    for path in (*folder.glob("*.array_record"), *folder.glob("*.partial")):
        if path.name not in complete:
            path.unlink(missing_ok=True)
    return complete


def _complete_shard(job: Job) -> Shard | None:
    """Return the description of a shard that exists with all its records, else None."""
    if not job.path.is_file():
        return None
    try:
        return describe_shard(job.path) if count_records(job.path) == len(job.indices) else None
    except UserError:
        return None


def _publish(config: CollectConfig, split: str, shards: list[Shard]) -> None:
    folder = config.out / split
    frames = config.episodes(split) * config.frames
    write_manifest(folder, Manifest(split, tuple(shards), settings_of(config, split), frames))
    (folder / UNFINISHED).unlink(missing_ok=True)
