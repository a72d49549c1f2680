"""Table 1 for readers: Markdown, LaTeX, CSV and a picture, with the paper's numbers beside ours."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from pewm_jax import atomic
from pewm_jax.evaluation import pictures
from pewm_jax.studies.table import LOWER

COLUMNS: Mapping[str, tuple[str, int]] = {
    "psnr/seen": ("PSNR seen, dB", 2),
    "psnr/unseen": ("PSNR unseen, dB", 2),
    "psnr/all": ("PSNR, dB", 2),
    "ssim/all": ("SSIM", 3),
    "lpips/all": ("LPIPS", 3),
    "fvd": ("FVD", 1),
    "kvd": ("KVD", 2),
    "dreamsim": ("DreamSim", 3),
    "src": ("SRC[alex]", 1),
    "depth_mae/all": ("depth, m", 3),
}
"""Measure → heading, decimals."""
PAPER: Mapping[str, tuple[float, ...]] = {
    "NWM": (17.479, 0.657, 0.308, 194.0, 0.247, 63.4),
    "Image Memory": (18.977, 0.678, 0.271, 124.0, 0.184, 69.4),
    "Ours (w/o depth)": (20.627, 0.696, 0.218, 114.4, 0.118, 77.8),
    "Ours (2D map)": (21.612, 0.752, 0.172, 98.2, 0.097, 79.2),
    "Ours": (22.458, 0.759, 0.157, 91.9, 0.086, 81.7),
}
"""The paper's Table 1 (arXiv 2505.05495): PSNR, SSIM, LPIPS, FVD, DreamSim, SRC."""
PAPER_HEADINGS = ("PSNR, dB", "SSIM", "LPIPS", "FVD", "DreamSim", "SRC")
OURS = ("psnr/all", "ssim/all", "lpips/all", "fvd", "dreamsim", "src")
"""Our measure in the place of each of the paper's."""
NOT_COMPARABLE = (
    "The numbers of the paper are of 512 × 512 pictures of scanned houses, a model of about 3 "
    "billion parameters trained on 8 GPUs for days, DINOv2 features, and an FVD and an LPIPS whose "
    "networks are not named; ours are of small pictures and a small model (above). Only the order "
    "of the rows, and the signs of differences, can be compared. SRC is by AlexNet here and by "
    "DINOv2 there."
)


def write(results: Mapping[str, Any], page: Path) -> None:
    """Write the table as ``page`` (Markdown) and, beside it, .tex, .csv and .png."""
    atomic.write_text(page, markdown(results, page.stem))
    atomic.write_text(page.with_suffix(".tex"), latex(results))
    atomic.write_text(page.with_suffix(".csv"), as_csv(results))
    pictures.save_png(page.with_suffix(".png"), plot(results))


def _order(results: Mapping[str, Any]) -> list[str]:
    """Return the rows: those of the table as listed, then the backbone, then without a network."""
    listed = list(results["about"]["rows"])
    return [*listed, *(name for name in results["rows"] if name not in listed)]


def _columns(results: Mapping[str, Any]) -> list[str]:
    rows = results["rows"].values()
    return [name for name in COLUMNS if any(name in row["measures"] for row in rows)]


def label(results: Mapping[str, Any], name: str) -> str:
    """Return a row's name for people."""
    known = {
        "backbone": "(the backbone alone: every memory, empty)",
        "reproject": "reprojection, no network",
        "copy": "copying the last frame",
    }
    described = results["about"]["rows"].get(name)
    return described["label"].replace("_", " ") if described else known.get(name, name)


def _cell(results: Mapping[str, Any], name: str, measure: str) -> tuple[str, str]:
    """Return a number and half its interval, as words; "–" where there is none."""
    about = results["about"]["rows"].get(name, {})
    entry = results["rows"][name]["measures"].get(measure)
    blind = measure.startswith("depth") and about.get("depth") is False
    if entry is None or entry["mean"] is None or blind:
        return "–", ""
    decimals = COLUMNS[measure][1]
    over = entry if "low" in entry else entry["over_seeds"]
    half = ""
    if over["low"] is not None:
        half = f"{(over['high'] - over['low']) / 2:.{decimals}f}"
    return f"{entry['mean']:.{decimals}f}", half


