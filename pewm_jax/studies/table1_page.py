"""Table 1 for readers: Markdown, LaTeX, CSV and a chart, with the paper's numbers beside ours."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pewm_jax.report.charts import IntervalChart, IntervalRow
from pewm_jax.report.page import write_study
from pewm_jax.report.table import Cell, Row, Table, row, with_half_width, with_interval
from pewm_jax.studies.table1_rows import CONTROL, PAPER_FORM

SETS = ("fvd", "kvd")
"""Metrics of whole sets of clips, which have no value per clip."""
LOWER = ("lpips", "dreamsim", "depth_mae", "depth_rel", *SETS, "fvd_half", "kvd_half")
"""Metrics for which lower is better."""
GAP = "psnr/seen - unseen"
"""PSNR of seen minus unseen pixels; its difference between rows shows what a memory adds."""

COLUMNS: Mapping[str, tuple[str, int]] = {
    "psnr/seen": ("PSNR seen, dB", 2),
    "psnr/unseen": ("PSNR unseen, dB", 2),
    "psnr/all": ("PSNR, dB", 2),
    "ssim/all": ("SSIM", 3),
    "lpips/all": ("LPIPS[alex]", 3),
    "fvd_half": ("FVD", 0),
    "kvd_half": ("KVD", 2),
    "dreamsim": ("DreamSim", 3),
    "src": ("SRC[alex]", 1),
    "depth_mae/all": ("depth, m", 3),
}
"""Metric → heading, decimals; FVD and KVD are those of halves, whose floor has equally many
clips."""
TRUTH = "the truth against itself"
PLACES = "two different places"
"""Labels of reference rows: the scores of the ground truth, and of two different places (SRC)."""


PAPER: Mapping[str, tuple[float, ...]] = {
    "NWM": (17.479, 0.657, 0.308, 194.0, 0.247, 63.4),
    "Image Memory": (18.977, 0.678, 0.271, 124.0, 0.184, 69.4),
    "Ours (w/o depth)": (20.627, 0.696, 0.218, 114.4, 0.118, 77.8),
    "Ours (2D map)": (21.612, 0.752, 0.172, 98.2, 0.097, 79.2),
    "Ours": (22.458, 0.759, 0.157, 91.9, 0.086, 81.7),
}
"""The paper's Table 1 (arXiv 2505.05495): PSNR, SSIM, LPIPS, FVD, DreamSim, SRC."""
ALPHA = 0.05
"""Level of significance, after Holm's correction."""
SIGNIFICANT, HOUSES_ONLY = "*", "°"
"""Marks of differences that are significant over houses and over training seeds, and of those that
are significant only over houses."""
PAIRED = (
    "Paired by clip, with 95 % intervals over houses; FVD, a metric of sets, is paired by training "
    "seed. Intervals are not adjusted for the number of comparisons; marks are: "
    f"{SIGNIFICANT} significant (p < {ALPHA}) over houses and over training seeds, {HOUSES_ONLY} "
    "over houses but not over training seeds (or there is one seed), both after Holm's correction "
    "for the comparisons of a column; without a mark, not significant over houses."
)
PAPER_HEADINGS = ("PSNR, dB", "SSIM", "LPIPS", "FVD", "DreamSim", "SRC")
OURS = ("psnr/all", "ssim/all", "lpips/all", "fvd_half", "dreamsim", "src")
"""Our metric for each of the paper's."""
STEP_MEASURES: Mapping[str, int] = {
    "psnr/seen": 2,
    "psnr/unseen": 2,
    GAP: 2,
    "ssim/all": 3,
    "lpips/all": 3,
    "depth_mae/all": 3,
    "fvd_half": 0,
    "src": 1,
}
"""Metrics whose differences are shown → decimals."""
STEP_HEADINGS = (
    *("PSNR seen, dB", "PSNR unseen, dB", "seen − unseen, dB"),
    *("SSIM", "LPIPS[alex]", "depth, m", "FVD", "SRC[alex]"),
    "PSNR seen, over training seeds",
)
RIVALS = ("none", "none-attend", "voxel-attend", "reproject")
"""Reference rows of the differences on the page."""
NOT_COMPARABLE = (
    "The paper's numbers are for 512 × 512 images of scanned houses, a model of about 3 billion "
    "parameters (our estimate) trained on 8 GPUs for days, DINOv2 features, and an FVD and an "
    "LPIPS whose networks and numbers of clips are not specified; ours are for small images and a "
    "small model (above). Only the order of the rows, and the signs of differences, can be "
    "compared. LPIPS and SRC use AlexNet here; the paper's SRC uses DINOv2, over consecutive "
    "imagined clips with the map growing between them, and ours a way out and back within one "
    "clip: it does not measure memory."
)


