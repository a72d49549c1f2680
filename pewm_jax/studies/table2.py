"""Table 2 by one command: does a world model improve decisions, and does its memory?

Every method gets the same tasks. Every decision is a file, so the same command resumes.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import functools
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax.config import Config, UserError
from pewm_jax.eval import intervals
from pewm_jax.eval.loaded_run import LoadedRun, has_memory, open_run
from pewm_jax.io import atomic
from pewm_jax.io.progress import Meter
from pewm_jax.io.store import TABLE, ResultCache, require_same_inputs
from pewm_jax.planning import scores
from pewm_jax.planning.costs import FrameCost
from pewm_jax.planning.settings import PlanConfig
from pewm_jax.studies import deciders, table2_page
from pewm_jax.studies.deciders import Policy, Predictors
from pewm_jax.studies.goals import Goal, open_goal
from pewm_jax.types import Params

WITHIN_M, WITHIN_DEG = 0.35, 45.0
"""Distance and heading difference within which a goal counts as reached: one step of 0.25 m or one
turn of 30° short of it."""
Log = Callable[[str], Any]


@dataclasses.dataclass(frozen=True)
class Table2Config:
    """The settings of a table.

    Attributes:
        houses: number of held-out houses, which tasks use in turn.
        proposals: numbers of a policy's proposals that are ranked.
        plan: settings of the planner.
        videos: number of tasks shown as videos.
        multiples: distances of goals, in multiples of ``plan.actions`` actions.
        none: a run that was trained without memory, or "".
    """

    tasks: int = 48
    houses: int = 24
    proposals: tuple[int, ...] = (8, 16)
    plan: PlanConfig = dataclasses.field(default_factory=PlanConfig)
    policy: str = "wander"
    cost: str = "lpips"
    videos: int = 3
    multiples: tuple[int, ...] = (1, 2, 3)
    none: str = ""


def run(
    model: str | Path,
    out: Path,
    study: Table2Config,
    policy: Policy,
    cost: FrameCost,
    log: Log = print,
) -> Path:
    """Run every method on every task, and write the table.

    Args:
        model: a run folder, or the name of weights that ship with the library.
        out: the output folder.
        study: the settings.
        policy: the policy named in ``study``.
        cost: the cost named in ``study``.
        log: prints a line.

    Returns:
        The path of the table in Markdown; in the same folder .tex, .csv, .png, videos and
        ``results.json``.

    Raises:
        UserError: the weights are missing, the folder contains decisions with other settings, a
            cost is not finite, or a house is too small.
    """
    opened = open_run(model)
    config, params = opened.config, opened.params
    if not has_memory(opened):
        raise UserError(f"{model} has no memory, but the table measures the effect of a memory.")
    if study.plan.actions % (config.model.clip.frames - 1):
        raise UserError(
            f"plans have {study.plan.actions} actions, but {model} imagines "
            f"{config.model.clip.frames - 1} frames at once: use a multiple."
        )
    about = dataclasses.asdict(study) | {
        "weights": deciders.model_digest(opened.weights_hash, config)
    }
    if config.model.clip.height != config.model.clip.width:
        size = f"{config.model.clip.width}×{config.model.clip.height}"
        raise UserError(f"{model} imagines images of {size}, but Table 2 needs square ones.")
    require_same_inputs(out, about, "decisions", ADDED)
    cache = ResultCache(out, TABLE)
    none = open_run(study.none) if study.none else None
    if none is not None:
        _require_alike(none, opened, study.none, model)
    predictors = Predictors(config, params, none=(none.config, none.params) if none else None)
    methods = deciders.method_names(study.proposals, predictors.names)
    count = len(study.multiples) * study.tasks * len(methods)
    by_distance: dict[int, dict[str, list[dict[str, Any]]]] = {}
    with Meter("deciding", count, "decisions") as meter:
        for times in study.multiples:
            made: dict[str, list[dict[str, Any]]] = {name: [] for name in methods}
            by_distance[times * study.plan.actions] = made
            for number in range(study.tasks):
                goal: Goal | None = None
                for name in methods:
                    if name == "policy" and times > 1:
                        meter.advance(1)
                        continue
                    goal = goal or _goal(study, config, number, times)
                    decide = functools.partial(
                        _decide_and_score, name, goal, predictors, policy, cost, study
                    )
                    piece = f"{_folder(name, study, times, none)}/{number:04d}"
                    found = cache.compute(piece, decide)
                    scores_here = _scored(goal, np.array(found["actions"]))
                    made[name].append(found | {"scores": scores_here})
                    meter.advance(1)
    log(meter.summary())
    made = next(iter(by_distance.values()))
    results = summary(made) | {
        "distances": {
            str(actions): summary({name: each for name, each in found.items() if each})
            for actions, found in by_distance.items()
        },
        "about": about
        | {"date": dt.datetime.now(dt.UTC).date().isoformat(), "how": intervals.how()}
        | {"within_m": WITHIN_M, "within_deg": WITHIN_DEG, "model": str(model)},
    }
    text = json.dumps(results, indent=1, allow_nan=False)
    atomic.write_text(out / "results.json", text + "\n")
    videos = _videos(out, study, config, params, made)
    page = out / "table2.md"
    table2_page.write(results, page, videos)
    return page


ADDED = ("tasks", "videos", "policy", "proposals", "multiples", "none")
"""Settings that may change between calls: decisions do not depend on them, or contain them in their
name."""


def _folder(name: str, study: Table2Config, times: int, none: LoadedRun | None) -> str:
    """Return the folder of a method's decisions; plans do not depend on the policy."""
    planned = name.startswith(("mpc", "loop"))
    whose = "" if planned else f"{study.policy.replace(':', '.')}/"
    far = f"{times * study.plan.actions}-actions/" if times > 1 else ""
    own = f"-{none.weights_hash[:8]}" if none and name.endswith("-none") else ""
    return f"decisions/{far}{whose}{name}{own}"