def _best(results: Mapping[str, Any], names: Sequence[str], measure: str) -> str:
    """Return the row with the best number among the trained ones."""
    known = [
        (results["rows"][name]["measures"][measure]["mean"], name)
        for name in names
        if name in results["about"]["rows"] and _cell(results, name, measure)[0] != "–"
    ]
    if not known or measure == "src":  # a model that always shows one picture is consistent too
        return ""
    lower = measure.split("/", 1)[0] in LOWER
    return (min if lower else max)(known)[1]


def markdown(results: Mapping[str, Any], stem: str) -> str:
    """Return the page."""
    about, names, columns = results["about"], _order(results), _columns(results)
    best = {measure: _best(results, names, measure) for measure in columns}
    lines = []
    for name in names:
        cells = []
        for measure in columns:
            mean, half = _cell(results, name, measure)
            text = f"{mean} ± {half}" if half else mean
            cells.append(f"**{text}**" if best[measure] == name else text)
        lines.append([label(results, name), *cells])
    parts = [
        _title(about),
        how(results),
        _table(["memory · reader", *(COLUMNS[m][0] for m in columns)], lines),
        _floors(results),
        f"![PSNR over pixels seen before, with intervals]({stem}.png)",
    ]
    if not about["ablation"]:
        parts += [_order_text(results), _paper(results)]
    parts += [_trainings(about)]
    parts += [f"- {sentence}" for sentence in about["left_out"].values()]
    return "\n\n".join(part for part in parts if part) + "\n"


def _title(about: Mapping[str, Any]) -> str:
    return f"# Table 1: {about['ablation'] or 'which memory works'}"


def how(results: Mapping[str, Any]) -> str:
    """Return in words how the numbers were made."""
    about = results["about"]
    equal, size = "equal steps", about["pixels"]
    if about["minutes"]:
        first, second = about["minutes"]
        clock = "processor " if about["clock"] == "processor" else ""
        equal = f"equal time ({first:g} + {second:g} {clock}minutes of training steps)"
    return (
        f"{len(about['seeds'])} training seed(s), {equal}, batches of {about['batch']}; "
        f"pictures of {size[0]} × {size[1]}; {about['clips']} clips of {about['frames'] - 1} "
        f"imagined frames in {about['houses']} held-out houses, {about['context']} "
        "frames of context. Means over houses; ± is half of "
        "the 95 % interval over houses (bootstrap), of FVD and KVD over training seeds "
        f"(Student's). Protocol {about['protocol_sha256'][:12]}. The run took "
        f"{about['hours']['clock']:.1f} hours on the clock, {about['hours']['cpu']:.1f} of the "
        f"processor; {about['date']}."
    )


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _floors(results: Mapping[str, Any]) -> str:
    floors, said = results["floors"], []
    for kind in ("fvd", "kvd"):
        if kind in floors and floors[kind]["floor"]:
            spread, half = floors[kind]["floor"], floors[kind]["half_clips"]
            said.append(
                f"{kind.upper()} of the truth against the truth, {half} clips on each side: "
                f"{spread['mean']:.4g}."
            )
    if "src[alex]" in floors:
        src = floors["src[alex]"]
        said.append(
            f"SRC[alex]: the truth has {src['ceiling']:.1f}, two different places "
            f"{src['floor']:.1f}."
        )
    return " ".join(said)


def _order_text(results: Mapping[str, Any]) -> str:
    """Return the paper's order, step by step, with differences over pixels seen before."""
    if not results["order"]:
        return ""
    rows = []
    for step in results["order"]:
        cells = [
            f"{label(results, step['better'])} − {label(results, step['worse'])}",
        ]
        for measure in ("psnr/seen", "psnr/all", "lpips/all"):
            found = step["differences"].get(measure)
            cells.append(_signed(found, COLUMNS[measure][1]) if found else "–")
        over = step["differences"]["psnr/seen"].get("over_seeds")
        cells.append(_signed(over, 2) if over else "–")
        rows.append(cells)
    header = ["step of the paper's order", "PSNR seen, dB", "PSNR, dB", "LPIPS"]
    text = _table([*header, "PSNR seen, over training seeds"], rows)
    return (
        "## The paper's order\n\nThe paper has no memory < image memory < no depth < 2D map < 3D "
        f"map. Each step here, paired by clip, with 95 % intervals:\n\n{text}"
    )


