"""Share of the scored pixels that the model's memory covers."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import worlds
from pewm_jax.config import Config, World
from pewm_jax.data.episodes import Episode
from pewm_jax.eval.clips import ClipChoice, choose
from pewm_jax.eval.runner import ModelRunner, print_now, workers
from pewm_jax.eval.scoring import Batch, load_batch
from pewm_jax.io.store import ResultCache, map_resumable
from pewm_jax.types import Array, Frames, Params, WorldState

NAMES = ("seen", "held", "chosen", "attended", "rendered", "looked_at")
"""The keys of ``World.coverage``, in the order in which they are stored."""


def score_coverage(
    config: Config,
    episodes: Sequence[Episode],
    model: ModelRunner,
    cache: ResultCache,
    log: Callable[[str], Any] = print_now,
    choices: Sequence[ClipChoice] | None = None,
) -> dict[str, float] | None:
    """Measure coverage over the first clip of every scored chain; results are stored in ``cache``.

    Without ``choices`` they are those of ``choose``.

    Returns:
        Shares of the pixels seen before: ``held``, ``chosen``, ``attended``, ``rendered``,
        ``looked_at`` (see ``memory.coverage.coverage``); None if no pixel was seen before.

    Raises:
        UserError: as for ``scoring.score_table``.
    """
    if choices is None:
        choices = choose(config, episodes, config.evaluate.clips, config.evaluate.chain)
    starts = range(0, len(choices), config.evaluate.batch)

    def work(todo: list[int]) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        log("measuring the coverage of the map …")
        for first in todo:
            some = choices[first : first + config.evaluate.batch]
            batch = load_batch(config, episodes, some, first, cameras=model.cameras)
            yield first, {"counts": _count(config.model, model, batch)}

    found = map_resumable(
        starts,
        lambda first: f"coverage2-clip{first:04d}",
        work,
        cache=cache,
        what="coverage",
        workers=workers(),
    )
    counts = [found[first]["counts"].sum(0) for first in starts]
    total = dict(zip(NAMES, np.sum(counts, 0).astype(float), strict=True))
    seen = total.pop("seen")
    return {name: count / seen for name, count in total.items()} if seen else None


def _count(config: World, model: ModelRunner, batch: Batch) -> np.ndarray:
    """Return (clips, 6) pixels, in the order of ``NAMES``."""
    state, length = model.begin(batch.context), config.clip.frames - 1
    targets, seen = jax.tree.map(lambda x: x[:, :length], (batch.targets, batch.seen))
    present = jax.tree.map(lambda x: x[:, -1:], batch.context)
    frames = jax.tree.map(lambda a, b: np.concatenate([a, b], 1), present, targets)
    seen = np.concatenate([np.zeros_like(seen[:, :1]), seen], 1)  # the present is not imagined
    counted = _coverage_of_clips(config, model.params, state, frames, seen)
    return np.stack([counted[name] for name in NAMES], -1)[: batch.real]


@functools.partial(jax.jit, static_argnums=0)
def _coverage_of_clips(
    model: World, params: Params, states: WorldState, frames: Frames, seen: Array
) -> dict[str, Array]:
    def one(clip: tuple[WorldState, Frames, Array]) -> dict[str, Array]:
        return worlds.coverage(model, params, *clip)

    return jax.lax.map(one, jax.tree.map(jnp.asarray, (states, frames, seen)))
