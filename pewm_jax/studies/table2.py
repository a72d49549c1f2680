"""Table 2 by one command: does a world model improve decisions, and does its memory?

Every method gets the same tasks. Every decision is a file, so the same command resumes. The table
is written as Markdown, LaTeX and CSV, with the curve of planning and videos of plans.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import functools
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pewm_jax import worlds
from pewm_jax.config import Config, UserError
from pewm_jax.eval import statistics
from pewm_jax.eval.loaded_run import LoadedRun, has_memory, open_run
from pewm_jax.io import atomic
from pewm_jax.io.progress import Meter
from pewm_jax.io.store import TABLE, ResultCache, require_same_inputs
from pewm_jax.planning import scores
from pewm_jax.planning.costs import FrameCost
from pewm_jax.planning.settings import PlanConfig
from pewm_jax.report.charts import METHOD_COLOURS, Line, LineChart
from pewm_jax.report.page import write_study
from pewm_jax.report.table import Cell, Table, score_cells
from pewm_jax.report.video import encode_h264, side_by_side
from pewm_jax.studies import deciders
from pewm_jax.studies.deciders import Policy, Predictors
from pewm_jax.studies.goals import Goal, goal_of
from pewm_jax.types import Params

WITHIN_M, WITHIN_DEG = 0.35, 45.0
"""Distance and heading difference within which a goal counts as reached: one step of 0.25 m or one
turn of 30° short of it."""
Log = Callable[[str], Any]
COLUMNS: Mapping[str, tuple[str, int]] = {
    "ate": ("ATE, m", 3),
    "rpe": ("RPE, m", 3),
    "position_error": ("final position, m", 3),
    "yaw_error": ("final heading, °", 1),
    "sim": ("SIM, %", 1),
    "success": ("success, %", 1),
    "spl": ("SPL, %", 1),
}
"""Score → heading, decimals."""
PAPER = (
    ("NoMaD", 4.94, 4.86, 36.8),
    ("NWM × 8", 4.82, 3.62, 59.7),
    ("PEWM × 8", 4.80, 3.58, 62.5),
    ("NWM × 16", 4.54, 3.51, 68.7),
    ("PEWM × 16", 4.47, 3.28, 70.8),
    ("PEWM, MPC", None, None, 87.5),
)
"""The paper's Table 2 (arXiv 2505.05495): ATE, RPE, SIM; MPC after about 720 samples."""
NOT_COMPARABLE = (
    "The paper specifies neither the distance of its goals nor its SIM; its policy is a NoMaD "
    "trained on its own walks. Only the order of the rows can be compared."
)


@dataclasses.dataclass(frozen=True)
class Table2Config:
    """The settings of a table.

    Attributes:
        tasks: number of tasks at each distance, one for all or one for each of ``multiples``.
        houses: number of held-out houses, which tasks use in turn.
        proposals: numbers of a policy's proposals that are ranked.
        plan: settings of the planner.
        videos: number of tasks shown as videos.
        multiples: distances of goals, in multiples of ``plan.actions`` actions.
        none: a run that was trained without memory, or "".
    """

    tasks: tuple[int, ...] = (48,)
    houses: int = 24
    proposals: tuple[int, ...] = (8, 16)
    plan: PlanConfig = dataclasses.field(default_factory=PlanConfig)
    policy: str = "wander"
    cost: str = "lpips"
    videos: int = 3
    multiples: tuple[int, ...] = (1, 2, 3)
    none: str = ""

    def tasks_by_multiple(self) -> dict[int, int]:
        """Return the number of tasks of each of ``multiples``."""
        counts = self.tasks * len(self.multiples) if len(self.tasks) == 1 else self.tasks
        return dict(zip(self.multiples, counts, strict=True))