PAPER_ABLATIONS: Mapping[str, str] = {
    "cell": "The paper's (its appendix), of 128 / 256 / 384 cells on a side: PSNR 20.6 / 22.5 / "
    "22.2, LPIPS 0.20 / 0.16 / 0.16. Only the order can be compared.",
    "features": "The paper's (its appendix), of a map of points / CLIP / DINO features: PSNR 21.2 "
    "/ 21.5 / 22.5, LPIPS 0.20 / 0.18 / 0.16. Only the order can be compared.",
}
"""Ablation → the paper's numbers."""


def write(results: Mapping[str, Any], page: Path) -> None:
    """Write the table as ``page`` (Markdown) and, beside it, .tex, .csv and .png."""
    scores, numbers = scores_table(results, arrows=True), numbers_table(results)
    write_study(page, markdown(results, page.stem), scores, numbers, chart(results))


def rows_of(results: Mapping[str, Any]) -> list[str]:
    """Return the rows in order: those of the table, the backbone, methods without a network."""
    listed = list(results["about"]["rows"])
    return [*listed, *(name for name in results["rows"] if name not in listed)]


def columns_of(results: Mapping[str, Any]) -> list[str]:
    """Return the metrics that any row has, in the listed order."""
    rows = results["rows"].values()
    return [name for name in COLUMNS if any(name in row["measures"] for row in rows)]


def heading(results: Mapping[str, Any], measure: str) -> str:
    """Return a metric's heading; for a distance of sets, including its number of clips."""
    floor = results["floors"].get(measure.removesuffix("_half"), {})
    return floor.get("name") or COLUMNS[measure][0]


def label(results: Mapping[str, Any], name: str) -> str:
    """Return a row's display name."""
    known = {
        "backbone": "(the backbone that the others start from)",
        "reproject": "reprojection, no network",
        "copy": "copying the last frame",
    }
    described = results["about"]["rows"].get(name)
    return described["label"].replace("_", " ") if described else known.get(name, name)


def lacks_depth(results: Mapping[str, Any], name: str, measure: str) -> bool:
    """Return whether a metric needs depth and the row's model imagines none."""
    about = results["about"]["rows"].get(name, {})
    return measure.startswith("depth") and about.get("depth") is False


def cell(results: Mapping[str, Any], name: str, measure: str) -> Cell:
    """Return the cell of a number with half of its interval; a dash if there is none."""
    entry = results["rows"][name]["measures"].get(measure)
    if entry is None or lacks_depth(results, name, measure):
        return Cell()
    over = entry if "low" in entry else entry["over_seeds"]
    return with_half_width({**over, "mean": entry["mean"]}, COLUMNS[measure][1])


def best_of(results: Mapping[str, Any], names: Sequence[str], measure: str) -> str:
    """Return the row with the best number among the trained ones."""
    known = [
        (results["rows"][name]["measures"][measure]["mean"], name)
        for name in names
        if name in results["about"]["rows"] and cell(results, name, measure).value is not None
    ]
    if not known or measure == "src":  # a model that always shows one image is consistent, too
        return ""
    lower = measure.split("/", 1)[0] in LOWER
    return (min if lower else max)(known)[1]


def bounds_of(results: Mapping[str, Any], measure: str) -> dict[str, float | None]:
    """Return the scores of the ground truth, and for SRC of two different places, if measured."""
    floors = results["floors"]
    if measure == "src" and "src[alex]" in floors:
        return {TRUTH: floors["src[alex]"]["ceiling"], PLACES: floors["src[alex]"]["floor"]}
    found = floors.get(measure.removesuffix("_half"), {}).get("floor")
    return {TRUTH: found["mean"] if found else None, PLACES: None}


def scores_table(results: Mapping[str, Any], *, arrows: bool = False) -> Table:
    """Return the table of scores, with an arrow for the better direction in headings if asked."""
    names, columns = rows_of(results), columns_of(results)
    best = {measure: best_of(results, names, measure) for measure in columns}
    lines: list[Row] = []
    for name in names:
        cells = [
            dataclasses.replace(cell(results, name, measure), best=best[measure] == name)
            for measure in columns
        ]
        lines.append(row(label(results, name), *cells))
    for bound in (TRUTH, PLACES) if "src" in columns else (TRUTH,):
        values = {measure: bounds_of(results, measure)[bound] for measure in columns}
        cells = [Cell(value, COLUMNS[measure][1]) for measure, value in values.items()]
        lines.append(row(bound, *cells, rule=bound == TRUTH))
    heads = [heading(results, measure) for measure in columns]
    if not arrows:
        return Table(["memory · reader", *heads], lines)
    shown = ["↓" if measure.split("/")[0] in LOWER else "↑" for measure in columns]
    pairs = zip(heads, shown, strict=True)
    return Table(["memory, reader", *(" ".join(pair) for pair in pairs)], lines)


