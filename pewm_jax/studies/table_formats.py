"""Table 1 in LaTeX, as CSV, and as a picture."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from pewm_jax.report import pictures
from pewm_jax.studies.table import LOWER
from pewm_jax.studies.table_cells import (
    PLACES,
    TRUTH,
    best_of,
    cell,
    columns_of,
    floor_of,
    heading,
    label,
    number_words,
    place_floor,
    rows_of,
)


def latex(results: Mapping[str, Any]) -> str:
    """Return the table for LaTeX, with booktabs."""
    names, columns = rows_of(results), columns_of(results)
    best = {measure: best_of(results, names, measure) for measure in columns}
    arrows = {m: r"$\downarrow$" if m.split("/")[0] in LOWER else r"$\uparrow$" for m in columns}
    head = " & ".join(["memory, reader", *(f"{heading(results, m)} {arrows[m]}" for m in columns)])
    lines = [
        r"\begin{tabular}{l" + "r" * len(columns) + "}",
        r"\toprule",
        head + r" \\",
        r"\midrule",
    ]
    for name in names:
        cells = []
        for measure in columns:
            mean, half = cell(results, name, measure)
            text = _tex(mean) + (rf" {{\tiny $\pm$ {half}}}" if half else "")
            cells.append(rf"\textbf{{{text}}}" if best[measure] == name else text)
        words = label(results, name).replace("·", "--")
        lines.append(" & ".join([words, *cells]) + r" \\")
    lines.append(r"\midrule")
    for words, found in ((TRUTH, floor_of), (PLACES, place_floor)):
        numbers = [_tex(number_words(found(results, each), each)) for each in columns]
        lines.append(" & ".join([words, *numbers]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def _tex(number: str) -> str:
    return "--" if number == "–" else number.replace("-", "$-$")


def as_csv(results: Mapping[str, Any]) -> str:
    """Return every number of the table, a line for each row and measure."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    header = ["row", "measure", "mean", "low", "high", "interval_over", "seeds", "per_seed"]
    writer.writerow(header)
    for name in rows_of(results):
        row = results["rows"][name]
        for measure, entry in row["measures"].items():
            over = entry if "low" in entry else entry["over_seeds"]
            kind = results["about"]["house"] + "s" if over is entry else "seeds"
            seeds = " ".join(f"{value:.6g}" for value in entry.get("per_seed", ()))
            ends = (entry["mean"], over["low"], over["high"])
            shown = ["" if value is None else f"{value:.6g}" for value in ends]
            writer.writerow([name, measure, *shown, kind, row["seeds"], seeds])
    for measure in columns_of(results):
        for name, found in ((TRUTH, floor_of), (PLACES, place_floor)):
            number = found(results, measure)
            if number is not None:
                writer.writerow([name, measure, f"{number:.6g}", "", "", "", "", ""])
    return file.getvalue()


def plot(results: Mapping[str, Any], measure: str = "psnr/seen") -> np.ndarray:
    """Draw a measure of every row with its interval; returns a (H, W, 3) uint8 picture."""
    known = {name: results["rows"][name]["measures"][measure] for name in rows_of(results)}
    if all(entry["mean"] is None for entry in known.values()):
        measure = "psnr/all"  # nothing was seen before
        known = {name: results["rows"][name]["measures"][measure] for name in rows_of(results)}
    entries = [entry for entry in known.values() if entry["mean"] is not None]
    names = [name for name, entry in known.items() if entry["mean"] is not None]
    wide, tall, left, top = 900, 34, 330, 64
    canvas = Image.new("RGB", (wide, top + tall * len(names) + 28), (255, 255, 255))
    draw = ImageDraw.Draw(canvas)
    ends = [
        tuple(e["mean"] if e[side] is None else e[side] for side in ("low", "high"))
        for e in entries
    ]
    dots = [value for e in entries for value in e.get("per_seed", ())]
    low = math.floor(min([end[0] for end in ends] + dots) - 0.2)
    high = math.ceil(max([end[1] for end in ends] + dots) + 0.2)

    def x(value: float) -> float:
        return left + (value - low) / (high - low) * (wide - left - 150)

    which = "pixels seen before" if measure == "psnr/seen" else "all pixels"
    pictures.write(draw, (16, 20), f"PSNR over {which}, dB", size=17)
    house = results["about"]["house"]
    caption = f"95 % intervals over {house}s; small dots are training seeds"
    pictures.write(draw, (16, 44), caption, size=12)
    bottom = top + tall * len(names)
    for tick in range(low, high + 1):
        draw.line([(x(tick), top), (x(tick), bottom)], fill=(228, 228, 228))
        pictures.write(draw, (x(tick), bottom + 12), str(tick), anchor="mm")
    for index, (name, entry, (start, end)) in enumerate(zip(names, entries, ends, strict=True)):
        y = top + tall * index + tall / 2
        trained = name in results["about"]["rows"]
        colour = (44, 110, 170) if trained else (130, 130, 130)
        pictures.write(draw, (left - 12, y), label(results, name), anchor="rm")
        draw.line([(x(start), y), (x(end), y)], fill=colour, width=3)
        for value in entry.get("per_seed", ()):
            draw.ellipse([x(value) - 2, y + 6, x(value) + 2, y + 10], fill=colour)
        middle = x(entry["mean"])
        draw.ellipse([middle - 5, y - 5, middle + 5, y + 5], fill=colour)
        pictures.write(draw, (x(end) + 10, y), f"{entry['mean']:.2f}", anchor="lm")
    return np.asarray(canvas)
