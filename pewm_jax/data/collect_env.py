"""Collect episodes from an environment of one's own: ``pewm-jax data collect OUT --env …``.

An interrupted collection goes on with the files that are missing, as every episode's seed follows
from the settings and its number. What an environment has to show is said in ``env_episode``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from pewm_jax.config import UserError
from pewm_jax.data import env_episode, unfinished
from pewm_jax.data.dataset import describe_shard, write_shard
from pewm_jax.data.env_episode import SPLITS, CollectEnvConfig
from pewm_jax.data.progress import Meter


def collect_env(config: CollectEnvConfig, say: Callable[[str], None] = print) -> None:
    """Make a dataset from an environment, or its missing shards.

    Args:
        config: what to make and where.
        say: receives the lines to show.

    Raises:
        UserError: the environment or the policy cannot be had, it does not show what is needed,
            its episodes are too short or do not pass validation, or a dataset of other settings
            is in the way.
    """
    if config.out.exists() and not config.out.is_dir():
        raise UserError(f"{config.out} is a file; give a folder to write the dataset to.")
    wanted = [split for split in SPLITS if config.episodes(split)]
    states: dict[str, unfinished.State] = {
        split: unfinished.examine(
            config.out / split, config.settings(split), overwrite=config.overwrite
        )
        for split in wanted
    }
    todo = [split for split in wanted if states[split] != "complete"]
    if not todo:
        say(f"{config.out} is complete with these settings: nothing to do.")
        return
    env, policy = env_episode.open_env(config), env_episode.open_policy(config)
    try:
        # One episode, before anything is written: it is refused here if it lacks something.
        env_episode.make(env, policy, config, todo[0], 0)
        total = sum(config.episodes(split) for split in todo)
        with Meter(f"collecting {config.out}", total, "episodes") as meter:
            for split in todo:
                _split(env, policy, config, split, states[split], meter)
        say(meter.summary())
    finally:
        env.close()


def _split(
    env: Any,
    policy: Callable[[Any], Any] | None,
    config: CollectEnvConfig,
    split: str,
    state: unfinished.State,
    meter: Meter,
) -> None:
    """Make the missing shards of a split, and finish it."""
    folder, per = config.out / split, config.shard_episodes
    count = -(-config.episodes(split) // per)
    jobs = {
        folder / f"shard-{i:05d}-of-{count:05d}.array_record": range(
            i * per, min(config.episodes(split), (i + 1) * per)
        )
        for i in range(count)
    }
    settings = config.settings(split)
    done = unfinished.prepare(
        folder, settings, state, {path: len(indices) for path, indices in jobs.items()}
    )

    def records(indices: range) -> Iterator[bytes]:
        for index in indices:
            yield env_episode.make(env, policy, config, split, index)
            meter.advance(1)

    for path, indices in jobs.items():
        if path.name in done:
            meter.advance(len(indices))
            continue
        write_shard(path, records(indices))
        done[path.name] = describe_shard(path)
    shards = [done[path.name] for path in jobs]
    unfinished.publish(
        folder, settings, shards, sum(unfinished.frames_of(folder, one) for one in shards)
    )
