"""Measure whether actions steer a world: imagine walks with true, shuffled and no actions.

A world that follows its actions is closest to the ground truth with the true ones. *Shuffled*
actions are those of a clip in another house. *None* are zero embeddings, as observed frames have:
available only for models whose control uses modulation. *Copy* is a baseline without a network that
repeats the observed frame.

The measurement needs clips that can show a difference (``Walks``). In every clip at least half of
the steps go forward, because a turn in place replaces the whole view after a few frames, whatever
the actions are. The shuffled actions differ from the true ones in at least half of the steps.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pewm_jax import worlds
from pewm_jax.config import ActionConfig, Config, UserError
from pewm_jax.data.episodes import Episode
from pewm_jax.eval import statistics
from pewm_jax.eval.clips import (
    ClipChoice,
    choice_of,
    load_clip,
    return_start,
    stack,
    steered_by_record,
)
from pewm_jax.eval.metrics.images import psnr, unit_colours
from pewm_jax.eval.runner import workers
from pewm_jax.geometry.actions import actions_between
from pewm_jax.io.progress import Meter
from pewm_jax.io.store import ResultCache, map_resumable
from pewm_jax.types import Array, Frames, Params

TRUE, SHUFFLED, NONE, COPY = "true", "shuffled", "none", "copy"
LEAST_FORWARD = 0.5
"""Smallest share of a clip's steps that go forward."""
LEAST_DIFFERENT = 0.5
"""Smallest share of a clip's steps in which the shuffled actions differ from the true ones."""
MOVED = 0.1
"""Forward motion, in steps of ``ActionConfig.step_m``, up to which the agent counts as standing
still."""
APART = 0.5
"""Smallest difference between two motions that counts, in units of a step or a turn."""


@dataclasses.dataclass(frozen=True)
class Walks:
    """Clips that are walks, each with a clip of another house that has different actions.

    ``forward_C`` is the share of each clip's steps that go forward, ``different_C`` the share in
    which the shuffled actions, of ``others``, differ from the true ones.

    Raises:
        ValueError: a share is below its limit, or both clips of a pair are from one house.
    """

    choices: list[ClipChoice]
    others: list[ClipChoice]
    forward_C: np.ndarray
    different_C: np.ndarray

    def __post_init__(self):
        """Check the properties on which the measurement relies."""
        pairs = zip(self.choices, self.others, strict=True)
        if any(one.scene == other.scene for one, other in pairs):
            raise ValueError("the shuffled actions of a clip come from its own house")
        if np.any(self.forward_C < LEAST_FORWARD):
            raise ValueError(f"a clip with {self.forward_C.min():.0%} forward steps is not a walk")
        if np.any(self.different_C < LEAST_DIFFERENT):
            raise ValueError(
                f"shuffled actions differ in {self.different_C.min():.0%} of the steps"
            )

    @property
    def houses(self) -> np.ndarray:
        """Return the (C,) index of each clip's house."""
        return np.unique([choice.scene for choice in self.choices], return_inverse=True)[1]

    @property
    def about(self) -> str:
        """Return a description of the clips."""
        return (
            f"{len(self.choices)} walks in {len(set(self.houses))} houses: "
            f"{100 * self.forward_C.mean():.1f} % of the steps go forward (in each clip at least "
            f"{100 * self.forward_C.min():.0f} %); the other actions differ in "
            f"{100 * self.different_C.mean():.1f} % of the steps (in each clip at least "
            f"{100 * self.different_C.min():.0f} %)"
        )


def forward_steps(actions: ActionConfig, motion_N3: np.ndarray) -> np.ndarray:
    """Return (...) bool: whether steps (..., 3) dx, dy, dyaw, metres and radians, go forward.

    A step goes forward if the agent moves ahead by more than it turns, in units of a forward step
    and of a turn. So a discrete forward action does, and a discrete turn does not.
    """
    motion = np.asarray(motion_N3)
    ahead = motion[..., 0] / actions.step_m
    turned = np.abs(motion[..., 2]) / math.radians(actions.turn_deg)
    return ahead > np.maximum(turned, MOVED)


def different_steps(actions: ActionConfig, one_N3: np.ndarray, two_N3: np.ndarray) -> np.ndarray:
    """Return (...) bool: whether two motions differ, by half of a step or half of a turn."""
    apart = np.abs(np.asarray(one_N3) - np.asarray(two_N3))
    turned = np.minimum(apart[..., 2], 2 * math.pi - apart[..., 2]) / math.radians(actions.turn_deg)
    return np.maximum(apart[..., :2].max(-1) / actions.step_m, turned) >= APART


