"""Collect a dataset of houses or meshes with parallel workers; the command is resumable.

The unit of work is a shard. A shard is written under a temporary name and then renamed;
``dataset.json`` is written when all shards of a split exist. The files depend neither on
interruptions nor on the engine (``engines``).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable

from pewm_jax.config import UserError
from pewm_jax.data import engines, resume, shading
from pewm_jax.data.engines import Job
from pewm_jax.data.make_episode import SPLITS, CollectConfig, settings_of
from pewm_jax.io.progress import Meter


def collect(config: CollectConfig, log: Callable[[str], None] = print) -> None:
    """Create a dataset, or its missing shards.

    Args:
        config: what to make and where.
        log: receives the lines to print.

    Raises:
        UserError: a mesh has no floor to walk on, the output folder contains a dataset with other
            settings, there is no renderer, a worker process died, or a cluster cannot be reached.
    """
    for path in config.scene:
        if not path.is_file():
            raise UserError(f"{path} does not exist; give --scene the path of a mesh file.")
    counts = {split: config.episodes(split) for split in SPLITS}
    splits = resume.unfinished_splits(
        config.out,
        counts,
        lambda split: settings_of(config, split),
        config.shard_episodes,
        overwrite=config.overwrite,
    )
    if not splits:
        log(f"{config.out} is complete with these settings: nothing to do.")
        return
    if config.scene and len(config.scene) < sum(map(bool, counts.values())):
        log(f"fewer meshes ({len(config.scene)}) than splits: the splits share their scenes.")
    shading.require_embree()
    engines.require(config)
    for split in splits:
        split.prepare()
    jobs = [
        Job(config, split.folder.name, path, indices)
        for split in splits
        for path, indices in split.missing().items()
    ]
    if existing := sum(len(split.done) for split in splits):
        log(f"resuming: {existing} files exist, {len(jobs)} are missing.")
    frames = sum(len(job.indices) for job in jobs) * config.frames
    done = {split.folder.name: split.done for split in splits}
    with (
        Meter(f"collecting {config.out}", frames, "frames") as meter,
        contextlib.closing(engines.run(jobs, config, log)) as made,
    ):
        for job, shard in made:
            done[job.split][shard.file] = shard
            meter.advance(len(job.indices) * config.frames)
    for split in splits:
        split.publish(counts[split.folder.name] * config.frames)
    log(meter.summary())
