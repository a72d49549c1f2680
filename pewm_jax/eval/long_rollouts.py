"""Long rollouts: consecutive clips, each from the model's own last frame; resumable.

Stored are the errors of every frame, the frames and the map of the first few rollouts, and the
number of points in the model's memory after each clip.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np

from pewm_jax.config import Config
from pewm_jax.data.episodes import Episode
from pewm_jax.eval.clips import ClipChoice, long_choices
from pewm_jax.eval.metrics import LPIPS
from pewm_jax.eval.metrics.images import unit_colours
from pewm_jax.eval.runner import SAMPLED, Methods, print_now, workers
from pewm_jax.eval.scoring import Batch, Scored, load_batch
from pewm_jax.io.progress import Meter
from pewm_jax.io.store import ResultCache, map_resumable
from pewm_jax.types import WorldState


@dataclasses.dataclass(frozen=True)
class LongRollouts:
    """Scored long rollouts; the frames of the first few are stored for display.

    Attributes:
        chain: number of consecutive clips.
        shown: number of rollouts whose frames are stored.
        kept: per method ``rgb`` (shown, N, H, W, 3) uint8 and ``depth`` (shown, N, H, W) metres;
            for ``memory`` also the map at the start and the end: ``first_points``,
            ``first_features``, ``first_valid``, and the same with ``last``; and ``occupied``
            (rollouts, chain + 1), the number of points in the map at the start and after each clip.
    """

    scored: Scored
    chain: int
    shown: int
    kept: dict[str, dict[str, np.ndarray]]


def roll_long(
    config: Config,
    episodes: Sequence[Episode],
    methods: Methods,
    cache: ResultCache,
    log: Callable[[str], Any] = print_now,
    lpips: LPIPS | None = None,
    choices: list[ClipChoice] | None = None,
) -> LongRollouts:
    """Make long rollouts with every method (first seed), score all, and store the first few.

    Without ``lpips`` it is not measured. Without ``choices`` they are those of ``long_choices``.
    Several processes share the work, and all return the whole result. Errors are those of
    ``scoring.score_table``.
    """
    if choices is None:
        choices = long_choices(config, episodes)
    count, size = len(choices[0].targets_N), config.evaluate.batch
    shown, seed = min(config.evaluate.videos, len(choices)), config.evaluate.seeds[0]
    starts = range(0, len(choices), size)

    def shown_from(first: int) -> int:
        return min(max(shown - first, 0), size, len(choices) - first)

    def work(todo: list[tuple[str, int]]) -> Iterator[tuple[tuple[str, int], Any]]:
        methods.prepare(method for method, _ in todo)
        total = count * sum(min(size, len(choices) - first) for _, first in todo)

        @functools.lru_cache(1)
        def load(first: int) -> Batch:
            some, cameras = choices[first : first + size], methods.model.cameras
            return load_batch(config, episodes, some, first, cameras=cameras)

        with Meter("long rollouts", total, "frames") as meter:
            for method, first in todo:
                batch = load(first)
                made = _roll_batch(config, methods, method, batch, shown_from(first), lpips)
                yield (method, first), made
                meter.advance(count * batch.real)
        log(meter.summary())

    found = map_resumable(
        [(method, first) for first in starts for method in methods.names],
        lambda key: f"rollouts2-{methods.piece(key[0])}-seed{seed}-clip{key[1]:04d}",
        work,
        cache=cache,
        what="long rollouts",
        is_usable=lambda key, arrays: len(arrays["rgb"]) >= shown_from(key[1]),
        workers=workers(),
        is_light=lambda key: key[0] not in SAMPLED,
    )
    kept = {
        method: _concatenate([found[method, first] for first in starts], shown)
        for method in methods.names
    }
    sums = {method: piece["sums"][None] for method, piece in kept.items()}
    chain = count // (config.model.clip.frames - 1)
    return LongRollouts(Scored(choices, sums), chain, shown, kept)


def _concatenate(parts: Sequence[dict[str, np.ndarray]], shown: int) -> dict[str, np.ndarray]:
    """Concatenate batches; keep at most ``shown`` rollouts for display."""
    joined = {key: np.concatenate([part[key] for part in parts if key in part]) for key in parts[0]}
    every = ("sums", "occupied")
    return {key: array if key in every else array[:shown] for key, array in joined.items()}


def _roll_batch(
    config: Config,
    methods: Methods,
    method: str,
    batch: Batch,
    shown: int,
    lpips: LPIPS | None,
) -> dict[str, np.ndarray]:
    """Imagine a batch of long rollouts; frames and maps of the first ``shown`` are kept."""
    held: list[np.ndarray] = []

    def count(state: WorldState) -> None:
        held.append(np.asarray(occupied(config, state.map))[: batch.real])

    remembers = method == "memory" and config.model.capabilities.points
    first, last, frames = batch.imagine(
        methods, method, config.evaluate.seeds[0], count if remembers else None
    )
    colours = np.asarray(unit_colours(frames.rgb_THWC[:shown]))
    kept = {
        "sums": batch.sums(frames, lpips),
        "rgb": np.rint(colours * 255).astype(np.uint8),
        "depth": np.asarray(frames.depth_THW[:shown], np.float32),
    }
    if remembers:
        kept["occupied"] = np.stack(held, -1)
        if shown:
            kept |= _map_points(config, first.map, shown, "first")
            kept |= _map_points(config, last.map, shown, "last")
    return kept


@functools.partial(jax.jit, static_argnums=0)
def occupied(config: Config, maps: Any) -> jax.Array:
    """Return the number of points in each map of a batch, (B,): cells, surfels or patches."""
    return jax.vmap(lambda one: config.model.memory_points(one)[2].sum())(maps)


def _map_points(config: Config, maps: Any, shown: int, when: str) -> dict[str, np.ndarray]:
    maps = jax.tree.map(lambda leaf: leaf[:shown], maps)
    found = jax.vmap(config.model.memory_points)(maps)
    names = ("points", "features", "valid")
    return {f"{when}_{name}": np.asarray(x) for name, x in zip(names, found[:3], strict=True)}
