"""Collect a dataset with several processes, so that nothing half-made is ever taken for whole.

The unit of work is a shard. A shard is written aside and renamed, ``dataset.json`` is written when
all shards of a split are there: a collection that was killed goes on with the missing shards, and
neither that nor the number of processes leaves a trace in the files.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, Literal

import cv2

from pewm_jax.config import ConfigError, UserError
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
    write_shard,
)
from pewm_jax.data.progress import Meter
from pewm_jax.data.recording import SPLITS, CollectConfig, dashed, make_episode, settings_of

State = Literal["fresh", "resume", "complete"]


@dataclasses.dataclass(frozen=True)
class _Job:
    """One shard to make."""

    config: CollectConfig
    split: str
    path: Path
    indices: range

    def run(self) -> Shard:
        write_shard(self.path, (make_episode(self.config, self.split, i) for i in self.indices))
        return describe_shard(self.path)


def collect(config: CollectConfig, say: Callable[[str], None] = print) -> None:
    """Make the dataset, or what is missing of it.

    Args:
        config: what to make and where.
        say: receives the lines to show.

    Raises:
        UserError: a mesh that cannot be walked in, a dataset of other settings in the way, or a
            worker process that died.
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
    jobs: dict[str, list[_Job]] = {split: _jobs(config, split) for split in todo}
    done = {split: _prepare(config, split, states[split], jobs[split]) for split in todo}
    missing = [job for split in todo for job in jobs[split] if job.path.name not in done[split]]
    if any(done.values()):
        there = sum(len(shards) for shards in done.values())
        say(f"resuming: {there} files are there, {len(missing)} are missing.")
    frames = sum(len(job.indices) for job in missing) * config.frames
    with Meter(f"collecting {config.out}", frames, "frames") as meter:
        for job, shard in _run(missing, config.workers or os.cpu_count() or 1):
            done[job.split][shard.file] = shard
            meter.advance(len(job.indices) * config.frames)
    for split in todo:
        _publish(config, split, [done[split][job.path.name] for job in jobs[split]])
    say(meter.summary())


def _jobs(config: CollectConfig, split: str) -> list[_Job]:
    episodes, per = config.episodes(split), config.shard_episodes
    count = -(-episodes // per)
    return [
        _Job(
            config,
            split,
            config.out / split / f"shard-{i:05d}-of-{count:05d}.array_record",
            range(i * per, min(episodes, (i + 1) * per)),
        )
        for i in range(count)
    ]


def _examine(config: CollectConfig, split: str) -> State:
    """Look at what is there without touching it, and refuse to mix it with other settings."""
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


def _prepare(config: CollectConfig, split: str, state: State, jobs: list[_Job]) -> dict[str, Shard]:
    """Mark a split as unfinished, clear away what is not whole, and return what is."""
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
    whole: dict[str, Shard] = {}
    if state == "resume":
        for job in jobs:
            shard = _whole(job)
            if shard is not None and listed.get(shard.file, shard) == shard:
                whole[shard.file] = shard
    for path in (*folder.glob("*.array_record"), *folder.glob("*.partial")):
        if path.name not in whole:
            path.unlink(missing_ok=True)
    return whole


def _whole(job: _Job) -> Shard | None:
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


def _run(jobs: list[_Job], workers: int) -> Iterator[tuple[_Job, Shard]]:
    """Make shards, in this process or in several, as they get ready."""
    if min(workers, len(jobs)) <= 1:
        for job in jobs:
            yield job, job.run()
        return
    others = set(multiprocessing.active_children())
    done = False
    # Spawned, not forked: JAX has threads, and a fork of a process with threads may hang.
    pool = concurrent.futures.ProcessPoolExecutor(
        min(workers, len(jobs)), multiprocessing.get_context("spawn"), _start_worker
    )
    try:
        with _deaf():  # workers are spawned here, and inherit it before any line of theirs runs
            futures = {pool.submit(job.run): job for job in jobs}
        for future in concurrent.futures.as_completed(futures):
            yield futures[future], future.result()
        done = True
    except BrokenProcessPool:
        raise UserError(
            "a worker process died (killed, or out of memory); run the same command again to go "
            "on, with fewer --workers if memory is short."
        ) from None
    finally:
        if not done:  # what they are writing is marked as partial, and is made again
            for worker in set(multiprocessing.active_children()) - others:
                worker.terminate()
        pool.shutdown(wait=True, cancel_futures=True)


@contextlib.contextmanager
def _deaf() -> Iterator[None]:
    """Ignore Ctrl-C for a moment, here and for ever in the processes spawned meanwhile."""
    if threading.current_thread() is not threading.main_thread():  # others cannot set signals
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler if before is None else before)


def _start_worker() -> None:
    """Prepare a worker: one thread, deaf to Ctrl-C (its parent ends it), gone with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    parent = multiprocessing.parent_process()
    if parent is not None:

        def follow() -> None:
            wait([parent.sentinel])
            os._exit(1)

        threading.Thread(target=follow, daemon=True).start()
