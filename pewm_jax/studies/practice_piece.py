"""One unit of the practice study: one policy in one house; and the settings of the study.

A policy practises in an environment (``planning.practice``), its walks are stored as a dataset, it
is trained on them, and it is sent to goals in the real house.
"""

from __future__ import annotations

import dataclasses
import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pewm_jax.config import ActionConfig, Config
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.episodes import EpisodeArrays, write_episode
from pewm_jax.data.navigation import line_is_free
from pewm_jax.data.resume import SplitProgress
from pewm_jax.errors import require
from pewm_jax.eval.loaded_run import LoadedRun
from pewm_jax.geometry.actions import FORWARD, discrete_table
from pewm_jax.planning import practice, scores
from pewm_jax.planning.practice import (
    Act,
    ImaginedEnvironment,
    Practice,
    PracticeEnvironment,
    PracticeWalk,
    SimulatedEnvironment,
)
from pewm_jax.studies import goals
from pewm_jax.studies.deciders import LoadedPolicy, open_policy
from pewm_jax.studies.goals import Goal
from pewm_jax.train import loop

CHANCE, BEFORE, REAL, MEMORY, EMPTY = "chance", "before", "real", "memory", "empty"
LEARNED = (MEMORY, EMPTY, REAL)
"""The environments in which a policy practises."""
WITHIN_M, WITHIN_DEG = 0.35, 45.0
"""Distance and heading difference within which a goal counts as reached, as in Table 2."""
ROWS = (CHANCE, BEFORE, *LEARNED)


@dataclasses.dataclass(frozen=True)
class PracticeConfig:
    """The settings of the study.

    Attributes:
        houses: number of held-out houses.
        tasks: number of goals in each.
        actions: number of actions of the walk to a goal.
        most: largest number of actions of the policy per goal.
        replan: number of actions taken from a proposal before the next.
        steps: number of training steps on its walks.
        seeds: seeds of practice and training.
        shown: number of houses whose first walks are in the image.
    """

    houses: int = 12
    tasks: int = 12
    actions: int = 8
    most: int = 24
    replan: int = 4
    practice: Practice = dataclasses.field(default_factory=Practice)
    steps: int = 150
    learning_rate: float = 2e-4
    seeds: tuple[int, ...] = (0,)
    shown: int = 2

    def __post_init__(self):
        """Validate."""
        for name in ("houses", "tasks", "actions", "most", "replan", "steps"):
            value = getattr(self, name)
            require(value >= 1, f"{name} is {value}: use 1 or more.")
        require(
            len(self.seeds) > 0 and len(set(self.seeds)) == len(self.seeds),
            f"seeds are {self.seeds}: give different ones, such as 0 1 2.",
        )
        require(min(self.seeds) >= 0, f"seeds are {self.seeds}: use 0 or more.")
        require(self.shown >= 0, f"shown is {self.shown}: use 0 or more.")
        require(
            math.isfinite(self.learning_rate) and self.learning_rate > 0,
            f"learning_rate is {self.learning_rate}: use a number above 0.",
        )


def make(
    world: LoadedRun,
    begun: LoadedPolicy,
    study: PracticeConfig,
    house: int,
    how: str,
    seed: int,
    folder: Path,
) -> dict[str, Any]:
    """Return the scores of one policy in one house, and statistics of its practice.

    ``how`` is one of ``ROWS``; the folder is that of its walks and its training.

    Raises:
        UserError: a loss is not finite, or the folder contains walks with other settings.
    """
    home = open_home(study, world.config, house)
    piece: dict[str, Any] = {"house": home.house, "walked": {}}
    act = act_of(begun)
    if how == CHANCE:
        act = _random_walk_policy(begun.config.model.policy.waypoints)
    elif how != BEFORE:
        act = act_of(_learned(world, begun, home, study, how, seed, folder))
        piece["walked"] = _walk_statistics(folder / "data" / "train", home)
    return piece | {"tasks": _evaluate_policy(home, act, study, seed)}


def _random_walk_policy(count: int) -> Act:
    """Return a policy of random walks; see ``goals.wander``."""

    def act(rgb_SHWC: np.ndarray, goal_HWC: np.ndarray | None, key: jax.Array) -> np.ndarray:
        del rgb_SHWC, goal_HWC
        drawn = jax.random.key_data(key)
        return goals.wander(np.random.default_rng(np.asarray(drawn)), count)

    return act


def _walk_statistics(folder: Path, home: Goal) -> dict[str, float]:
    """Return the percentage of forward actions, and of these the percentage through walls."""
    forward, through, count = 0, 0, 0
    for episode in EpisodeSource(folder):
        ids = np.asarray(episode.action_ids)
        places = np.asarray(episode.world_from_camera)[:, :2, 3].astype(np.float64)
        for n in np.flatnonzero(ids == FORWARD):
            moved = np.linalg.norm(places[n + 1] - places[n]) > 1e-3
            through += moved and not line_is_free(home.simulator.grid, places[n], places[n + 1])
        forward, count = forward + int((ids == FORWARD).sum()), count + len(ids)
    return {
        "forward": 100.0 * forward / count,
        "through_walls": 100.0 * float(through) / max(forward, 1),
    }