def _require_alike(none: LoadedRun, opened: LoadedRun, name: str, model: str | Path) -> None:
    """Raise an error if the model without memory has a memory, or does not fit the other."""
    if has_memory(none):
        raise UserError(f"{name} was trained with a memory: use a run trained only in stage 1.")
    one, other = none.config.model, opened.config.model
    if (one.clip, one.actions) != (other.clip, other.actions):
        raise UserError(
            f"{name} has other clips or actions than {model}: train it with the same settings."
        )


def _goal(study: Table2Config, config: Config, number: int, times: int = 1) -> Goal:
    return open_goal(
        number,
        houses=study.houses,
        actions=times * study.plan.actions,
        context=config.data.context,
        motion=config.model.actions,
        size=config.model.clip.height,
    )


def _decide_and_score(
    name: str,
    goal: Goal,
    predictors: Predictors,
    policy: Policy,
    cost: FrameCost,
    study: Table2Config,
) -> dict[str, Any]:
    """Return a method's decision, the resulting poses and their scores."""
    began = time.perf_counter()
    blocks = len(goal.expert_N) // study.plan.action_block
    config = dataclasses.replace(study.plan, horizon=blocks)
    choice = deciders.decide(name, goal, predictors, policy, cost, config)
    seconds = time.perf_counter() - began
    curve = {str(n): _scored(goal, actions)["sim"] for n, actions in choice.found.items()}
    return {
        "house": goal.house,
        "actions": [int(action) for action in choice.actions_N],
        "foreseen": choice.foreseen,
        "seconds": seconds,
        "curve": curve,
    }


def _scored(goal: Goal, actions_N: np.ndarray) -> dict[str, float]:
    """Return the scores of the poses along actions."""
    made, true = goal.walked(actions_N), goal.walk_T3
    reached = scores.success(made[-1], true[-1], WITHIN_M, WITHIN_DEG)
    along = made[: len(true)]  # a closed loop may have more actions
    return {
        "ate": scores.ate(true, along),
        "rpe": scores.rpe(true, along),
        "position_error": scores.position_error(made[-1], true[-1]),
        "yaw_error": float(np.degrees(scores.yaw_error(made[-1], true[-1]))),
        "sim": scores.sim(true[0], made[-1], true[-1]),
        "success": 100.0 * reached,
        "spl": 100.0 * scores.spl(reached, goal.shortest_m, scores.path_length(made)),
    }


def summary(made: Mapping[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Return means over houses with intervals, what memory adds, paired by task, and curves."""
    houses = np.unique([each["house"] for each in next(iter(made.values()))], return_inverse=True)[
        1
    ]
    values = {
        name: {m: np.array([one["scores"][m] for one in each]) for m in each[0]["scores"]}
        for name, each in made.items()
    }
    memory = {}
    for name in made:
        what, _, predictor = name.partition("-")
        if predictor == "memory":
            other = values[f"{what}-empty"]
            memory[what] = {
                m: intervals.entry(values[name][m] - other[m], houses) for m in values[name]
            }
    curves = {}
    for name, each in made.items():
        if each[0]["curve"]:
            curves[name] = {
                n: intervals.entry(np.array([one["curve"][n] for one in each]), houses)
                for n in each[0]["curve"]
            }
    return {
        "rows": {
            name: {m: intervals.entry(x, houses) for m, x in by.items()}
            | {"seconds": float(np.median([one["seconds"] for one in made[name]]))}
            for name, by in values.items()
        },
        "memory_minus_empty": memory,
        "curves": curves,
        "tasks": len(houses),
        "houses": len(set(houses.tolist())),
    }


def _videos(
    out: Path,
    study: Table2Config,
    config: Config,
    params: Params,
    made: Mapping[str, list[dict[str, Any]]],
) -> list[Path]:
    """Write videos of the imagined plan and the real frames, side by side."""
    files = []
    for number in range(min(study.videos, study.tasks)):
        actions = np.array(made["mpc-memory"][number]["actions"])
        file = out / f"plan{number}.mp4"
        if not file.exists():
            goal = _goal(study, config, number)
            table2_page.video(file, goal, config, params, actions)
        files.append(file)
    return files
