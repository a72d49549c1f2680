"""Table 1 for readers: the page in Markdown, with the paper's numbers beside ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pewm_jax.io import atomic
from pewm_jax.report import pictures
from pewm_jax.studies.rows import CONTROL, PAPER_FORM
from pewm_jax.studies.table import GAP, LOWER, SETS
from pewm_jax.studies.table_cells import (
    PLACES,
    TRUTH,
    best_of,
    blind,
    cell,
    columns_of,
    floor_of,
    heading,
    label,
    number_words,
    place_floor,
    rows_of,
)
from pewm_jax.studies.table_formats import as_csv, latex, plot

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
"""Mark differences that are significant over houses and over training seeds, and those that are
significant over houses and not over training seeds."""
PAIRED = (
    "Paired by clip, with 95 % intervals over houses; FVD, of sets, is paired by training seed. "
    "Intervals are not adjusted for the number of comparisons; marks are: "
    f"{SIGNIFICANT} significant (p < {ALPHA}) over houses and over training seeds, {HOUSES_ONLY} "
    "over houses and not over training seeds (or there is one seed), both after Holm's correction "
    "for the comparisons of a column; without a mark, not significant over houses."
)
PAPER_HEADINGS = ("PSNR, dB", "SSIM", "LPIPS", "FVD", "DreamSim", "SRC")
OURS = ("psnr/all", "ssim/all", "lpips/all", "fvd_half", "dreamsim", "src")
"""Our measure in the place of each of the paper's."""
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
"""Measures whose differences are shown → decimals; beside them that of seeds."""
STEP_HEADINGS = (
    *("PSNR seen, dB", "PSNR unseen, dB", "seen − unseen, dB"),
    *("SSIM", "LPIPS[alex]", "depth, m", "FVD", "SRC[alex]"),
    "PSNR seen, over training seeds",
)
RIVALS = ("none", "none-attend", "voxel-attend", "reproject")
"""Rows that every row is set against on the page."""
NOT_COMPARABLE = (
    "The numbers of the paper are of 512 × 512 pictures of scanned houses, a model of (by our "
    "reckoning) about 3 billion parameters trained on 8 GPUs for days, DINOv2 features, and an FVD "
    "and an LPIPS whose networks and numbers of clips are not named; ours are of small pictures "
    "and a small model (above). Only the order of the rows, and the signs of differences, can be "
    "compared. LPIPS and SRC are by AlexNet "
    "here; SRC is by DINOv2 there, over clips imagined one after the other with the map growing "
    "between them, and here over a way out and back within one clip: it says nothing of memory."
)


PAPER_ABLATIONS: Mapping[str, str] = {
    "cell": "The paper's (its appendix), of 128 / 256 / 384 cells on a side: PSNR 20.6 / 22.5 / "
    "22.2, LPIPS 0.20 / 0.16 / 0.16. Only the order can be compared.",
    "features": "The paper's (its appendix), of a map of points / CLIP / DINO features: PSNR 21.2 "
    "/ 21.5 / 22.5, LPIPS 0.20 / 0.18 / 0.16. Only the order can be compared.",
}
"""Ablation → what the paper has of it."""


def write(results: Mapping[str, Any], page: Path) -> None:
    """Write the table as ``page`` (Markdown) and, beside it, .tex, .csv and .png."""
    atomic.write_text(page, markdown(results, page.stem))
    atomic.write_text(page.with_suffix(".tex"), latex(results))
    atomic.write_text(page.with_suffix(".csv"), as_csv(results))
    pictures.save_png(page.with_suffix(".png"), plot(results))