def open_home(study: PracticeConfig, config: Config, house: int) -> Goal:
    """Return the first task of a house, whose context contains the agent's observations."""
    return goals.goal_of(config, house, study.houses, study.actions)


def place_of(world: LoadedRun, home: Goal, motion: ActionConfig, how: str) -> PracticeEnvironment:
    """Return the environment of practice: one of ``LEARNED``."""
    if how == REAL:
        return SimulatedEnvironment(home.simulator, motion, home.context)
    return ImaginedEnvironment(world.config, world.params, home.context, memory=how == MEMORY)


def act_of(policy: LoadedPolicy) -> Act:
    """Return a policy as an ``Act``, for practice and goals."""
    return practice.nomad(policy.config.model.policy, policy.weights, policy.motion)


def _learned(
    world: LoadedRun,
    begun: LoadedPolicy,
    home: Goal,
    study: PracticeConfig,
    how: str,
    seed: int,
    folder: Path,
) -> LoadedPolicy:
    """Let the policy practise, and return the trained policy."""
    place = place_of(world, home, begun.motion, how)
    _collect(folder / "data" / "train", place, home, begun, study, seed)
    config = begun.config
    stage = dataclasses.replace(
        config.train.policy,  # type: ignore[attr-defined]
        steps=study.steps,
        learning_rate=study.learning_rate,
        warmup=min(config.train.policy.warmup, study.steps // 10),  # type: ignore[attr-defined]
    )
    shutil.rmtree(folder / "run", ignore_errors=True)  # restart partial training: it is short
    train = dataclasses.replace(
        config.train, run=str(folder / "run"), start=str(begun.folder), seed=seed, policy=stage
    )
    data = dataclasses.replace(config.data, path=str(folder / "data"))
    loop.train(dataclasses.replace(config, train=train, data=data), log=lambda _: None)
    shutil.rmtree(folder / "run" / "checkpoints", ignore_errors=True)
    return open_policy(folder / "run")


def _collect(
    folder: Path,
    place: PracticeEnvironment,
    home: Goal,
    begun: LoadedPolicy,
    study: PracticeConfig,
    seed: int,
) -> None:
    """Write the walks of a practice as a dataset, unless they exist."""
    settings = {"made_by": "practice", "seed": seed, **dataclasses.asdict(study.practice)}
    path = folder / "shard-00000-of-00001.array_record"
    split = SplitProgress(folder, settings, {path: range(study.practice.walks)})
    if split.state == "complete":
        return
    split.prepare()
    table = discrete_table(begun.motion)

    def records() -> Iterator[bytes]:
        walks = practice.walks(place, home.context, act_of(begun), study.practice, seed)
        for number, walk in enumerate(walks):
            yield _record(walk, table, f"{home.house}-{number:04d}", home.house)

    if split.missing():
        split.write(path, records())
    split.publish()


def _record(walk: PracticeWalk, table_A3: np.ndarray, name: str, house: str) -> bytes:
    camera = walk.frames.camera
    arrays = EpisodeArrays(
        np.asarray(walk.frames.rgb_THWC),
        np.asarray(walk.frames.depth_THW, np.float32),
        np.asarray(camera.intrinsics_4)[0],
        np.asarray(camera.world_from_camera),
        table_A3[walk.actions_N].astype(np.float32),
        walk.actions_N.astype(np.int32),
    )
    return write_episode(arrays, name, house, {"policy": "practice"})


def _evaluate_policy(
    home: Goal, act: Act, study: PracticeConfig, seed: int
) -> list[dict[str, float]]:
    """Return the scores of a policy sent to goals near the observed places, in the real house.

    It is stopped as soon as it is within reach of the goal: it need not detect the goal.
    """
    scored = []
    for task in goals.near(home, study.tasks, study.actions):
        walked = [task.walk_T3[0]]
        pictures = [task.context.rgb_THWC[-1:]]
        key = jax.random.fold_in(jax.random.key(seed), task.number)
        reached, waiting = False, np.zeros(0, int)
        for number in range(study.most):
            if not len(waiting):
                seen = np.concatenate(pictures)
                goal = np.asarray(task.frame.rgb_THWC)[0]
                waiting = act(seen, goal, jax.random.fold_in(key, number))[: study.replan]
            step = goals.walked(task.simulator, task.table_A3, walked[-1], waiting[:1])[-1]
            waiting = waiting[1:]
            walked.append(step)
            pictures.append(task.simulator.frames(step[None]).rgb_THWC)
            reached = bool(scores.success(step, task.walk_T3[-1], WITHIN_M, WITHIN_DEG))
            if reached:
                break
        way = np.stack(walked)
        nearest = min(scores.position_error(pose, task.walk_T3[-1]) for pose in way)
        path = scores.path_length(way)
        scored.append(
            {
                "success": 100.0 * reached,
                "spl": 100.0 * float(scores.spl(reached, task.shortest_m, path)),
                "nearest": float(nearest),
                "sim": float(scores.sim(way[0], way[-1], task.walk_T3[-1])),
            }
        )
    return scored