def _signed(entry: Mapping[str, Any], decimals: int) -> str:
    if entry["mean"] is None:
        return "–"
    mean = f"{entry['mean']:+.{decimals}f}"
    if entry["low"] is None:
        return mean
    return f"{mean} [{entry['low']:+.{decimals}f}, {entry['high']:+.{decimals}f}]"


def _paper(results: Mapping[str, Any]) -> str:
    rows = []
    for name, described in results["about"]["rows"].items():
        if described["paper"]:
            theirs = PAPER[described["paper"]]
            ours = [_cell(results, name, measure)[0] for measure in OURS]
            pairs = [f"{a:g} / {b}" for a, b in zip(theirs, ours, strict=True)]
            rows.append([described["paper"], label(results, name), *pairs])
    text = _table(["the paper's row", "ours", *PAPER_HEADINGS], rows)
    return f"## Beside the paper\n\nThe paper's / ours.\n\n{text}\n\n{NOT_COMPARABLE}"


def _trainings(about: Mapping[str, Any]) -> str:
    rows = []
    for name, training in about["trainings"].items():
        described = about["rows"].get(name)
        took = "–" if training["seconds"] is None else f"{training['seconds']:.3f}"
        count = f"{described['parameters'] / 1e6:.2f} M" if described else "–"
        rows.append([name, count, took, str(training["steps"])])
    header = ["training", "parameters of the reader", "seconds a step", "steps"]
    return f"## What was trained\n\n{_table(header, rows)}"


def latex(results: Mapping[str, Any]) -> str:
    """Return the table for LaTeX, with booktabs."""
    names, columns = _order(results), _columns(results)
    best = {measure: _best(results, names, measure) for measure in columns}
    arrows = {m: r"$\downarrow$" if m.split("/")[0] in LOWER else r"$\uparrow$" for m in columns}
    head = " & ".join(["memory, reader", *(f"{COLUMNS[m][0]} {arrows[m]}" for m in columns)])
    lines = [
        r"\begin{tabular}{l" + "r" * len(columns) + "}",
        r"\toprule",
        head + r" \\",
        r"\midrule",
    ]
    for name in names:
        cells = []
        for measure in columns:
            mean, half = _cell(results, name, measure)
            text = "--" if mean == "–" else mean + (rf" {{\tiny $\pm$ {half}}}" if half else "")
            cells.append(rf"\textbf{{{text}}}" if best[measure] == name else text)
        words = label(results, name).replace("·", "--")
        lines.append(" & ".join([words, *cells]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def as_csv(results: Mapping[str, Any]) -> str:
    """Return every number of the table, a line for each row and measure."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["row", "measure", "mean", "low", "high", "seeds", "per_seed"])
    for name in _order(results):
        row = results["rows"][name]
        for measure, entry in row["measures"].items():
            over = entry if "low" in entry else entry["over_seeds"]
            seeds = " ".join(f"{value:.6g}" for value in entry.get("per_seed", ()))
            ends = (entry["mean"], over["low"], over["high"])
            shown = ["" if value is None else f"{value:.6g}" for value in ends]
            writer.writerow([name, measure, *shown, row["seeds"], seeds])
    return file.getvalue()


def plot(results: Mapping[str, Any], measure: str = "psnr/seen") -> np.ndarray:
    """Draw a measure of every row with its interval; returns a (H, W, 3) uint8 picture."""
    names = [n for n in _order(results) if results["rows"][n]["measures"][measure]["mean"]]
    entries = [results["rows"][name]["measures"][measure] for name in names]
    wide, tall, left, top = 900, 34, 330, 64
    canvas = Image.new("RGB", (wide, top + tall * len(names) + 28), (255, 255, 255))
    draw = ImageDraw.Draw(canvas)
    ends = [(e["low"] or e["mean"], e["high"] or e["mean"]) for e in entries]
    low = math.floor(min(end[0] for end in ends) - 0.2)
    high = math.ceil(max(end[1] for end in ends) + 0.2)

    def x(value: float) -> float:
        return left + (value - low) / (high - low) * (wide - left - 150)

    pictures.write(draw, (16, 20), "PSNR over pixels seen before, dB", size=17)
    caption = "95 % intervals over houses; small dots are training seeds"
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
