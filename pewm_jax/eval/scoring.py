"""Scoring: imagine every chosen clip with every method and sum the errors; resumable.

A unit of work is one batch of clips, one method and one sampling seed. Its result is a file of the
``ResultCache``, and several processes share the units.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import worlds
from pewm_jax.config import Config, World
from pewm_jax.data.episodes import Episode
from pewm_jax.eval.clips import ClipChoice, choose, has_poses, load_clip, stack
from pewm_jax.eval.metrics import LPIPS, VideoDistance
from pewm_jax.eval.metrics.images import (
    PARTS,
    error_sums_batch,
    seen_masks_batch,
    unit_colours,
    with_lpips,
)
from pewm_jax.eval.metrics.perceptual import Towards
from pewm_jax.eval.metrics.structure import (
    Consistency,
    average,
    first_visible,
    object_ids,
    object_masks,
)
from pewm_jax.eval.runner import SAMPLED, Methods, ModelRunner, print_now, workers
from pewm_jax.io.progress import Meter
from pewm_jax.io.store import ResultCache, map_resumable
from pewm_jax.types import Array, Frames, Params, WorldState

TRUTH = "truth"
"""Pseudo-method for the recorded clips, which are measured like a method."""


@dataclasses.dataclass(frozen=True)
class Scored:
    """Errors of a set of clips.

    Attributes:
        choices: the C clips.
        sums: method → (seeds, C, N, 3, 9) as ``images.error_sums``; one seed for methods without a
            network.
        features: if video distances are measured, method → (C, 400) features of the clips of the
            first seed (``metrics.videos``), including ``truth``.
        composites: likewise by mask, ``seen`` and ``unseen``, of clips that show the truth outside
            the mask; without ``truth``, whose composites are itself.
        structure: if SCS is measured, method → (C, 1 + N): SCS of each clip of the first seed and
            of each imagined frame, NaN where nothing counts; the entry ``truth`` is the ceiling.
    """

    choices: list[ClipChoice]
    sums: dict[str, np.ndarray]
    features: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    composites: dict[str, dict[str, np.ndarray]] = dataclasses.field(default_factory=dict)
    structure: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)

    @property
    def clustered_by(self) -> str:
        """Return the unit of clustering: ``scene``, or ``episode`` if there is one scene."""
        return "scene" if len({choice.scene for choice in self.choices}) > 1 else "episode"

    @property
    def clusters(self) -> np.ndarray:
        """Return the (C,) cluster index of every clip; clips of one cluster show the same rooms."""
        names = [getattr(choice, self.clustered_by) for choice in self.choices]
        return np.unique(names, return_inverse=True)[1]


@dataclasses.dataclass(frozen=True)
class Tracked:
    """Ground truth of a clip for SCS, of its present frame and the N frames to imagine.

    Attributes:
        ids_THW: instance ids.
        things: ids of the objects that may be tracked, or None for all.
        visible_T: (T,) bool, whether each frame shows a point that the present frame shows.
    """

    ids_THW: np.ndarray
    things: list[int] | None
    visible_T: np.ndarray

    def score(self, measure: Consistency, video_THWC: np.ndarray) -> np.ndarray:
        """Return (T,) values: SCS of a uint8 clip, then of each of its frames but the first."""
        found = measure(video_THWC, object_masks(self.ids_THW, self.things), self.visible_T)
        return np.concatenate([average(found)[None], average(found, 0)])


@dataclasses.dataclass(frozen=True)
class Batch:
    """Clips, padded to a fixed size by repeating the last; the first ``real`` are not padding.

    ``described`` caches the LPIPS features of their ground truth. ``tracked`` contains the ground
    truth for SCS, if it is measured.
    """

    context: Frames
    targets: Frames
    control: Any
    numbers_B: np.ndarray
    seen: Any
    unseen: Any
    real: int
    described: dict[Any, Towards] = dataclasses.field(default_factory=dict)
    tracked: tuple[Tracked, ...] = ()

    def seeds(self, seed: int) -> np.ndarray:
        """Return (B, 2) sampling seed and clip number, which determine the sampler's noise."""
        return np.stack([np.full_like(self.numbers_B, seed), self.numbers_B], -1)

    def imagine(
        self,
        methods: Methods,
        method: str,
        seed: int,
        watch: Callable[[Any], Any] | None = None,
    ) -> tuple[Any, Any, Frames]:
        """Imagine the clips, see ``Methods.imagine``."""
        seeds, camera = self.seeds(seed), self.targets.camera
        return methods.imagine(method, self.context, self.control, camera, seeds, watch)

    def whole(self, rgb_BTHWC: Any) -> Array:
        """Return colours in [−1, 1], preceded by the present frame, including padding clips."""
        parts = self.context.rgb_THWC[:, -1:], rgb_BTHWC
        return jnp.concatenate([2 * unit_colours(part) - 1 for part in parts], 1)

    def composite(self, rgb_BTHWC: Any, mask: str) -> Array:
        """Return ``whole`` of clips that show the truth outside a mask of ``PARTS``."""
        within = {"seen": self.seen, "unseen": self.unseen}[mask][..., None]
        imagined, truth = (unit_colours(x) for x in (rgb_BTHWC, self.targets.rgb_THWC))
        return self.whole(2 * jnp.where(within, imagined, truth) - 1)

    def structure(self, frames: Frames, measure: Consistency) -> np.ndarray:
        """Return SCS of the clips and of their frames, see ``Scored.structure``."""
        whole = unit_colours(self.whole(frames.rgb_THWC)[: self.real])
        videos = np.rint(255 * np.asarray(whole)).astype(np.uint8)
        pairs = zip(self.tracked, videos, strict=True)
        return np.stack([tracked.score(measure, video) for tracked, video in pairs])

    def sums(self, frames: Frames, lpips: LPIPS | None) -> np.ndarray:
        """Return ``images.error_sums`` of the clips, with LPIPS unless it is None."""
        sums = np.asarray(error_sums_batch(frames, self.targets, self.seen, self.unseen))
        if lpips is not None:
            known = lpips.net, lpips.sha256
            if known not in self.described:
                self.described[known] = lpips.towards(self.targets.rgb_THWC)
            to = self.described[known]
            masks = jnp.stack([self.seen, self.unseen], 2)
            in_masks = np.asarray(to.in_masks(frames.rgb_THWC, masks))
            sums = with_lpips(sums, np.asarray(to(frames.rgb_THWC)), in_masks)
        return sums[: self.real]


