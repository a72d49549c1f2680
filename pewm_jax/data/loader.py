"""Batches of clips by Grain: batch k is a function of (seed, k), so a position is one integer.

Every epoch visits every episode once, in an order drawn from the seed; a clip is drawn from the
episode. Nothing but k is needed to go on where an interrupted training stopped.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import grain
import numpy as np

from pewm_jax.config import Config, ConfigError, UserError
from pewm_jax.data.clips import ReadFeatures, choose, cut, stack
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.episodes import Episode
from pewm_jax.types import Clip

BATCHES_AHEAD = 2
"""Batches decoded before they are asked for; with the one in use, what the loader holds."""
EPOCHS = 2**31
"""Times that the episodes are gone through: without end, and countable in batches of one."""


class _CutClip(grain.transforms.RandomMap):
    """Episode → clip."""

    def __init__(self, config: Config, features: ReadFeatures | None):
        self.config, self.features = config, features

    def random_map(self, element: Episode, rng: np.random.Generator) -> Clip:
        _check_size(self.config, element)
        choice = choose(self.config, element.length, rng, f"episode {element.name}")
        return cut(element, choice, self.config.data.context, self.features)


def dataset(
    config: Config, split: str, seed: int, batch: int, features: ReadFeatures | None = None
) -> grain.MapDataset:
    """Return the endless dataset whose element k is batch k.

    Raises:
        UserError: the split is absent, unfinished or damaged, or its episodes do not fit the
            configuration.
        ConfigError: the episodes were collected with other steps or turns than ``actions`` says.
    """
    source = EpisodeSource(Path(config.data.path) / split)
    first = source[0]
    _check_size(config, first)
    _check_actions(config, first)
    choose(config, first.length, np.random.default_rng(0), f"episode {first.name}")
    clips = grain.MapDataset.source(source).seed(seed).shuffle().repeat(EPOCHS)
    return clips.random_map(_CutClip(config, features)).batch(batch, batch_fn=stack)


def clips(
    config: Config,
    split: str = "train",
    *,
    seed: int,
    batch: int,
    start_step: int = 0,
    features: ReadFeatures | None = None,
) -> Iterator[Clip]:
    """Iterate over batches of clips for ever.

    Args:
        config: ``clip`` and ``data`` say what is read, ``data.workers`` how many threads read it
            (decoding leaves Python's lock to others). The batches do not depend on that number.
        split: folder inside ``data.path``.
        seed: order of the episodes and choice of the clips.
        batch: clips per batch.
        start_step: number of the first batch; going on from step k gives what an iterator that
            started at 0 gives from its k-th batch on.
        features: reads the context's features, if they are kept.

    Returns:
        NumPy clips with a leading B: rgb uint8, depth float32 in metres.

    Raises:
        UserError: the split is absent, unfinished or damaged, or its episodes do not fit.
    """
    batches = dataset(config, split, seed, batch, features).slice(slice(start_step, None))
    threads = max(1, config.data.workers)
    return iter(batches.to_iter_dataset(grain.ReadOptions(threads, BATCHES_AHEAD + threads - 1)))


def _check_size(config: Config, episode: Episode) -> None:
    clip = config.clip
    if (episode.height, episode.width) != (clip.height, clip.width):
        raise UserError(
            f"episode {episode.name} has images of {episode.width}×{episode.height} pixels, the "
            f"configuration wants {clip.width}×{clip.height}: collect or import with that size, or "
            f"set clip.width {episode.width} and clip.height {episode.height}."
        )


def _check_actions(config: Config, episode: Episode) -> None:
    """Compare the settings of the actions with what a collected episode was made with."""
    for name in ("step_m", "turn_deg"):
        made, wanted = episode.info.get(name), getattr(config.actions, name)
        if made is not None and not np.isclose(made, wanted, rtol=1e-6):
            raise ConfigError(
                f"episode {episode.name} was collected with {name} {made:g}, the configuration has "
                f"actions.{name} {wanted:g}: set --actions.{name} {made:g}."
            )
