"""Scoring: imagine every chosen clip with every method and sum the errors; can be resumed."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from pewm_jax.config import Config
from pewm_jax.data.episodes import Episode
from pewm_jax.data.progress import Meter
from pewm_jax.evaluation.images import error_sums_batch, unit_colours, with_lpips
from pewm_jax.evaluation.imagine import print_now
from pewm_jax.evaluation.methods import Methods
from pewm_jax.evaluation.metrics import Perceptual
from pewm_jax.evaluation.partial import Partials
from pewm_jax.evaluation.protocol import ClipChoice, choose, load_clip, long_choices, stack
from pewm_jax.evaluation.seen import seen_masks_batch
from pewm_jax.memory import memories
from pewm_jax.types import Frames


@dataclasses.dataclass(frozen=True)
class Scored:
    """Errors of a set of clips.

    Attributes:
        choices: the C clips.
        sums: method → (seeds, C, N, 3, 9) as ``images.error_sums``; one seed without a network.
    """

    choices: list[ClipChoice]
    sums: dict[str, np.ndarray]

    @property
    def clustered_by(self) -> str:
        """How standard errors are clustered: ``scene``, or ``episode`` if there is one scene."""
        return "scene" if len({choice.scene for choice in self.choices}) > 1 else "episode"

    @property
    def clusters(self) -> np.ndarray:
        """(C,) the cluster number of every clip; clips of one cluster show the same rooms."""
        names = [getattr(choice, self.clustered_by) for choice in self.choices]
        return np.unique(names, return_inverse=True)[1]


@dataclasses.dataclass(frozen=True)
class LongRollouts:
    """Scored long rollouts; the frames of the first few are stored, to be shown.

    Attributes:
        scored: errors over all of them.
        chain: clips generated one after the other.
        shown: number of rollouts whose frames are stored.
        kept: per method ``rgb`` (shown, N, H, W, 3) uint8 and ``depth`` (shown, N, H, W) metres;
            for ``memory`` also the map at the start and the end: ``first_points``,
            ``first_features``, ``first_valid``, and the same with ``last``.
    """

    scored: Scored
    chain: int
    shown: int
    kept: dict[str, dict[str, np.ndarray]]


@dataclasses.dataclass(frozen=True)
class Batch:
    """Chosen clips, padded to one size by repeating the last; ``real`` of them are asked for."""

    context: Frames
    targets: Frames
    control: Any
    numbers_B: np.ndarray
    seen: Any
    unseen: Any
    real: int

    def seeds(self, seed: int) -> np.ndarray:
        """Return what the sampler's noise is drawn from: sampling seed, clip number."""
        return np.stack([np.full_like(self.numbers_B, seed), self.numbers_B], -1)

    def imagine(self, methods: Methods, method: str, seed: int) -> tuple[Any, Any, Frames]:
        """Imagine the clips, see ``Methods.imagine``."""
        seeds, camera = self.seeds(seed), self.targets.camera
        return methods.imagine(method, self.context, self.control, camera, seeds)

    def sums(self, frames: Frames, lpips: Perceptual | None) -> np.ndarray:
        """Return ``images.error_sums`` of the clips asked for, with LPIPS if it is given."""
        sums = np.asarray(error_sums_batch(frames, self.targets, self.seen, self.unseen))
        if lpips is not None:
            distances = lpips.frames(frames.rgb_THWC, self.targets.rgb_THWC)
            sums = with_lpips(sums, np.asarray(distances))
        return sums[: self.real]


def load_batch(
    config: Config,
    episodes: Sequence[Episode],
    choices: Sequence[ClipChoice],
    first: int,
    *,
    cameras: bool,
) -> Batch:
    """Read clips, the first of them number ``first``, and find what was seen before."""
    size = config.evaluate.batch
    parts = [load_clip(config, episodes, choice, cameras=cameras) for choice in choices]
    context = stack([part[0] for part in parts], size)
    targets = stack([part[1] for part in parts], size)
    control = stack([part[2] for part in parts], size)
    seen, unseen = seen_masks_batch(targets, context)
    return Batch(
        context, targets, control, first + np.arange(size), seen, unseen, real=len(choices)
    )


