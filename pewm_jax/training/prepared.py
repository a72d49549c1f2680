"""Clips prepared once and drawn again and again.

What a step computes with frozen weights, before anything that is trained, is the same each time a
clip is drawn: its latents, its memory, what the memory shows. On a CPU that takes longer than the
step itself. With ``data.prepared`` that many clips are prepared before the first step, kept in this
process's main memory, and batches are drawn from them.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from pewm_jax.config import Config, UserError
from pewm_jax.data.progress import Meter
from pewm_jax.training.stages import Stage
from pewm_jax.types import Clip, Params


def applies(config: Config, stage: Stage) -> bool:
    """Tell whether a stage's clips are prepared once.

    Raises:
        UserError: they should be, but the world cannot, or there are several processes.
    """
    if not config.data.prepared:
        return False
    if stage.prepare is None:
        raise UserError(
            f"data.prepared is {config.data.prepared}, but stage {stage.name} prepares nothing: "
            "use data.prepared 0."
        )
    if jax.process_count() > 1:
        raise UserError(
            f"data.prepared is {config.data.prepared}, but there are {jax.process_count()} "
            "processes: prepared clips are kept by one; use data.prepared 0."
        )
    return True


def gather(
    config: Config,
    stage: Stage,
    params: Params,
    batches: Iterator[Clip],
    unless_stopped: Callable[[Callable[[], Any]], Any],
) -> Clip | None:
    """Prepare at least ``data.prepared`` clips.

    Args:
        config: the experiment.
        stage: says how (``Stage.prepare``).
        params: the weights; those that prepare clips are frozen.
        batches: where the clips come from.
        unless_stopped: calls what it is given, or returns None when training shall stop.

    Returns:
        All clips as one batch of NumPy arrays; None if training shall stop.
    """
    assert stage.prepare is not None
    make = jax.jit(functools.partial(stage.prepare, config.model))
    kept: list[Clip] = []
    count = -(-config.data.prepared // stage.settings(config).batch)
    with Meter(f"preparing {stage.title}'s clips", count, "batches") as meter:
        for _ in range(count):
            batch = unless_stopped(lambda: next(batches))
            if batch is None:
                return None
            kept.append(jax.device_get(make(params, batch)))
            meter.advance(1)
    return jax.tree.map(lambda *parts: np.concatenate(parts), *kept)


def draw(clips: Clip, batch: int, seed: int, start: int = 0) -> Iterator[Clip]:
    """Draw batches without end; batch k depends on the seed and on k alone.

    Every clip comes once before any comes again, in another order each time.

    Args:
        clips: from ``gather``, N of them.
        batch: clips in a batch, at most N.
        seed: of the order.
        start: number of the first batch.
    """
    count = len(jax.tree.leaves(clips)[0])
    for number in itertools.count(start):
        chosen = _rows(count, batch, seed, number)
        yield jax.tree.map(lambda x, chosen=chosen: x[chosen], clips)


def rows(config: Config, stage: Stage, number: int) -> list[int]:
    """Return which of the prepared clips are in batch ``number``; see ``draw``.

    Clip r was row r mod B of batch r div B of the loader, batches of B.
    """
    batch = stage.settings(config).batch
    count = -(-config.data.prepared // batch) * batch
    return _rows(count, batch, stage.data_seed(config), number)


def _rows(count: int, batch: int, seed: int, number: int) -> list[int]:
    places = range(number * batch, (number + 1) * batch)
    return [int(_order(count, seed, place // count)[place % count]) for place in places]


@functools.lru_cache(maxsize=4)
def _order(count: int, seed: int, epoch: int) -> np.ndarray:
    return np.random.default_rng((seed, epoch)).permutation(count)