def numbers_table(results: Mapping[str, Any]) -> Table:
    """Return every number of the table, one line per row and metric."""
    lines = []
    for name in rows_of(results):
        found = results["rows"][name]
        for measure, entry in found["measures"].items():
            over = entry if "low" in entry else entry["over_seeds"]
            kind = results["about"]["house"] + "s" if over is entry else "seeds"
            seeds = " ".join(f"{value:.6g}" for value in entry.get("per_seed", ()))
            ends = (entry["mean"], over["low"], over["high"])
            shown = ["" if value is None else f"{value:.6g}" for value in ends]
            lines.append([name, measure, *shown, kind, str(found["seeds"]), seeds])
    for measure in columns_of(results):
        for name, number in bounds_of(results, measure).items():
            if number is not None:
                lines.append([name, measure, f"{number:.6g}", "", "", "", "", ""])
    header = ["row", "measure", "mean", "low", "high", "interval_over", "seeds", "per_seed"]
    return Table.of(header, lines)


def chart(results: Mapping[str, Any], measure: str = "psnr/seen") -> IntervalChart:
    """Return the chart of a metric with the interval of every row."""
    known = {name: results["rows"][name]["measures"][measure] for name in rows_of(results)}
    if measure != "psnr/all" and all(entry["mean"] is None for entry in known.values()):
        return chart(results, "psnr/all")  # nothing was seen before
    rows = [
        IntervalRow(
            label(results, name),
            entry["mean"],
            entry["low"],
            entry["high"],
            entry.get("per_seed", ()),
            quiet=name not in results["about"]["rows"],
        )
        for name, entry in known.items()
        if entry["mean"] is not None
    ]
    which = "pixels seen before" if measure == "psnr/seen" else "all pixels"
    house = results["about"]["house"]
    caption = f"95 % intervals over {house}s; small dots are training seeds"
    return IntervalChart(f"PSNR over {which}, dB", caption, rows)


def markdown(results: Mapping[str, Any], stem: str) -> str:
    """Return the page."""
    about = results["about"]
    parts = [
        f"# Table 1: {about['ablation'] or 'which memory works'}",
        how(results),
        scores_table(results).markdown(),
        _floors(results),
        _unbeaten(results),
        f"![PSNR over pixels seen before, with intervals]({stem}.png)",
    ]
    if not about["ablation"]:
        rivals = (_against(results, rival) for rival in RIVALS)
        parts += [_order_text(results), *rivals, _paper(results)]
    else:
        listed = set(about["rows"])
        controls = [name for name in about["rows"] if name.startswith(CONTROL)]
        rivals = [*controls, *sorted(listed & {"voxel-attend", PAPER_FORM})]
        parts += [_against(results, rival) for rival in rivals]
        parts += [PAPER_ABLATIONS.get(about["ablation"], "")]
    parts += [_trainings(about)]
    parts += [f"- {sentence}" for sentence in about["left_out"].values()]
    return "\n\n".join(part for part in parts if part) + "\n"


def _markdown(header: Sequence[str], rows: Sequence[Sequence[Cell | str]]) -> str:
    return Table.of(header, rows).markdown()


def how(results: Mapping[str, Any]) -> str:
    """Return a paragraph on how the numbers were measured."""
    about = results["about"]
    equal, size = "equal steps", about["pixels"]
    if about["minutes"]:
        first, second = about["minutes"]
        clock = "processor " if about["clock"] == "processor" else ""
        times = sorted({row["times"] for row in about["rows"].values()} - {1})
        but = "".join(f", {time:g} times as long for rows that say so" for time in times)
        equal = f"equal time ({first:g} + {second:g} {clock}minutes of training steps{but})"
    return (
        f"{len(about['seeds'])} training seed(s), {equal}, batches of {about['batch']}; images of "
        f"{size[0]} × {size[1]}; {about['clips']} clips of {about['frames'] - 1} imagined frames "
        f"in {about['houses']} {about['house']}s, {about['context']} frames of context. Means over "
        f"{about['house']}s; ± is half of the 95 % interval over {about['house']}s (bootstrap), "
        "for FVD and KVD over training seeds (Student's). Protocol "
        f"{about['protocol_sha256'][:12]}. Total wall-clock time {about['hours']['clock']:.1f} "
        f"hours, processor time {about['hours']['cpu']:.1f} hours; {about['date']}."
    )


def _floors(results: Mapping[str, Any]) -> str:
    floors, said = results["floors"], []
    halves = [floors[kind]["half_clips"] for kind in SETS if floors.get(kind, {}).get("floor")]
    if halves:
        said.append(
            f"FVD and KVD compare {halves[0]} imagined clips with the ground truth of as many "
            "others, "
            "averaged over random halves; their floor compares the ground truth with itself."
        )
    if "src[alex]" in floors:
        src = floors["src[alex]"]
        said.append(
            f"SRC[alex]: ground truth {src['ceiling']:.1f}, two different places "
            f"{src['floor']:.1f}."
        )
    return " ".join(said)