def load_batch(
    config: Config,
    episodes: Sequence[Episode],
    choices: Sequence[ClipChoice],
    first: int,
    *,
    cameras: bool,
    track: bool = False,
) -> Batch:
    """Read a batch of clips starting at index ``first``, with their seen-before masks.

    With ``track`` the instance ids are read, for SCS.

    Raises:
        UserError: see ``load_clip``; or ids are requested and an episode has none.
    """
    size = config.evaluate.batch
    parts = [load_clip(config, episodes, choice, cameras=cameras) for choice in choices]
    context = stack([part[0] for part in parts], size)
    targets = stack([part[1] for part in parts], size)
    control = stack([part[2] for part in parts], size)
    located = [has_poses(episodes[choice.episode]) for choice in choices]
    surfaces = targets
    if not all(located):  # points without a pose count neither as seen nor as unseen
        known_B = np.array(located + located[-1:] * (size - len(located)))
        depth = np.where(known_B[:, None, None, None], targets.depth_THW, 0)
        surfaces = dataclasses.replace(targets, depth_THW=depth)
    seen, unseen = seen_masks_batch(surfaces, context)
    tracked = tuple(tracked_of(episodes[one.episode], one) for one in choices) if track else ()
    numbers, real = first + np.arange(size), len(choices)
    return Batch(context, targets, control, numbers, seen, unseen, real=real, tracked=tracked)


def tracked_of(episode: Episode, choice: ClipChoice) -> Tracked:
    """Return the ground truth of a clip for SCS.

    Parts that move by themselves, such as doors and arms, have no depth there: whether a frame
    still shows a point of the present one is decided by what stands still.

    Raises:
        UserError: the episode has no instance ids.
    """
    frames = [choice.start, *choice.targets_N]
    clip, ids = episode.frames(frames), episode.ids(frames)
    names = episode.info.get("objects")
    depth = np.where(ids >= len(names), 0, clip.depth_THW) if names else clip.depth_THW
    visible_T = first_visible(np.asarray(depth), clip.camera)
    return Tracked(ids, object_ids(episode.info), visible_T)