def run(
    model: str | Path,
    out: Path,
    study: Table2Config,
    policy: Policy,
    cost: FrameCost,
    log: Log = print,
) -> Path:
    """Run every method on every task, and write the table.

    ``model`` is a run folder, or the name of weights that ship with the library; ``policy`` and
    ``cost`` are those named in ``study``.

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
    count = sum(study.tasks_by_multiple().values()) * len(methods)
    by_distance: dict[int, dict[str, list[dict[str, Any]]]] = {}
    with Meter("deciding", count, "decisions") as meter:
        for times, tasks in study.tasks_by_multiple().items():
            made: dict[str, list[dict[str, Any]]] = {name: [] for name in methods}
            by_distance[times * study.plan.actions] = made
            for number in range(tasks):
                goal: Goal | None = None
                for name in methods:
                    if name == "policy" and times > 1:
                        meter.advance(1, before=True)  # its row is of the first distance alone
                        continue
                    far = times * study.plan.actions
                    goal = goal or goal_of(config, number, study.houses, far)
                    decide = functools.partial(
                        _decide_and_score, name, goal, predictors, policy, cost, study
                    )
                    piece = f"{_folder(name, study, times, none)}/{number:04d}"
                    known = cache.get(piece)
                    found = cache.put(piece, decide()) if known is None else known
                    scores_here = _scored(goal, np.array(found["actions"]))
                    made[name].append(found | {"scores": scores_here})
                    meter.advance(1, before=known is not None)
    log(meter.summary())
    made = next(iter(by_distance.values()))
    results = summary(made) | {
        "distances": {
            str(actions): summary({name: each for name, each in found.items() if each})
            for actions, found in by_distance.items()
        },
        "about": about
        | {"date": dt.datetime.now(dt.UTC).date().isoformat(), "how": statistics.interval_facts()}
        | {"within_m": WITHIN_M, "within_deg": WITHIN_DEG, "model": str(model)},
    }
    atomic.write_text(out / "results.json", json.dumps(results, indent=1, allow_nan=False) + "\n")
    videos = _videos(out, study, config, params, made)
    page = out / "table2.md"
    write_page(results, page, videos)
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
    named = [each["house"] for each in next(iter(made.values()))]
    houses = np.unique(named, return_inverse=True)[1]
    values = {
        name: {m: np.array([one["scores"][m] for one in each]) for m in each[0]["scores"]}
        for name, each in made.items()
    }
    memory = {}
    for name in made:
        what, _, predictor = name.partition("-")
        if predictor == "memory":
            other = values[f"{what}-empty"]
            gains = {m: x - other[m] for m, x in values[name].items()}
            memory[what] = statistics.entries(gains, houses)
    curves = {}
    for name, each in made.items():
        if each[0]["curve"]:
            sims = {n: np.array([one["curve"][n] for one in each]) for n in each[0]["curve"]}
            curves[name] = statistics.entries(sims, houses)
    return {
        "rows": {
            name: statistics.entries(by, houses)
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
    for number in range(min(study.videos, len(made["mpc-memory"]))):
        actions = np.array(made["mpc-memory"][number]["actions"])
        file = out / f"plan{number}.mp4"
        if not file.exists():
            goal = goal_of(config, number, study.houses, study.plan.actions)
            _write_video(file, goal, config, params, actions)
        files.append(file)
    return files


def _write_video(
    file: Path, goal: Goal, config: Config, params: Params, actions_N: np.ndarray
) -> None:
    """Write the imagined plan, the real frames, and the walk to the goal, side by side."""
    state = worlds.start(config, params, goal.context)
    imagined = worlds.imagine(
        config, params, state, actions_N.astype(np.int32), jax.random.key(goal.number)
    )[1]
    happened = goal.simulator.frames(goal.walked(actions_N)[1:])
    expert = goal.simulator.frames(goal.walk_T3[1:])
    count = len(actions_N)
    target = np.repeat(goal.frame.rgb_THWC, count, 0), np.repeat(goal.frame.depth_THW, count, 0)
    columns = [
        ("goal", *target),
        ("planned", np.asarray(imagined.rgb_THWC), np.asarray(imagined.depth_THW)),
        ("happened", happened.rgb_THWC, happened.depth_THW),
        ("the walk to the goal", expert.rgb_THWC, expert.depth_THW),
    ]
    footers = [f"{goal.house}, action {step + 1} of {count}" for step in range(count)]
    frames = side_by_side(columns, footers, far_m=8.0)
    with atomic.replacing(file) as partial:
        partial.write_bytes(encode_h264(frames, 2))


def write_page(results: Mapping[str, Any], page: Path, videos: Sequence[Path]) -> None:
    """Write the table as ``page`` (Markdown) and, beside it, .tex, .csv and .png."""
    text, table = markdown(results, page.stem, videos), scores_table(results)
    write_study(page, text, table, numbers_table(results), chart(results))


def label(name: str) -> str:
    """Return a method's display name."""
    what, _, predictor = name.partition("-")
    words = {
        "empty": "the model, empty memory",
        "none": "a model trained without memory",
        "reproject": "reprojection, no network",
        "memory": "the model with its memory",
        "truth": "the renderer itself",
    }
    if what == "policy":
        return "policy alone"
    if what == "mpc":
        return f"one plan, open loop · {words[predictor]}"
    if what == "loop":
        return f"MPC, closed loop · {words[predictor]}"
    return f"ranking × {what.removeprefix('rank')} · {words[predictor]}"


