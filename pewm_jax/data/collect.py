"""Collect a dataset with many workers; an interrupted collection goes on where it stopped.

The unit of work is a shard. A shard is written under another name and then renamed;
``dataset.json`` is written when all shards of a split exist. A collection that was killed goes on
with the missing shards. The files depend neither on interruptions nor on the engine (``engines``).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable

from pewm_jax.config import UserError
from pewm_jax.data import engines, lighting, unfinished
from pewm_jax.data.engines import Job
from pewm_jax.data.make_episode import SPLITS, CollectConfig, settings_of
from pewm_jax.data.progress import Meter


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
    settings = {split: settings_of(config, split) for split in wanted}
    states: dict[str, unfinished.State] = {
        split: unfinished.examine(config.out / split, settings[split], overwrite=config.overwrite)
        for split in wanted
    }
    todo = [split for split in wanted if states[split] != "complete"]
    if not todo:
        say(f"{config.out} is complete with these settings: nothing to do.")
        return
    if config.scene and len(config.scene) < len(wanted):
        say(f"fewer meshes ({len(config.scene)}) than splits: the splits share their scenes.")
    lighting.require_embree()
    engines.require(config)
    jobs: dict[str, list[Job]] = {split: _jobs(config, split) for split in todo}
    done = {
        split: unfinished.prepare(
            config.out / split,
            settings[split],
            states[split],
            {job.path: len(job.indices) for job in jobs[split]},
        )
        for split in todo
    }
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
        shards = [done[split][job.path.name] for job in jobs[split]]
        total = config.episodes(split) * config.frames
        unfinished.publish(config.out / split, settings[split], shards, total)
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
