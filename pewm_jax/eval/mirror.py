"""The mirror test: the agent goes out and returns the same way. Does it see the same places again?

From the start of each long rollout the model imagines the first frames of the recorded path, then
the same path backwards; it is collision-free because it was walked. Each place is visited twice;
the later a place lies on the way out, the fewer frames are between the visits. The second visit is
compared with the first (``metrics.revisits``), and both with the ground truth: a model that always
shows one image is perfectly consistent.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax.config import Config
from pewm_jax.data.episodes import Episode
from pewm_jax.eval import statistics
from pewm_jax.eval.clips import ClipChoice, load_clip, stack, steered_by_record
from pewm_jax.eval.metrics import Revisit
from pewm_jax.eval.metrics.images import psnr, unit_colours
from pewm_jax.eval.metrics.revisits import ways
from pewm_jax.eval.runner import SAMPLED, Methods, print_now, workers
from pewm_jax.eval.scoring import TRUTH, Batch, Scored
from pewm_jax.geometry.actions import there_and_back
from pewm_jax.io.progress import Meter
from pewm_jax.io.store import ResultCache, inputs_hash, map_resumable
from pewm_jax.report.labels import own_method
from pewm_jax.types import Frames

USUAL, LONG = 32, 64
"""Default number of frames on the way out, for long rollouts of at least this length."""
VERSION = 1
"""Increase it whenever the same settings would give different numbers."""
PAIRS = ("again", "out", "back")
"""PSNR of: the second visit against the first; the first and the second visit against the ground
truth."""


@dataclasses.dataclass(frozen=True)
class Mirror:
    """The results of the mirror test.

    Attributes:
        scored: the R rollouts, without errors.
        out: K, number of frames on the way out.
        values: method → metric → (R,), both visits compared; the entry ``truth`` is the ceiling.
        floor: metric → (R,), the ground truth's way out against another rollout's return path;
            empty if there is only one rollout.
        pairs: method → one of ``PAIRS`` → (R, K) dB, by ``distances``; NaN where the first visit is
            the observed frame.
    """

    scored: Scored
    out: int
    values: dict[str, dict[str, np.ndarray]]
    floor: dict[str, np.ndarray]
    pairs: dict[str, dict[str, np.ndarray]]

    @property
    def distances(self) -> list[int]:
        """Return the numbers of frames between both visits: 2, 4, …, 2 K."""
        return [2 * (k + 1) for k in range(self.out)]


def way_out(config: Config, rollouts: Sequence[ClipChoice]) -> tuple[int, str]:
    """Return the number of frames on the way out (0 for no test), and a description.

    ``evaluate.mirror`` and the clip length are used; whole clips are imagined.
    """
    asked, there = config.evaluate.mirror, len(rollouts[0].targets_N)
    if asked == 0:
        return 0, "The mirror test is disabled (evaluate.mirror)."
    if steered_by_record(config.model):
        return 0, (
            f"The mirror test is skipped: actions of {config.model.batch_spec.actions} numbers "
            "have no known reverse."
        )
    if asked < 0 and there < LONG:
        return 0, (
            f"The mirror test is skipped: long rollouts have {there} frames, fewer than {LONG}; "
            f"request it with --mirror {USUAL}, or a number of frames that they have."
        )
    each = config.model.clip.frames - 1
    fits = [k for k in range(1, min(asked if asked > 0 else USUAL, there) + 1) if not 2 * k % each]
    if not fits:
        return 0, (
            f"The mirror test is skipped: {asked} frames out and back do not fill a clip of "
            f"{each} imagined frames; give a larger number by --mirror."
        )
    return fits[-1], (
        f"{fits[-1]} frames along the recorded way and back the same way, {len(rollouts)} "
        f"rollouts, sampling seed {config.evaluate.seeds[0]}"
    )


def mirror_test(
    config: Config,
    episodes: Sequence[Episode],
    methods: Methods,
    cache: ResultCache,
    rollouts: Sequence[ClipChoice],
    measures: Mapping[str, Revisit],
    log: Callable[[str], Any] = print_now,
) -> Mirror | None:
    """Run the mirror test with every method that is a network (first seed); None if it is skipped.

    The first frames of the long rollouts are the paths, ``measures``
    (``metrics.selection.select_revisits``) compare both visits. Results in ``cache`` are reused;
    several processes share the work. Errors are
    those of ``scoring.score_table``.
    """
    out, _ = way_out(config, rollouts)
    if not out:
        return None
    choices = [dataclasses.replace(one, targets_N=one.targets_N[:out]) for one in rollouts]
    seed, size = config.evaluate.seeds[0], config.evaluate.batch
    starts = range(0, len(choices), size)
    content = [VERSION, [[n, getattr(m.compare, "sha256", "")] for n, m in measures.items()]]
    digest = inputs_hash(content)[:12]
    everyone = (*[name for name in methods.names if name in SAMPLED], TRUTH)

    def name(key: tuple[str, int]) -> str:
        who = TRUTH if key[0] == TRUTH else methods.piece(key[0])
        return f"mirror-{who}-seed{seed}-out{out}-{digest}-clip{key[1]:04d}"

    def work(todo: list[tuple[str, int]]) -> Iterator[tuple[tuple[str, int], Any]]:
        methods.prepare(method for method, _ in todo)
        total = 2 * out * sum(min(size, len(choices) - first) for _, first in todo)
        with Meter("mirror test", total, "frames") as meter:
            for method, first in todo:
                some = choices[first : first + size]
                batch = _there_and_back(config, episodes, some, first, methods.model.cameras)
                if method == TRUTH:
                    other = None
                    if len(choices) > 1:
                        others = [choices[first + k - 1] for k in range(len(some))]
                        other = _there_and_back(config, episodes, others, first, True)
                    made = _truth_metrics(batch, other, measures)
                else:
                    frames = batch.imagine(methods, method, seed)[2]
                    made = _model_metrics(batch, frames, measures)
                yield (method, first), {key: array[: batch.real] for key, array in made.items()}
                meter.advance(2 * out * batch.real)
        log(meter.summary())

    found = map_resumable(
        [(method, first) for first in starts for method in everyone],
        name,
        work,
        cache=cache,
        what="mirror test",
        workers=workers(),
        is_light=lambda key: key[0] == TRUTH,
    )

    def joined(method: str, kind: str) -> dict[str, np.ndarray]:
        parts = [found[method, first] for first in starts]
        return {
            name.partition("/")[2]: np.concatenate([part[name] for part in parts])
            for name in parts[0]
            if name.partition("/")[0] == kind
        }

    return Mirror(
        scored=Scored(choices, {}),
        out=out,
        values={method: joined(method, "value") for method in everyone},
        floor=joined(TRUTH, "floor"),
        pairs={method: joined(method, "pair") for method in everyone if method != TRUTH},
    )


def _there_and_back(
    config: Config,
    episodes: Sequence[Episode],
    choices: Sequence[ClipChoice],
    first: int,
    cameras: bool,
) -> Batch:
    """Read a batch of ways out and mirror each at its end; the targets are all 2 K frames."""
    size = config.evaluate.batch
    parts = [load_clip(config, episodes, choice, cameras=cameras) for choice in choices]
    context, targets = stack([part[0] for part in parts], size), stack([p[1] for p in parts], size)
    present = jax.tree.map(lambda x: x[:, -1:], context)
    way = jax.tree.map(lambda a, b: np.concatenate([a, b], 1), present, targets)
    whole = jax.tree.map(lambda x: np.concatenate([x[:, 1:], x[:, -2::-1]], 1), way)
    control: Any = whole.camera
    if not cameras:
        control = np.asarray(there_and_back(stack([part[2] for part in parts], size)))
    numbers = first + np.arange(size)
    return Batch(context, whole, control, numbers, None, None, real=len(choices))


def _truth_metrics(
    batch: Batch, other: Batch | None, measures: Mapping[str, Revisit]
) -> dict[str, np.ndarray]:
    """Return the ceilings and, given the paths of other rollouts, the floors."""
    truth = batch.whole(batch.targets.rgb_THWC)
    made = {f"value/{name}": measure(truth, truth) for name, measure in measures.items()}
    if other is not None:
        out, back = ways(truth)[0], ways(other.whole(other.targets.rgb_THWC))[1]
        made |= {f"floor/{name}": one.compare(back, out) for name, one in measures.items()}
    return {name: np.asarray(array) for name, array in made.items()}


def _model_metrics(
    batch: Batch, frames: Frames, measures: Mapping[str, Revisit]
) -> dict[str, np.ndarray]:
    """Return the metrics of imagined paths, and PSNR by distance."""
    truth, imagined = batch.whole(batch.targets.rgb_THWC), batch.whole(frames.rgb_THWC)
    made = {f"value/{name}": measure(imagined, truth) for name, measure in measures.items()}
    (out, back), (real, _) = ways(imagined), ways(truth)
    pairs = {"again": (back, out), "out": (out, real), "back": (back, real)}
    for name, (one, two) in pairs.items():
        error = jnp.square(unit_colours(one) - unit_colours(two)).mean((2, 3, 4))
        made[f"pair/{name}"] = psnr(error)[:, ::-1]
    arrays = {name: np.array(array) for name, array in made.items()}
    arrays["pair/out"][:, -1] = np.nan  # the observed frame is not imagined
    return arrays


def facts(mirror: Mirror) -> dict[str, Any]:
    """Return the results for ``metrics.json``; ``docs/evaluation.md`` describes them."""
    own, truth = own_method(mirror.pairs), mirror.values[TRUTH]

    entries = functools.partial(statistics.entries, houses_C=mirror.scored.clusters)

    def minus(method: str) -> dict[str, np.ndarray]:
        return {name: mirror.pairs[own][name] - mirror.pairs[method][name] for name in PAIRS}

    rivals = [method for method in mirror.pairs if method != own]
    return {
        "out": mirror.out,
        "rollouts": len(mirror.scored.choices),
        "distances": mirror.distances,
        "results": {method: entries(mirror.values[method]) for method in mirror.pairs},
        "ceiling": entries(truth),
        "floor": entries(mirror.floor),
        "by_distance": {method: entries(pairs) for method, pairs in mirror.pairs.items()},
        "margins": {method: entries(minus(method)) for method in rivals},
    }