def scores_table(results: Mapping[str, Any], *, seconds: bool = False) -> Table:
    """Return the scores of one distance, with the time per decision if asked."""
    header = ["method", *(heading for heading, _ in COLUMNS.values())]
    rows = [
        [
            label(name),
            *score_cells(COLUMNS, found),
            *([Cell(found["seconds"])] if seconds else []),
        ]
        for name, found in results["rows"].items()
    ]
    return Table.of([*header, *(["seconds"] if seconds else [])], rows)


def markdown(results: Mapping[str, Any], stem: str, videos: Sequence[Path]) -> str:
    """Return the page."""
    headings = [heading for heading, _ in COLUMNS.values()]
    gains = [
        [
            label(f"{what}-memory").split(" · ", maxsplit=1)[0],
            *score_cells(COLUMNS, entries, sign=True),
        ]
        for what, entries in results["memory_minus_empty"].items()
    ]
    theirs = [
        [name, *("–" if value is None else f"{value:g}" for value in values)]
        for name, *values in PAPER
    ]
    parts = [
        "# Table 2: does a world model help to decide, and does its memory?",
        _how(results),
        scores_table(results, seconds=True).markdown(),
        *_farther(results),
        "## What the memory adds\n\nWith memory minus empty, paired by task, 95 % intervals over "
        "houses; for errors lower is better.\n\n"
        + Table.of(["method", *headings], gains).markdown(),
        f"## The curve of planning\n\n![SIM against samples]({stem}.png)",
        "## Beside the paper\n\n"
        + Table.of(["", "ATE", "RPE", "SIM"], theirs).markdown()
        + f"\n\n{NOT_COMPARABLE}",
    ]
    if videos:
        shown = "\n".join(f"- [{video.name}]({video.name})" for video in videos)
        parts.append(f"## Planned and happened\n\n{shown}")
    return "\n\n".join(parts) + "\n"


def _farther(results: Mapping[str, Any]) -> list[str]:
    """Return a section for each distance but the first."""
    return [
        f"## Goals {actions} actions away\n\n"
        f"{found['tasks']} tasks in {found['houses']} houses.\n\n"
        f"{scores_table(found, seconds=True).markdown()}"
        for actions, found in list(results.get("distances", {}).items())[1:]
    ]


def _how(results: Mapping[str, Any]) -> str:
    about, plan = results["about"], results["about"]["plan"]
    return (
        f"{about['model']}; {results['tasks']} tasks in {results['houses']} held-out houses; the "
        f"goal is where a walk of {plan['horizon'] * plan['action_block']} actions ends. Policy: "
        f"{about['policy']}; cost: {about['cost']} to the goal image; plans by CEM with "
        f"{plan['candidates']} candidates, {plan['elites']} elites, {plan['rounds']} rounds. Open "
        "loop: one plan, executed completely. Closed loop: after each clip's actions the agent "
        "observes the real frames and plans the remaining actions again; at the end it may execute "
        "one more clip if that lowers the predicted cost. ATE and RPE against that walk, "
        "unaligned; SIM = 50 (max(0, 1 − remaining distance / distance) + 1 − heading error / π); "
        f"success within {about['within_m']:g} m and {about['within_deg']:g}°. Means over houses; "
        f"± is half of the 95 % interval (bootstrap over houses). {about['date']}."
    )


def numbers_table(results: Mapping[str, Any]) -> Table:
    """Return every number, one line per method and score."""
    rows = []
    for name, found in results["rows"].items():
        for score in COLUMNS:
            ends = (found[score][end] for end in ("mean", "low", "high"))
            rows.append([name, score, *("" if end is None else f"{end:.6g}" for end in ends)])
    return Table.of(["method", "score", "mean", "low", "high"], rows)


def chart(results: Mapping[str, Any]) -> LineChart:
    """Return SIM against samples for each predictor, with 95 % intervals."""
    curves = results["curves"]
    samples = sorted({int(count) for curve in curves.values() for count in curve})
    lines = []
    for name, curve in curves.items():
        entries = [curve.get(str(count), {}) for count in samples]
        mean, low, high = ([e.get(end) for e in entries] for end in ("mean", "low", "high"))
        predictor = name.partition("-")[2]
        text = label(name).split(" · ", maxsplit=1)[1]
        lines.append(Line(text, METHOD_COLOURS[predictor], mean, low, high))
    return LineChart(
        "SIM of the best plan so far, %",
        "samples",
        lines,
        x=samples,
        label_lines=True,
        size=(7.6, 4.0),
    )