SUMS_PIECE = "table2"
"""Start of the names of files of sums; a number for each set of sums that versions stored."""


@dataclasses.dataclass(frozen=True)
class Piece:
    """A unit of work: one batch of clips, one method (or ``truth``), one seed, one measurement.

    ``first`` is the index of the batch's first clip; ``measured`` is ``sums`` of the errors,
    ``features`` for the distances of videos, a mask of ``PARTS`` for those of composites, or
    ``structure`` for SCS.
    """

    method: str
    seed: int
    first: int
    measured: str

    @property
    def rollout(self) -> tuple[int, str, int]:
        """Return the key of the imagined clips; pieces with equal keys are computed together."""
        return self.first, self.method, self.seed

    def name(
        self, methods: Methods, i3d: VideoDistance | None, structure: Consistency | None = None
    ) -> str:
        """Return the file name, which includes all that the result depends on besides the clips."""
        who = "truth" if self.method == TRUTH else methods.piece(self.method)
        kind = SUMS_PIECE
        if i3d and self.measured in ("features", *PARTS):
            mask = "" if self.measured == "features" else self.measured
            kind = "-".join(filter(None, ("i3d", i3d.sha256[:16], mask)))
        if structure and self.measured == "structure":
            kind = "-".join(filter(None, ("scs", structure.encoder, structure.sha256[:16])))
        return f"{kind}-{who}-seed{self.seed}-clip{self.first:04d}"


def score_table(
    config: Config,
    episodes: Sequence[Episode],
    methods: Methods,
    cache: ResultCache,
    log: Callable[[str], Any] = print_now,
    lpips: LPIPS | None = None,
    choices: list[ClipChoice] | None = None,
    i3d: VideoDistance | None = None,
    structure: Consistency | None = None,
) -> Scored:
    """Score ``evaluate.clips`` chains of ``evaluate.chain`` clips by method and seed.

    Results in ``cache`` are reused. Several processes share the work, and all return the whole
    table. What is None is not measured; without ``choices`` the clips are those of ``choose``.

    Raises:
        UserError: no episode is long enough, the data is inconsistent or does not fit the model, or
            the model's output is not finite.
    """
    if choices is None:
        choices = choose(config, episodes, config.evaluate.clips, config.evaluate.chain)
    size, starts = config.evaluate.batch, range(0, len(choices), config.evaluate.batch)
    extras = ["features", *(PARTS if methods.reproject else ())] if i3d else []
    extras += ["structure"] if structure else []

    def work(todo: list[Piece]) -> Iterator[tuple[Piece, dict[str, np.ndarray]]]:
        methods.prepare(piece.method for piece in todo)
        frames_each = config.evaluate.chain * (config.model.clip.frames - 1)
        total = sum(frames_each * min(size, len(choices) - piece.first) for piece in todo)
        cameras, track = methods.model.cameras, structure is not None

        @functools.lru_cache(1)
        def load(first: int) -> Batch:
            some = choices[first : first + size]
            return load_batch(config, episodes, some, first, cameras=cameras, track=track)

        @functools.lru_cache(1)
        def imagine(first: int, method: str, seed: int) -> Frames:
            batch = load(first)
            return batch.targets if method == TRUTH else batch.imagine(methods, method, seed)[2]

        with Meter("scoring", total, "frames") as meter:
            for piece in todo:
                batch, frames = load(piece.first), imagine(*piece.rollout)
                yield piece, _measure(piece, batch, frames, lpips, i3d, structure)
                meter.advance(frames_each * batch.real)
        log(meter.summary())

    found = map_resumable(
        _pieces(config, methods, starts, extras),
        lambda piece: piece.name(methods, i3d, structure),
        work,
        cache=cache,
        what="scores",
        log=log,
        workers=workers(),
        group_of=lambda piece: piece.rollout,
        is_light=lambda piece: piece.method not in SAMPLED,
    )

    def joined(method: str, seed: int, measured: str) -> np.ndarray:
        return np.concatenate([found[Piece(method, seed, f, measured)][measured] for f in starts])

    seeds = {method: methods.seeds(method, config.evaluate.seeds) for method in methods.names}
    sums = {name: np.stack([joined(name, seed, "sums") for seed in seeds[name]]) for name in seeds}
    firsts = {name: some[0] for name, some in seeds.items()} | {TRUTH: 0}
    more = {
        measured: {
            name: joined(name, seed, measured)
            for name, seed in firsts.items()
            if name != TRUTH or measured not in PARTS
        }
        for measured in extras
    }
    composites = {mask: more.pop(mask) for mask in PARTS if mask in more}
    return Scored(choices, sums, composites=composites, **more)


