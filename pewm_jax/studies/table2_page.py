"""Table 2 for readers: Markdown, LaTeX, CSV, the curve of planning, and videos of plans."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from PIL import Image, ImageDraw

from pewm_jax import atomic, worlds
from pewm_jax.config import Config
from pewm_jax.evaluation import pictures
from pewm_jax.evaluation.video import encode_h264, side_by_side
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
LOWER = ("ate", "rpe", "position_error", "yaw_error")
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
    "The paper does not say how far its goals are, nor what its SIM is; its policy is a NoMaD "
    "trained on its own walks. Only the order of the rows can be compared."
)
COLOURS = {"empty": (232, 115, 26), "memory": (31, 111, 235), "truth": (90, 96, 105)}


def write(results: Mapping[str, Any], page: Path, videos: Sequence[Path]) -> None:
    """Write the table as ``page`` (Markdown) and, beside it, .tex, .csv and .png."""
    atomic.write_text(page, markdown(results, page.stem, videos))
    atomic.write_text(page.with_suffix(".tex"), latex(results))
    atomic.write_text(page.with_suffix(".csv"), as_csv(results))
    pictures.save_png(page.with_suffix(".png"), plot(results))


def label(name: str) -> str:
    """Return a method's name for people."""
    what, _, mind = name.partition("-")
    words = {
        "empty": "the model, empty memory",
        "memory": "the model with its memory",
        "truth": "the renderer itself",
    }
    if what == "policy":
        return "policy alone"
    if what == "mpc":
        return f"MPC · {words[mind]}"
    return f"ranking × {what.removeprefix('rank')} · {words[mind]}"


def _cell(entry: Mapping[str, Any], decimals: int, *, signed: bool = False) -> str:
    sign = "+" if signed else ""
    mean = f"{entry['mean']:{sign}.{decimals}f}"
    if entry["low"] is None:
        return mean
    return f"{mean} ± {(entry['high'] - entry['low']) / 2:.{decimals}f}"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(x)} |" for x in (header, ["---"] * len(header), *rows))


def markdown(results: Mapping[str, Any], stem: str, videos: Sequence[Path]) -> str:
    """Return the page."""
    headings = [heading for heading, _ in COLUMNS.values()]
    rows = [
        [
            label(name),
            *(_cell(row[m], digits) for m, (_, digits) in COLUMNS.items()),
            f"{row['seconds']:.2f}",
        ]
        for name, row in results["rows"].items()
    ]
    gains = [
        [
            label(f"{what}-memory").split(" · ", maxsplit=1)[0],
            *(_cell(by[m], digits, signed=True) for m, (_, digits) in COLUMNS.items()),
        ]
        for what, by in results["memory_minus_empty"].items()
    ]
    theirs = [
        [name, *("–" if value is None else f"{value:g}" for value in values)]
        for name, *values in PAPER
    ]
    parts = [
        "# Table 2: does a world model help to decide, and does its memory?",
        _how(results),
        _table(["method", *headings, "seconds"], rows),
        "## What the memory adds\n\nWith memory minus empty, paired by task, 95 % intervals over "
        "houses; of errors less is better.\n\n" + _table(["method", *headings], gains),
        f"## The curve of planning\n\n![SIM against samples]({stem}.png)",
        "## Beside the paper\n\n"
        + _table(["", "ATE", "RPE", "SIM"], theirs)
        + f"\n\n{NOT_COMPARABLE}",
    ]
    if videos:
        shown = "\n".join(f"- [{video.name}]({video.name})" for video in videos)
        parts.append(f"## Planned and happened\n\n{shown}")
    return "\n\n".join(parts) + "\n"


def _how(results: Mapping[str, Any]) -> str:
    about, plan = results["about"], results["about"]["plan"]
    return (
        f"{about['model']}; {results['tasks']} tasks in {results['houses']} held-out houses; the "
        f"goal is where a walk of {plan['horizon'] * plan['action_block']} actions ends. Policy: "
        f"{about['policy']}; cost: {about['cost']} to the goal's picture; MPC: one plan of "
        f"{plan['candidates']} candidates, {plan['elites']} elites, {plan['rounds']} rounds, "
        "carried out. ATE and RPE against that walk, unaligned; SIM = 50 (max(0, 1 − what is left "
        "/ the way) + 1 − heading error / π); success within "
        f"{about['within_m']:g} m and {about['within_deg']:g}°. Means over houses; ± is half of "
        f"the 95 % interval (bootstrap over houses). {about['date']}."
    )


def latex(results: Mapping[str, Any]) -> str:
    """Return the table for LaTeX, with booktabs."""
    heads = [heading.replace("%", r"\%") for heading, _ in COLUMNS.values()]
    lines = [
        r"\begin{tabular}{l" + "r" * len(COLUMNS) + "}",
        r"\toprule",
        " & ".join(["method", *heads]) + r" \\",
        r"\midrule",
    ]
    for name, row in results["rows"].items():
        cells = [_cell(row[m], digits) for m, (_, digits) in COLUMNS.items()]
        words = label(name).replace("·", "--").replace("×", r"$\times$")
        lines.append(" & ".join([words, *(c.replace("±", r"$\pm$") for c in cells)]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def as_csv(results: Mapping[str, Any]) -> str:
    """Return every number, a line for each method and score."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["method", "score", "mean", "low", "high"])
    for name, row in results["rows"].items():
        for score in COLUMNS:
            ends = (row[score][end] for end in ("mean", "low", "high"))
            shown = ["" if value is None else f"{value:.6g}" for value in ends]
            writer.writerow([name, score, *shown])
    return file.getvalue()


def plot(results: Mapping[str, Any]) -> np.ndarray:
    """Draw SIM against samples for each mind; returns a (H, W, 3) uint8 picture."""
    wide, tall, left, top, bottom = 760, 400, 70, 60, 60
    canvas = Image.new("RGB", (wide, tall), (255, 255, 255))
    draw = ImageDraw.Draw(canvas)
    curves = results["curves"]
    most = max(int(count) for curve in curves.values() for count in curve)
    means = [entry["mean"] for curve in curves.values() for entry in curve.values()]
    low, high = 10 * math.floor(min(means) / 10 - 0.5), 100

    def place(count: float, value: float) -> tuple[float, float]:
        x = left + count / most * (wide - left - 190)
        return x, tall - bottom - (value - low) / (high - low) * (tall - top - bottom)

    pictures.write(draw, (16, 22), "SIM of the best plan so far, %", size=17)
    for tick in range(low, high + 1, 10):
        draw.line([place(0, tick), place(most, tick)], fill=(228, 228, 228))
        pictures.write(draw, (left - 12, place(0, tick)[1]), str(tick), anchor="rm")
    for count in sorted({int(c) for curve in curves.values() for c in curve}):
        x = place(count, low)[0]
        pictures.write(draw, (x, tall - bottom + 14), str(count), size=11, anchor="mm")
    pictures.write(draw, (place(most / 2, low)[0], tall - 18), "samples", anchor="mm")
    for name, curve in curves.items():
        mind = name.partition("-")[2]
        points = [place(int(count), entry["mean"]) for count, entry in curve.items()]
        draw.line(points, fill=COLOURS[mind], width=3)
        pictures.write(draw, (points[-1][0] + 10, points[-1][1]), mind, colour=COLOURS[mind])
    return np.asarray(canvas)


def video(file: Path, goal: Goal, config: Config, params: Params, actions_N: np.ndarray) -> None:
    """Write what a plan imagines, what happened, and the walk to the goal, side by side."""
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