def choose_walks(
    config: Config,
    episodes: Sequence[Episode],
    clips: int,
    chain: int = 1,
    among: Iterable[int] | None = None,
) -> Walks:
    """Choose clips that are walks, and the clips that provide the shuffled actions.

    Starts are spread evenly over the walks on the return path of every episode, where reports take
    their clips too: the first walk of every episode, then the second ones, and so on. The shuffled
    actions are drawn, with a fixed seed, from all clips on the return paths in other houses that
    differ in ``LEAST_DIFFERENT`` of the steps; these need not be walks. ``among`` are the indices
    of the episodes to choose from; by default all.

    Raises:
        UserError: no episode is long enough, none has a walk, or no other house has different
            actions.
    """
    units, stride = config.model.actions, config.evaluate.stride
    count = chain * (config.model.clip.frames - 1)
    where = f"{config.data.path}/{config.evaluate.split}"
    indices = sorted(set(range(len(episodes)) if among is None else among))
    per_episode = -(-clips // max(len(indices), 1))
    pool: list[ClipChoice] = []
    motions: list[np.ndarray] = []
    ranked: list[tuple[int, int]] = []
    for index in indices:
        episode = episodes[index]
        last = episode.length - 1 - count * stride
        if last < 0:
            continue
        starts = np.arange(min(return_start(episode), last), last + 1)
        steps_SN = starts[:, None] + stride * np.arange(count)
        motion_SN3 = _motion(episode.world_from_camera, stride)[steps_SN]
        walking = np.flatnonzero(forward_steps(units, motion_SN3).mean(1) >= LEAST_FORWARD)
        if walking.size:
            spread = np.linspace(0, len(walking) - 1, per_episode)
            for rank, at in enumerate(np.unique(np.round(spread).astype(int))):
                ranked.append((rank, len(pool) + int(walking[at])))
        pool += [choice_of(config, episode, index, int(start), count) for start in starts]
        motions.append(motion_SN3)
    if not pool:
        raise UserError(
            f"no episode of {where} is long enough for {count * stride + 1} frames: collect longer "
            "ones."
        )
    if not ranked:
        raise UserError(
            f"no clip of {where} is a walk: in each of them fewer than half of the steps go "
            "forward; collect walks with --test_policy follow, or evaluate another split "
            "(evaluate.split)."
        )
    motion_PN3 = np.concatenate(motions)
    scenes = np.array([choice.scene for choice in pool])
    chosen, others, different = [], [], []
    for _, place in sorted(ranked):
        share_P = different_steps(units, motion_PN3, motion_PN3[place]).mean(1)
        able = np.flatnonzero((scenes != scenes[place]) & (share_P >= LEAST_DIFFERENT))
        if able.size and len(chosen) < clips:
            other = int(np.random.default_rng([0, place]).choice(able))
            chosen.append(place)
            others.append(other)
            different.append(share_P[other])
    if not chosen:
        raise UserError(
            f"no clip of {where} has a partner with different actions: it must be from another "
            "house and differ in at least half of the steps; evaluate a split with several houses "
            "(evaluate.split)."
        )
    return Walks(
        [pool[place] for place in chosen],
        [pool[other] for other in others],
        forward_steps(units, motion_PN3[chosen]).mean(1),
        np.array(different),
    )


def _motion(world_from_camera: np.ndarray, stride: int) -> np.ndarray:
    """Return (T - stride, 3) the planar motion from each frame to the one ``stride`` later."""
    pairs = np.stack([world_from_camera[:-stride], world_from_camera[stride:]], 1)
    return np.asarray(jax.vmap(actions_between)(pairs))[:, 0]


@dataclasses.dataclass(frozen=True)
class Steered:
    """The results: kind of actions → (C, N) mean squared colour errors of each imagined frame."""

    errors: Mapping[str, np.ndarray]
    walks: Walks

    @property
    def psnr(self) -> dict[str, np.ndarray]:
        """Return the PSNR of each clip in dB, by kind of actions."""
        return {name: np.asarray(psnr(each.mean(1))) for name, each in self.errors.items()}

    def table(self) -> dict[str, dict[str, Any]]:
        """Return means over houses with intervals, and the margins of the true actions."""
        return self._entries(self.psnr)

    def per_frame(self) -> dict[str, dict[str, Any]]:
        """Return ``table`` with a list over imagined frames in place of each number."""
        return self._entries({name: np.asarray(psnr(x)) for name, x in self.errors.items()})

    def facts(self) -> dict[str, Any]:
        """Return the results for ``metrics.json``; ``docs/evaluation.md`` describes them."""
        return {
            "clips": len(self.walks.choices),
            "forward": float(self.walks.forward_C.mean()),
            "different": float(self.walks.different_C.mean()),
            "all": self.table(),
            "per_frame": self.per_frame(),
        }

    def _entries(self, values: Mapping[str, np.ndarray]) -> dict[str, dict[str, Any]]:
        gains = {f"{TRUE} - {n}": values[TRUE] - x for n, x in values.items() if n != TRUE}
        return statistics.entries({**values, **gains}, self.walks.houses)

    def lines(self) -> list[str]:
        """Return the table as text."""
        out = [self.walks.about, "PSNR in dB, means over houses"]
        for name, found in self.table().items():
            low, high = found["low"], found["high"]
            span = "" if low is None else f"  [{low:.2f}, {high:.2f}]"
            out.append(f"  {name:<16} {found['mean']:6.2f}{span}")
        return out


def measure(
    config: Config, params: Params, episodes: Sequence[Episode], clips: int, *, seed: int = 0
) -> Steered:
    """Imagine at most ``clips`` walks with true, shuffled and no actions, all with the same noise.

    Raises:
        UserError: the episodes are too short, have no walks, or are all from one house.
    """
    pieces = _Pieces(config, params, episodes, choose_walks(config, episodes, clips), seed)
    with Meter("steering", len(pieces.keys) * pieces.size, "clips") as meter:
        found = {}
        for key in pieces.keys:
            found[key] = pieces.errors(*key)
            meter.advance(pieces.size)
    return pieces.joined(found)


def score(
    config: Config,
    params: Params,
    episodes: Sequence[Episode],
    choices: Sequence[ClipChoice],
    cache: ResultCache,
    log: Callable[[str], Any],
) -> tuple[Steered | None, str | None]:
    """Measure steering for a report; resumable, and shared among processes.

    As many walks as the report has clips are chosen from the same episodes. Returns the results and
    a description of the clips. If the episodes have no walks in two houses, the results are None
    and the description gives the reason; both are None if the model is not controlled by actions.
    """
    if not config.model.capabilities.silent_actions:
        return None, None
    if steered_by_record(config.model):
        return None, "Steering is not measured: it compares walks, and the actions are not planar."
    among = {choice.episode for choice in choices}
    try:
        walks = choose_walks(config, episodes, len(choices), config.evaluate.chain, among)
    except UserError as error:
        return None, f"Steering is not measured: {error}"
    pieces = _Pieces(config, params, episodes, walks, config.evaluate.seeds[0])

    def work(todo: list[tuple[str, int]]) -> Iterator[tuple[tuple[str, int], Any]]:
        log("imagining with true, shuffled and no actions …")
        for key in todo:
            yield key, {"errors": pieces.errors(*key)}

    found = map_resumable(
        pieces.keys,
        lambda key: f"steering-walks-{key[0]}-clip{key[1]:04d}",
        work,
        cache=cache,
        what="steering",
        workers=workers(),
    )
    return pieces.joined({key: piece["errors"] for key, piece in found.items()}), walks.about


class _Pieces:
    """The units of work: a kind of actions and a batch of clips, identified by its first clip."""

    def __init__(
        self,
        config: Config,
        params: Params,
        episodes: Sequence[Episode],
        walks: Walks,
        seed: int,
    ):
        self.config, self.params, self.seed = config, params, seed
        self.episodes, self.walks = episodes, walks
        self.size = min(config.evaluate.batch, len(walks.choices))
        self._silent = _with_zero_actions(config, params)
        self._imagine = jax.jit(_imagined, static_argnums=0)
        kinds = (TRUE, SHUFFLED, *([NONE] if self._silent is not None else []), COPY)
        starts = range(0, len(walks.choices), self.size)
        self.keys = [(kind, first) for kind in kinds for first in starts]

    def errors(self, kind: str, first: int) -> np.ndarray:
        """Return (clips, N) mean squared errors of a batch."""
        batch = slice(first, first + self.size)
        parts = [self._load(choice) for choice in self.walks.choices[batch]]
        context = stack([part[0] for part in parts], self.size)
        truth = stack([part[1] for part in parts], self.size)
        if kind == COPY:
            rgb = context.rgb_THWC[:, -1:]
        else:
            actions = [np.asarray(part[2]) for part in parts]
            if kind == SHUFFLED:
                actions = [np.asarray(self._load(one)[2]) for one in self.walks.others[batch]]
            weights = self._silent if kind == NONE else self.params
            filled = np.arange(first, first + self.size)
            given = stack(actions, self.size)
            rgb = self._imagine(self.config, weights, context, given, self.seed, filled)
        off = jnp.square(unit_colours(rgb) - unit_colours(truth.rgb_THWC))
        return np.asarray(off.mean((2, 3, 4)))[: len(parts)]

    def _load(self, choice: ClipChoice) -> Any:
        return load_clip(self.config, self.episodes, choice)

    def joined(self, found: Mapping[tuple[str, int], np.ndarray]) -> Steered:
        """Combine the errors of all pieces."""
        kinds = dict.fromkeys(kind for kind, _ in self.keys)
        errors = {
            k: np.concatenate([found[key] for key in self.keys if key[0] == k]) for k in kinds
        }
        return Steered(errors, self.walks)


def _imagined(
    config: Config, params: Params, context: Frames, actions: Array, seed: int, numbers_B: Array
) -> Array:
    """Return (B, N, H, W, 3) imagined colours."""

    def one(context: Frames, moves: Array, number: Array) -> Array:
        state = worlds.start(config, params, context)
        key = jax.random.fold_in(jax.random.key(seed), number)
        return worlds.imagine(config, params, state, moves, key)[1].rgb_THWC

    return jax.vmap(one)(context, actions, numbers_B)


def _with_zero_actions(config: Config, params: Params) -> Params | None:
    """Return weights whose control embeds every action as zero, or None without modulation."""
    if not config.model.capabilities.silent_actions or "control" not in params:
        return None
    return {**params, "control": jax.tree.map(jnp.zeros_like, params["control"])}