def _pieces(
    config: Config, methods: Methods, starts: Sequence[int], extras: Sequence[str]
) -> list[Piece]:
    """Return all pieces; those of one batch and of one rollout are adjacent."""
    pieces = []
    for first in starts:
        for method in methods.names:
            for place, seed in enumerate(methods.seeds(method, config.evaluate.seeds)):
                pieces.append(Piece(method, seed, first, "sums"))
                if place == 0:
                    pieces += [Piece(method, seed, first, measured) for measured in extras]
        pieces += [Piece(TRUTH, 0, first, measured) for measured in extras if measured not in PARTS]
    return pieces


def _measure(
    piece: Piece,
    batch: Batch,
    frames: Frames,
    lpips: LPIPS | None,
    i3d: VideoDistance | None,
    structure: Consistency | None,
) -> dict[str, np.ndarray]:
    if piece.measured == "sums":
        return {"sums": batch.sums(frames, lpips)}
    if piece.measured == "structure":
        assert structure is not None
        return {"structure": batch.structure(frames, structure)}
    assert i3d is not None
    if piece.measured in PARTS:
        clips = batch.composite(frames.rgb_THWC, piece.measured)
    else:
        clips = batch.whole(frames.rgb_THWC)
    return {piece.measured: i3d.features(clips)[: batch.real]}


COVERAGE = ("seen", "held", "chosen", "attended", "rendered", "looked_at")
"""The keys of ``World.coverage``, in the order in which they are stored."""


def score_coverage(
    config: Config,
    episodes: Sequence[Episode],
    model: ModelRunner,
    cache: ResultCache,
    log: Callable[[str], Any],
    choices: Sequence[ClipChoice],
) -> dict[str, float] | None:
    """Measure how much of the pixels seen before the memory covers in the first clip of each chain.

    Results are stored in ``cache``. Returns shares of these pixels: ``held``, ``chosen``,
    ``attended``, ``rendered``, ``looked_at`` (see ``memory.coverage.coverage``); None if no pixel
    was seen before. Errors are those of ``score_table``.
    """
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
    total = dict(zip(COVERAGE, np.sum(counts, 0).astype(float), strict=True))
    seen = total.pop("seen")
    return {name: count / seen for name, count in total.items()} if seen else None


def _count(config: World, model: ModelRunner, batch: Batch) -> np.ndarray:
    """Return (clips, 6) pixels, in the order of ``COVERAGE``."""
    state, length = model.begin(batch.context), config.clip.frames - 1
    targets, seen = jax.tree.map(lambda x: x[:, :length], (batch.targets, batch.seen))
    present = jax.tree.map(lambda x: x[:, -1:], batch.context)
    frames = jax.tree.map(lambda a, b: np.concatenate([a, b], 1), present, targets)
    seen = np.concatenate([np.zeros_like(seen[:, :1]), seen], 1)  # the present is not imagined
    counted = _coverage_of_clips(config, model.params, state, frames, seen)
    return np.stack([counted[name] for name in COVERAGE], -1)[: batch.real]


@functools.partial(jax.jit, static_argnums=0)
def _coverage_of_clips(
    model: World, params: Params, states: WorldState, frames: Frames, seen: Array
) -> dict[str, Array]:
    def one(clip: tuple[WorldState, Frames, Array]) -> dict[str, Array]:
        return worlds.coverage(model, params, *clip)

    return jax.lax.map(one, jax.tree.map(jnp.asarray, (states, frames, seen)))
