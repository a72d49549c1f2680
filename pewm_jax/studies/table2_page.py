"""Table 2 for readers: Markdown, LaTeX, CSV, the curve of planning, and videos of plans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from pewm_jax import worlds
from pewm_jax.config import Config
from pewm_jax.io import atomic
from pewm_jax.report.charts import METHOD_COLOURS, Line, LineChart
from pewm_jax.report.table import Cell, Table, with_half_width
from pewm_jax.report.video import encode_h264, side_by_side
from pewm_jax.studies.goals import Goal
from pewm_jax.types import Params

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


def write(results: Mapping[str, Any], page: Path, videos: Sequence[Path]) -> None:
    """Write the table as ``page`` (Markdown) and, beside it, .tex, .csv and .png."""
    atomic.write_text(page, markdown(results, page.stem, videos))
    atomic.write_text(page.with_suffix(".tex"), scores_table(results).latex())
    atomic.write_text(page.with_suffix(".csv"), numbers_table(results).csv())
    with atomic.replacing(page.with_suffix(".png")) as partial:
        partial.write_bytes(chart(results).png())


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


def score_cells(
    columns: Mapping[str, tuple[str, int]], entries: Mapping[str, Any], *, sign: bool = False
) -> list[Cell]:
    """Return the cells of scores: score → heading, decimals."""
    return [
        with_half_width(entries[score], digits, sign=sign) for score, (_, digits) in columns.items()
    ]


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
        f"## Goals {actions} actions away\n\n{scores_table(found, seconds=True).markdown()}"
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


def video(file: Path, goal: Goal, config: Config, params: Params, actions_N: np.ndarray) -> None:
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