def _unbeaten(results: Mapping[str, Any]) -> str:
    """Return a sentence on metrics in which a method without a network beats all rows."""
    said = []
    for rival in ("reproject", "copy"):
        theirs = results["rows"].get(rival, {"measures": {}})["measures"]
        better = []
        for measure in columns_of(results):
            best, other = best_of(results, rows_of(results), measure), theirs.get(measure)
            if not best or other is None or other["mean"] is None:
                continue
            apart = other["mean"] - results["rows"][best]["measures"][measure]["mean"]
            if (-apart if measure.split("/")[0] in LOWER else apart) > 0:
                better.append(heading(results, measure).split(",")[0])
        if better:
            said.append(f"{label(results, rival)} is better in {', '.join(better)}")
    if not said:
        return ""
    return f"Without a network, and better than every trained row: {'; '.join(said)}."


def _against(results: Mapping[str, Any], rival: str) -> str:
    """Return every trained row's differences from one of them, paired by clip."""
    if rival not in results["differences"]:
        return ""
    rows = [
        [label(results, name), *_cells_of(results, found, (name, rival))]
        for name, found in results["differences"][rival].items()
        if name in results["about"]["rows"]
    ]
    text = _markdown(["row", *STEP_HEADINGS], rows)
    return f"## Each row minus {label(results, rival)}\n\n{PAIRED}\n\n{text}"


def _cells_of(
    results: Mapping[str, Any], differences: Mapping[str, Any], pair: tuple[str, str]
) -> list[Cell]:
    """Return the differences of two rows, with their intervals and marks of significance."""
    cells: list[Cell] = []
    for measure, decimals in STEP_MEASURES.items():
        found = differences.get(measure)
        if not found or any(lacks_depth(results, name, measure) for name in pair):
            cells.append(Cell())
            continue
        over = found if "low" in found else found["over_seeds"]
        shown = with_interval(over, decimals, sign=True)
        cells.append(dataclasses.replace(shown, mark=mark_of(found)))
    over = differences["psnr/seen"].get("over_seeds")
    return [*cells, with_interval(over, 2, sign=True)]


def _order_text(results: Mapping[str, Any]) -> str:
    """Return the steps of the paper's order, with differences over pixels seen before."""
    if not results["order"]:
        return ""
    rows = []
    for step in results["order"]:
        pair = (step["better"], step["worse"])
        words = " − ".join(label(results, name) for name in pair)
        rows.append([words, *_cells_of(results, step["differences"], pair)])
    text = _markdown(["step of the paper's order", *STEP_HEADINGS], rows)
    return (
        "## The paper's order\n\nThe paper has no memory < image memory < no depth < 2D map < 3D "
        "map. Each step here, paired. *None · attend* is our control: a reader without input, "
        "trained equally long. All readers use projective positions, except the last step, which "
        "uses the paper's sinusoid. The effect of a memory is the difference of seen minus unseen "
        f"pixels: an improvement of both is not due to memory.\n\n{PAIRED}\n\n{text}"
    )


def mark_of(entry: Mapping[str, Any]) -> str:
    """Return the mark of a difference; FVD and KVD have p values only over seeds."""
    houses, seeds = entry.get("p_holm"), entry.get("p_seeds_holm")
    over_seeds = seeds is not None and seeds < ALPHA
    if "p" not in entry:
        return SIGNIFICANT if over_seeds else ""
    if houses is None or houses >= ALPHA:
        return ""
    return SIGNIFICANT if over_seeds else HOUSES_ONLY


def _paper(results: Mapping[str, Any]) -> str:
    rows = []
    for name, described in results["about"]["rows"].items():
        if described["paper"]:
            theirs = PAPER[described["paper"]]
            ours = [cell(results, name, measure).main for measure in OURS]
            pairs = [f"{a:g} / {b}" for a, b in zip(theirs, ours, strict=True)]
            rows.append([described["paper"], label(results, name), *pairs])
    text = _markdown(["the paper's row", "ours", *PAPER_HEADINGS], rows)
    return f"## Beside the paper\n\nThe paper's / ours.\n\n{text}\n\n{NOT_COMPARABLE}"


def _trainings(about: Mapping[str, Any]) -> str:
    rows = []
    for name, training in about["trainings"].items():
        described = about["rows"].get(name)
        took = "–" if training["seconds"] is None else f"{training['seconds']:.3f}"
        size = described["parameters"] if described else 0  # else the backbone is trained
        count = f"{size / 1e6:.2f} M" if size else "–"
        rows.append([name, count, took, str(training["steps"])])
    header = ["training", "parameters of the reader", "seconds a step", "steps"]
    return f"## What was trained\n\n{_markdown(header, rows)}"
