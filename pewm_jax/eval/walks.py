"""Clips that can show whether actions steer a world, each with a clip of other actions.

Planar actions: in every clip at least half of the steps go forward, because a turn in place
replaces the whole view after a few frames, whatever the actions are. Recorded actions of another
kind, such as joint angles: any clip, because an agent that stands and moves its arms is of interest
too. The shuffled actions, of a clip in another house, differ from the true ones in at least half of
the steps.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Sequence

import jax
import numpy as np

from pewm_jax.config import ActionConfig, Config, UserError
from pewm_jax.data.episodes import Episode
from pewm_jax.eval.clips import ClipChoice, choice_of, return_start, steered_by_record
from pewm_jax.geometry.actions import actions_between

LEAST_FORWARD = 0.5
"""Smallest share of a clip's steps that go forward."""
LEAST_DIFFERENT = 0.5
"""Smallest share of a clip's steps in which the shuffled actions differ from the true ones."""
MOVED = 0.1
"""Forward motion, in steps of ``ActionConfig.step_m``, up to which the agent counts as standing
still."""
APART = 0.5
"""Smallest difference between two motions that counts, in units of a step or a turn."""
APART_RECORDED = 0.7
"""Smallest difference between recorded actions that counts, in standard deviations."""


@dataclasses.dataclass(frozen=True)
class Walks:
    """Clips that are walks, each with a clip of another house that has different actions.

    ``forward_C`` is the share of each clip's steps that go forward, ``different_C`` the share in
    which the shuffled actions, of ``others``, differ from the true ones. ``recorded`` says that the
    actions are not planar, and that clips need not go forward.

    Raises:
        ValueError: a share is below its limit, or both clips of a pair are from one house.
    """

    choices: list[ClipChoice]
    others: list[ClipChoice]
    forward_C: np.ndarray
    different_C: np.ndarray
    recorded: bool = False

    def __post_init__(self):
        """Check the properties on which the measurement relies."""
        pairs = zip(self.choices, self.others, strict=True)
        if any(one.scene == other.scene for one, other in pairs):
            raise ValueError("the shuffled actions of a clip come from its own house")
        if not self.recorded and np.any(self.forward_C < LEAST_FORWARD):
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
        what = "clips" if self.recorded else "walks"
        return (
            f"{len(self.choices)} {what} in {len(set(self.houses))} houses: "
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


def different_records(one_NA: np.ndarray, two_NA: np.ndarray, spread_A: np.ndarray) -> np.ndarray:
    """Return (...) bool: whether recorded actions (..., A) differ.

    They do if the mean square of their differences, in units of each number's standard deviation
    over all clips, is at least ``APART_RECORDED`` squared; for independent actions it is about 2.
    """
    apart = (np.asarray(one_NA) - np.asarray(two_NA)) / np.maximum(spread_A, 1e-6)
    return np.sqrt((apart**2).mean(-1)) >= APART_RECORDED


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
    recorded = steered_by_record(config.model)
    count = chain * (config.model.clip.frames - 1)
    where = f"{config.data.path}/{config.evaluate.split}"
    indices = sorted(set(range(len(episodes)) if among is None else among))
    per_episode = -(-clips // max(len(indices), 1))
    pool: list[ClipChoice] = []
    motions: list[np.ndarray] = []
    records: list[np.ndarray] = []
    ranked: list[tuple[int, int]] = []
    for index in indices:
        episode = episodes[index]
        last = episode.length - 1 - count * stride
        if last < 0:
            continue
        starts = np.arange(min(return_start(episode), last), last + 1)
        steps_SN = starts[:, None] + stride * np.arange(count)
        motion_SN3 = _motion(episode.world_from_camera, stride)[steps_SN]
        enough = 0.0 if recorded else LEAST_FORWARD
        walking = np.flatnonzero(forward_steps(units, motion_SN3).mean(1) >= enough)
        if walking.size:
            spread = np.linspace(0, len(walking) - 1, per_episode)
            for rank, at in enumerate(np.unique(np.round(spread).astype(int))):
                ranked.append((rank, len(pool) + int(walking[at])))
        pool += [choice_of(config, episode, index, int(start), count) for start in starts]
        motions.append(motion_SN3)
        if recorded:
            records.append(_records(episode, steps_SN, stride))
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
    motion_PN3, scenes = np.concatenate(motions), [choice.scene for choice in pool]
    moves, differ = motion_PN3, functools.partial(different_steps, units)
    if recorded:
        moves = np.concatenate(records)
        differ = functools.partial(different_records, spread_A=moves.std((0, 1)))
    chosen, others, different = _with_partners(sorted(ranked), scenes, moves, differ, clips)
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
        recorded,
    )


def _with_partners(
    ranked: Sequence[tuple[int, int]],
    scenes: Sequence[str],
    moves_PNA: np.ndarray,
    differ: Callable[..., np.ndarray],
    clips: int,
) -> tuple[list[int], list[int], list[float]]:
    """Return the places of at most ``clips`` clips, of their partners, and the shares of steps.

    ``ranked`` are ranks and places in the pool of clips, whose actions are ``moves_PNA``.
    """
    houses = np.array(scenes)
    chosen, others, different = [], [], []
    for _, place in ranked:
        share_P = differ(moves_PNA, moves_PNA[place]).mean(1)
        able = np.flatnonzero((houses != houses[place]) & (share_P >= LEAST_DIFFERENT))
        if able.size and len(chosen) < clips:
            other = int(np.random.default_rng([0, place]).choice(able))
            chosen.append(place)
            others.append(other)
            different.append(float(share_P[other]))
    return chosen, others, different


def _records(episode: Episode, steps_SN: np.ndarray, stride: int) -> np.ndarray:
    """Return (S, N, stride · A) the recorded actions that lead from frames (S, N) to the next."""
    if episode.actions is None:
        raise UserError(f"episode {episode.name} has no actions: import the data with them.")
    found = np.asarray(episode.actions)[steps_SN[..., None] + np.arange(stride)]
    return found.reshape(*steps_SN.shape, -1)


def _motion(world_from_camera: np.ndarray, stride: int) -> np.ndarray:
    """Return (T - stride, 3) the planar motion from each frame to the one ``stride`` later."""
    pairs = np.stack([world_from_camera[:-stride], world_from_camera[stride:]], 1)
    return np.asarray(jax.vmap(actions_between)(pairs))[:, 0]