def score_table(
    config: Config,
    episodes: Sequence[Episode],
    methods: Methods,
    partials: Partials,
    say: Callable[[str], Any] = print_now,
    lpips: Perceptual | None = None,
    choices: list[ClipChoice] | None = None,
) -> Scored:
    """Score ``evaluate.clips`` choices, chains of ``evaluate.chain`` clips, by method and seed.

    Pieces that ``partials`` already holds are reused. Without ``lpips`` that is left out. Without
    ``choices`` they are those of ``choose``.

    Raises:
        UserError: no episode is long enough, the data is inconsistent or does not fit the model,
            or the model's output is not finite.
    """
    if choices is None:
        choices = choose(config, episodes, config.evaluate.clips, config.evaluate.chain)
    starts = range(0, len(choices), config.evaluate.batch)
    pieces: dict[tuple[str, int, int], np.ndarray] = {}
    todo: list[tuple[str, int, int]] = []
    for first in starts:
        for method in methods.names:
            for seed in methods.seeds(method, config.evaluate.seeds):
                found = partials.get(_piece(methods, method, seed, first))
                if found is None:
                    todo.append((method, seed, first))
                else:
                    pieces[method, seed, first] = found["sums"]
    if pieces:
        say(f"{len(pieces)} of {len(pieces) + len(todo)} pieces were scored before and are kept")
    methods.prepare(method for method, _, _ in todo)
    frames_each = config.evaluate.chain * (config.model.clip.frames - 1)
    total = sum(
        frames_each * min(config.evaluate.batch, len(choices) - first) for _, _, first in todo
    )
    with Meter("scoring", total, "frames") as meter:
        loaded: tuple[int, Batch] | None = None
        for method, seed, first in todo:
            if loaded is None or loaded[0] != first:
                chosen = choices[first : first + config.evaluate.batch]
                loaded = (
                    first,
                    load_batch(config, episodes, chosen, first, cameras=methods.model.cameras),
                )
            batch = loaded[1]
            frames = batch.imagine(methods, method, seed)[2]
            sums = batch.sums(frames, lpips)
            partials.put(_piece(methods, method, seed, first), sums=sums)
            pieces[method, seed, first] = sums
            meter.advance(frames_each * batch.real)
    if todo:
        say(meter.summary())
    table = {
        method: np.stack(
            [
                np.concatenate([pieces[method, seed, first] for first in starts])
                for seed in methods.seeds(method, config.evaluate.seeds)
            ]
        )
        for method in methods.names
    }
    return Scored(choices, table)


def _piece(methods: Methods, method: str, seed: int, first: int) -> str:
    return f"table-{methods.piece(method)}-seed{seed}-clip{first:04d}"


def roll_long(
    config: Config,
    episodes: Sequence[Episode],
    methods: Methods,
    partials: Partials,
    say: Callable[[str], Any] = print_now,
    lpips: Perceptual | None = None,
    choices: list[ClipChoice] | None = None,
) -> LongRollouts:
    """Make long rollouts with every method (first seed), score all, store the first few.

    Without ``lpips`` that is left out. Without ``choices`` they are those of ``long_choices``.

    Raises:
        UserError: as for ``score_table``.
    """
    if choices is None:
        choices = long_choices(config, episodes)
    count = len(choices[0].targets_N)
    shown = min(config.evaluate.videos, len(choices))
    seed, size = config.evaluate.seeds[0], config.evaluate.batch
    name = {method: f"long-{methods.piece(method)}-seed{seed}" for method in methods.names}
    pieces = {method: partials.get(name[method]) for method in methods.names}
    todo = [m for m in methods.names if not _holds(pieces[m], len(choices), shown)]
    if todo:
        methods.prepare(todo)
        cameras = methods.model.cameras
        batches = [
            load_batch(config, episodes, choices[first : first + size], first, cameras=cameras)
            for first in range(0, len(choices), size)
        ]
        with Meter("long rollouts", len(todo) * count * len(choices), "frames") as meter:
            for method in todo:
                parts = []
                for batch in batches:
                    here = min(max(shown - int(batch.numbers_B[0]), 0), batch.real)
                    parts.append(_roll(config, methods, method, batch, here, lpips))
                    meter.advance(count * batch.real)
                joined = {
                    key: np.concatenate([part[key] for part in parts if key in part])
                    for key in parts[0]
                }
                pieces[method] = partials.put(name[method], **joined)
        say(meter.summary())
    kept = {method: piece for method, piece in pieces.items() if piece is not None}
    sums = {method: piece["sums"][None] for method, piece in kept.items()}
    chain = count // (config.model.clip.frames - 1)
    return LongRollouts(Scored(choices, sums), chain, shown, kept)


def _holds(piece: dict[str, np.ndarray] | None, rollouts: int, shown: int) -> bool:
    """Tell whether a piece has all the rollouts, and the frames of those that are shown."""
    return piece is not None and len(piece["sums"]) == rollouts and len(piece["rgb"]) >= shown


def _roll(
    config: Config,
    methods: Methods,
    method: str,
    batch: Batch,
    shown: int,
    lpips: Perceptual | None,
) -> dict[str, np.ndarray]:
    """Imagine a batch of long rollouts; frames and maps of the first ``shown`` are kept."""
    first, last, frames = batch.imagine(methods, method, config.evaluate.seeds[0])
    colours = np.asarray(unit_colours(frames.rgb_THWC[:shown]))
    kept = {
        "sums": batch.sums(frames, lpips),
        "rgb": np.rint(colours * 255).astype(np.uint8),
        "depth": np.asarray(frames.depth_THW[:shown], np.float32),
    }
    if method == "memory" and shown:
        kept |= _map_points(config, first.map, shown, "first")
        kept |= _map_points(config, last.map, shown, "last")
    return kept


def _map_points(config: Config, maps: Any, shown: int, when: str) -> dict[str, np.ndarray]:
    maps = jax.tree.map(lambda leaf: leaf[:shown], maps)
    to_points = functools.partial(memories.to_points, config.model)
    points, features, valid = jax.vmap(to_points)(maps)
    return {
        f"{when}_points": np.asarray(points),
        f"{when}_features": np.asarray(features),
        f"{when}_valid": np.asarray(valid),
    }