def markdown(results: Mapping[str, Any], stem: str) -> str:
    """Return the page."""
    about, names, columns = results["about"], rows_of(results), columns_of(results)
    best = {measure: best_of(results, names, measure) for measure in columns}
    lines = []
    for name in names:
        cells = []
        for measure in columns:
            mean, half = cell(results, name, measure)
            text = f"{mean} ± {half}" if half else mean
            cells.append(f"**{text}**" if best[measure] == name else text)
        lines.append([label(results, name), *cells])
    lines.append([TRUTH, *(number_words(floor_of(results, each), each) for each in columns)])
    if "src" in columns:
        lines.append(
            [PLACES, *(number_words(place_floor(results, each), each) for each in columns)]
        )
    parts = [
        _title(about),
        how(results),
        _table(["memory · reader", *(heading(results, m) for m in columns)], lines),
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


def _title(about: Mapping[str, Any]) -> str:
    return f"# Table 1: {about['ablation'] or 'which memory works'}"


def how(results: Mapping[str, Any]) -> str:
    """Return in words how the numbers were made."""
    about = results["about"]
    equal, size = "equal steps", about["pixels"]
    if about["minutes"]:
        first, second = about["minutes"]
        clock = "processor " if about["clock"] == "processor" else ""
        times = sorted({row["times"] for row in about["rows"].values()} - {1})
        but = "".join(f", {time:g} times as long where a row says so" for time in times)
        equal = f"equal time ({first:g} + {second:g} {clock}minutes of training steps{but})"
    return (
        f"{len(about['seeds'])} training seed(s), {equal}, batches of {about['batch']}; "
        f"pictures of {size[0]} × {size[1]}; {about['clips']} clips of {about['frames'] - 1} "
        f"imagined frames in {about['houses']} {about['house']}s, {about['context']} "
        f"frames of context. Means over {about['house']}s; ± is half of "
        f"the 95 % interval over {about['house']}s (bootstrap), of FVD and KVD over training seeds "
        f"(Student's). Protocol {about['protocol_sha256'][:12]}. The pieces took "
        f"{about['hours']['clock']:.1f} hours on the clock, added up, {about['hours']['cpu']:.1f} "
        f"of the processor; {about['date']}."
    )


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _floors(results: Mapping[str, Any]) -> str:
    floors, said = results["floors"], []
    halves = [floors[kind]["half_clips"] for kind in SETS if floors.get(kind, {}).get("floor")]
    if halves:
        said.append(
            f"FVD and KVD compare {halves[0]} imagined clips with the truth of as many others, "
            "means over random halves, and so does their floor, the truth against itself."
        )
    if "src[alex]" in floors:
        src = floors["src[alex]"]
        said.append(
            f"SRC[alex]: the truth has {src['ceiling']:.1f}, two different places "
            f"{src['floor']:.1f}."
        )
    return " ".join(said)


def _unbeaten(results: Mapping[str, Any]) -> str:
    """Log on which measures no trained row reaches what needs no network."""
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
    rows = []
    for name, found in results["differences"][rival].items():
        if name in results["about"]["rows"]:
            rows.append([label(results, name), *_cells_of(results, found, (name, rival))])
    return f"## Each row minus {label(results, rival)}\n\n{PAIRED}\n\n" + _table(
        ["row", *STEP_HEADINGS], rows
    )


def _cells_of(
    results: Mapping[str, Any], differences: Mapping[str, Any], pair: tuple[str, str]
) -> list[str]:
    """Return the differences of two rows that count, as words."""
    cells = []
    for measure, decimals in STEP_MEASURES.items():
        found = differences.get(measure)
        sees = not any(blind(results, name, measure) for name in pair)
        cells.append(_signed(found, decimals) if found and sees else "–")
        if found and sees:
            cells[-1] += mark_of(found)
    over = differences["psnr/seen"].get("over_seeds")
    return [*cells, _signed(over, 2) if over else "–"]


def _order_text(results: Mapping[str, Any]) -> str:
    """Return the paper's order, step by step, with differences over pixels seen before."""
    if not results["order"]:
        return ""
    rows = []
    for step in results["order"]:
        words = f"{label(results, step['better'])} − {label(results, step['worse'])}"
        pair = (step["better"], step["worse"])
        rows.append([words, *_cells_of(results, step["differences"], pair)])
    text = _table(["step of the paper's order", *STEP_HEADINGS], rows)
    return (
        "## The paper's order\n\nThe paper has no memory < image memory < no depth < 2D map < 3D "
        "map. Each step here, paired. *None · attend* is ours: a "
        "reader that was trained as long with nothing to read. All readers place what they read by "
        "projection; the last step goes to the paper's own positions, a sinusoid. What a memory "
        "adds shows in seen minus unseen pixels: what helps both alike is no memory.\n\n"
        f"{PAIRED}\n\n{text}"
    )


def mark_of(entry: Mapping[str, Any]) -> str:
    """Return the mark of a difference; FVD and KVD, of sets, have p values over seeds alone."""
    houses, seeds = entry.get("p_holm"), entry.get("p_seeds_holm")
    over_seeds = seeds is not None and seeds < ALPHA
    if "p" not in entry:
        return SIGNIFICANT if over_seeds else ""
    if houses is None or houses >= ALPHA:
        return ""
    return SIGNIFICANT if over_seeds else HOUSES_ONLY


def _signed(entry: Mapping[str, Any], decimals: int) -> str:
    entry = entry if "low" in entry else entry["over_seeds"]
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
            ours = [cell(results, name, measure)[0] for measure in OURS]
            pairs = [f"{a:g} / {b}" for a, b in zip(theirs, ours, strict=True)]
            rows.append([described["paper"], label(results, name), *pairs])
    text = _table(["the paper's row", "ours", *PAPER_HEADINGS], rows)
    return f"## Beside the paper\n\nThe paper's / ours.\n\n{text}\n\n{NOT_COMPARABLE}"


def _trainings(about: Mapping[str, Any]) -> str:
    rows = []
    for name, training in about["trainings"].items():
        described = about["rows"].get(name)
        took = "–" if training["seconds"] is None else f"{training['seconds']:.3f}"
        size = described["parameters"] if described else 0  # without a reader the backbone trains
        count = f"{size / 1e6:.2f} M" if size else "–"
        rows.append([name, count, took, str(training["steps"])])
    header = ["training", "parameters of the reader", "seconds a step", "steps"]
    return f"## What was trained\n\n{_table(header, rows)}"
