"""Table 2 for readers: Markdown, LaTeX, CSV, the curve of planning, and videos of plans."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from PIL import Image, ImageDraw

from pewm_jax import worlds
from pewm_jax.config import Config
from pewm_jax.io import atomic
from pewm_jax.report import pictures
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
COLOURS = {
    "empty": (232, 115, 26),
    "none": (176, 60, 60),
    "reproject": (46, 139, 87),
    "memory": (31, 111, 235),
    "truth": (90, 96, 105),
}


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
        "none": "a model trained without memory",
        "reproject": "reprojection, no network",
        "memory": "the model with its memory",
        "truth": "the renderer itself",
    }
    if what == "policy":
        return "policy alone"
    if what == "mpc":
        return f"one plan, open loop · {words[mind]}"
    if what == "loop":
        return f"MPC, closed loop · {words[mind]}"
    return f"ranking × {what.removeprefix('rank')} · {words[mind]}"


def cell(entry: Mapping[str, Any], decimals: int, *, signed: bool = False) -> str:
    """Return a mean with half of its interval, where there is one."""
    sign = "+" if signed else ""
    mean = f"{entry['mean']:{sign}.{decimals}f}"
    if entry["low"] is None:
        return mean
    return f"{mean} ± {(entry['high'] - entry['low']) / 2:.{decimals}f}"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "\n".join(f"| {' | '.join(x)} |" for x in (header, ["---"] * len(header), *rows))


def markdown(results: Mapping[str, Any], stem: str, videos: Sequence[Path]) -> str:
    """Return the page."""
    headings = [heading for heading, _ in COLUMNS.values()]
    rows = _rows(results)
    gains = [
        [
            label(f"{what}-memory").split(" · ", maxsplit=1)[0],
            *(cell(by[m], digits, signed=True) for m, (_, digits) in COLUMNS.items()),
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
        table(["method", *headings, "seconds"], rows),
        *_farther(results),
        "## What the memory adds\n\nWith memory minus empty, paired by task, 95 % intervals over "
        "houses; of errors less is better.\n\n" + table(["method", *headings], gains),
        f"## The curve of planning\n\n![SIM against samples]({stem}.png)",
        "## Beside the paper\n\n"
        + table(["", "ATE", "RPE", "SIM"], theirs)
        + f"\n\n{NOT_COMPARABLE}",
    ]
    if videos:
        shown = "\n".join(f"- [{video.name}]({video.name})" for video in videos)
        parts.append(f"## Planned and happened\n\n{shown}")
    return "\n\n".join(parts) + "\n"


def _rows(results: Mapping[str, Any]) -> list[list[str]]:
    """Return the rows of one distance."""
    return [
        [
            label(name),
            *(cell(row[m], digits) for m, (_, digits) in COLUMNS.items()),
            f"{row['seconds']:.2f}",
        ]
        for name, row in results["rows"].items()
    ]


def _farther(results: Mapping[str, Any]) -> list[str]:
    """Return a section for each distance but the first."""
    header = ["method", *(heading for heading, _ in COLUMNS.values()), "seconds"]
    return [
        f"## Goals {actions} actions away\n\n{table(header, _rows(found))}"
        for actions, found in list(results.get("distances", {}).items())[1:]
    ]


def _how(results: Mapping[str, Any]) -> str:
    about, plan = results["about"], results["about"]["plan"]
    return (
        f"{about['model']}; {results['tasks']} tasks in {results['houses']} held-out houses; the "
        f"goal is where a walk of {plan['horizon'] * plan['action_block']} actions ends. Policy: "
        f"{about['policy']}; cost: {about['cost']} to the goal's picture; plans by CEM with "
        f"{plan['candidates']} candidates, {plan['elites']} elites, {plan['rounds']} rounds. Open "
        "loop: one plan, carried out whole. Closed loop: after each clip's actions the agent "
        "observes what is really seen and plans the rest anew; at the end it may correct by one "
        "more clip, where that is foreseen to cost less. ATE and RPE against that walk, unaligned; "
        "SIM = 50 (max(0, 1 − what is left "
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
        cells = [cell(row[m], digits) for m, (_, digits) in COLUMNS.items()]
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


SHARP = 4
"""Lines are drawn so many times as large, then made smaller, so that they are smooth."""
APART = 15
"""Least pixels between the names of two curves."""


def plot(results: Mapping[str, Any]) -> np.ndarray:
    """Draw SIM against samples for each mind, with 95 % intervals; (H, W, 3) uint8."""
    wide, tall, left, top, bottom = 760, 400, 70, 60, 60
    curves = results["curves"]
    most = max(int(count) for curve in curves.values() for count in curve)
    means = [entry["mean"] for curve in curves.values() for entry in curve.values()]
    low, high = 10 * math.floor(min(means) / 10 - 0.5), 100

    def place(count: float, value: float) -> tuple[float, float]:
        x = left + count / most * (wide - left - 190)
        return x, tall - bottom - (value - low) / (high - low) * (tall - top - bottom)

    large = Image.new("RGB", (SHARP * wide, SHARP * tall), (255, 255, 255))
    lines = ImageDraw.Draw(large, "RGBA")

    def at(points: Iterable[tuple[str, float]]) -> list[tuple[float, float]]:
        placed = (place(int(count), min(max(value, low), high)) for count, value in points)
        return [(SHARP * x, SHARP * y) for x, y in placed]

    for tick in range(low, high + 1, 10):
        lines.line(at([("0", tick), (str(most), tick)]), fill=(228, 228, 228), width=SHARP)
    for name, curve in curves.items():
        colour = COLOURS[name.partition("-")[2]]
        if all(entry["low"] is not None for entry in curve.values()):
            under = at((count, entry["low"]) for count, entry in curve.items())
            over = at((count, entry["high"]) for count, entry in curve.items())
            if len(curve) > 1:
                lines.polygon([*under, *reversed(over)], fill=(*colour, 34))
        lines.line(
            at((count, entry["mean"]) for count, entry in curve.items()),
            fill=colour,
            width=3 * SHARP,
            joint="curve",
        )
    canvas = large.resize((wide, tall), Image.Resampling.LANCZOS)
    draw = ImageDraw.Draw(canvas)
    pictures.write(draw, (16, 22), "SIM of the best plan so far, %", size=17)
    for tick in range(low, high + 1, 10):
        pictures.write(draw, (left - 12, place(0, tick)[1]), str(tick), anchor="rm")
    for count in sorted({int(c) for curve in curves.values() for c in curve}):
        x = place(count, low)[0]
        pictures.write(draw, (x, tall - bottom + 14), str(count), size=11, anchor="mm")
    pictures.write(draw, (place(most / 2, low)[0], tall - 18), "samples", anchor="mm")
    ends = {name: place(most, list(curve.values())[-1]["mean"]) for name, curve in curves.items()}
    lowest = -float(APART)
    for name, (x, y) in sorted(ends.items(), key=lambda end: end[1][1]):
        lowest = max(y, lowest + APART)
        mind = name.partition("-")[2]
        words = label(name).split(" · ", maxsplit=1)[1]
        pictures.write(draw, (x + 10, lowest), words, size=13, colour=COLOURS[mind])
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
