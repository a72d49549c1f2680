"""The comparison of two runs as one self-contained HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pewm_jax.report.charts import Line, LineChart
from pewm_jax.report.labels import MASK_NAMES, METRIC_NAMES, OWN_METHODS, heading, spread
from pewm_jax.report.page import (
    Bullets,
    Charts,
    Details,
    Facts,
    Figure,
    Section,
    TableBlock,
    Text,
    render,
)
from pewm_jax.report.pictures import ROWS, grid, picture_steps, png
from pewm_jax.report.table import Cell, Row, Table, row, with_interval
from pewm_jax.report.table import heading as heading_row

INTRODUCTION = (
    "Two models, evaluated with one protocol: the same clips of the same houses, the same context, "
    "motion and noise. Differences are paired by clip."
)
COLOURS = {"a": "#1f6feb", "b": "#e8731a", "differences": "#1a9a6c"}
NAMES = {"a": "a", "b": "b", "differences": "a − b"}
NOT_COMPARED = (
    "Only per-clip metrics are paired. The mirror test and SRC, drift, and the growth of the map "
    "are in the two reports."
)
NO_VIDEOS = (
    "FVD and KVD are not compared: a report has none, or the two are of another network, or of "
    "another number of frames or clips."
)


def side_by_side(long_horizon: int, one: Path, two: Path) -> list[np.ndarray]:
    """Draw the long rollouts shown in both reports: ground truth, first run, second run.

    Returns an image for each rollout, of ``long_horizon`` imagined frames, whose images both
    reports' folders have.
    """
    steps = picture_steps(long_horizon)
    names = ["observed" if step == 0 else f"step {step}" for step in steps]
    drawn: list[np.ndarray] = []
    while True:
        index = len(drawn)
        files = {
            "truth": one / ROWS / f"{index:02d}-truth.png",
            "a": _own(one, index),
            "b": _own(two, index),
        }
        if not all(file.is_file() for file in files.values()):
            return drawn
        rows = []
        for caption, file in files.items():
            with Image.open(file) as picture:
                whole = np.asarray(picture.convert("RGB"))
            rows.append((caption, np.split(whole, len(steps), axis=1)))
        drawn.append(grid(rows, names))


def _own(report: Path, index: int) -> Path:
    """Return the file with the frames of the evaluated model, with or without a memory."""
    files = [report / ROWS / f"{index:02d}-{method}.png" for method in OWN_METHODS]
    return next((file for file in files if file.is_file()), files[0])


def sentences(content: Mapping[str, Any]) -> list[str]:
    """Return the sentences of ``comparison.json``, for the page and the terminal."""
    a, b = (content[side]["name"] for side in ("a", "b"))
    where = {mask: f"pixels {name}" for mask, name in MASK_NAMES.items()} | {"all": "all pixels"}
    said = [
        f"Over {words}: {outcome(content['differences']['clips'][mask], a, b)}"
        for mask, words in where.items()
    ]
    hashes = [{run["weights_sha256"] for run in content[side]["runs"]} for side in ("a", "b")]
    said += ["a and b are the same weights."] if hashes[0] == hashes[1] else []
    return said + _samplers(content)


def _samplers(content: Mapping[str, Any]) -> list[str]:
    """Return the samplers of both runs, if they differ."""
    steps, said = [], []
    for side in ("a", "b"):
        ways = [(run["sampling_steps"], run["sampler"]) for run in content[side]["runs"]]
        steps.append(ways)
        count, sampler = ways[0]
        how = f"in {count} sampling steps ({sampler})" if count else "without a sampler"
        said.append(f"{side} imagines {how}")
    return [] if len({way for ways in steps for way in ways}) == 1 else [f"{', '.join(said)}."]


def outcome(entries: Mapping[str, Any], one: str, two: str) -> str:
    """Return the second part of a sentence that says whether the first run's PSNR is higher.

    ``entries`` are ``[metric]`` of first − second.
    """
    found = entries["psnr"]
    if found["mean"] is None:
        return "there is nothing to compare."
    if found["low"] is None:
        return (
            f"a − b is {found['mean']:+.2f} dB in one house; its uncertainty cannot be estimated "
            "from one house."
        )
    amount = f"a − b is {spread(found, 2, sign=True)} dB over {found['houses']} houses"
    if found["low"] > 0:
        return f"a ({one}) is closer to the truth than b ({two}): {amount}."
    if found["high"] < 0:
        return f"b ({two}) is closer to the truth than a ({one}): {amount}."
    return f"no clear difference: {amount}."


def comparison_page(content: Mapping[str, Any], pictures: Sequence[np.ndarray]) -> str:
    """Return the page as HTML."""
    first, *others = sentences(content)
    title = "\n".join(f"{side}: {content[side]['name']}" for side in ("a", "b"))
    opening = [Text(INTRODUCTION, "quiet"), Text(first, "lead"), Bullets(others)]
    parts = (_scores, _videos, _seeds, _horizon, _houses, _protocol)
    return render(title, opening, [_stills(pictures), *(part(content) for part in parts)])


def _stills(pictures: Sequence[np.ndarray]) -> Section:
    if not pictures:
        return Section.of_note("The two reports have no frames in common to show.")
    text = (
        "Long rollouts, the first of the protocol (not selected): ground truth, then each model "
        "(with its map, if it has one), which continues from its own last frame."
    )
    figures = [Figure(png(picture), alt="truth, a, b") for picture in pictures]
    return Section("Side by side", [Text(text), *figures])


def _scores(content: Mapping[str, Any]) -> Section:
    measured = [name for name in METRIC_NAMES if name in content["differences"]["clips"]["all"]]
    rows: list[Row] = []
    for mask, name in MASK_NAMES.items():
        rows.append(heading_row(name))
        for side, label in NAMES.items():
            gain, entries = side == "differences", content[side]["clips"][mask]
            cells = [with_interval(entries.get(m), METRIC_NAMES[m][1], sign=gain) for m in measured]
            rows.append(row(label, *cells, str(entries["psnr"]["houses"]), highlight=gain))
    heads = ["", *(heading(name, content) for name in measured), "houses"]
    reasons = dict.fromkeys(content["left_out"], "the two were measured with different networks")
    for name in content["measured_by_one"]:
        reasons.setdefault(name, "only one of the two was measured with it")
    left = "".join(
        f" {METRIC_NAMES[name][0]} is omitted: {why}."
        for name, why in reasons.items()
        if name in METRIC_NAMES
    )
    for name in content.get("masked_by_one", []):
        if name in METRIC_NAMES and name not in reasons:
            left += (
                f" {METRIC_NAMES[name][0]} over pixels seen before and never seen is omitted: only "
                "one of the two reports has it; evaluate the other run again."
            )
    note = (
        "Means over houses of the means within a house, sampling and training seeds averaged "
        "first; in brackets the 95 % interval of a bootstrap over houses. A difference is clear "
        f"if its interval does not contain 0. {NOT_COMPARED}{left}"
    )
    return Section.of_table("Scores", heads, rows, note)


def _videos(content: Mapping[str, Any]) -> Section:
    """Return FVD and KVD of both models; a sentence if they cannot be compared."""
    found = content.get("videos")
    if not found:
        return Section.of_note(NO_VIDEOS)
    rows: list[Row] = []
    for mask in (mask for mask in MASK_NAMES if mask in found["a"]):
        rows.append(heading_row(MASK_NAMES[mask]))
        rows += [
            row(side, *(f"{found[side][mask][kind]:.4g}" for kind in found["names"]))
            for side in ("a", "b")
        ]
        gains = (found["a"][mask][kind] - found["b"][mask][kind] for kind in found["names"])
        rows.append(row("a − b", *(f"{gain:+.4g}" for gain in gains), highlight=True))
    note = (
        "Distances between the set of imagined clips and that of true ones, first sampling seed, "
        "means over training seeds. They have no interval; their floors are in the two reports. "
        "Over pixels seen before, or never seen, clips show the truth at all other pixels."
    )
    heads = ["", *(f"{name} ↓" for name in found["names"].values())]
    return Section.of_table("Videos as a whole", heads, rows, note)


def _seeds(content: Mapping[str, Any]) -> Section:
    """Return PSNR by training seed; a sentence if each model was trained once."""
    trained = {side: content[side]["runs"] for side in ("a", "b")}
    if max(map(len, trained.values())) < 2:
        note = (
            "Each model was trained once, so the effect of the training seed is not measured "
            "(add more seeds with `--also_a` and `--also_b`)."
        )
        return Section.of_note(note)
    rows: list[Row] = []
    for mask, name in MASK_NAMES.items():
        rows.append(heading_row(name))
        for side in ("a", "b"):
            found = content["training_seeds"][side][mask]["psnr"]
            each = ", ".join(
                f"{run['training_seed']}: {Cell(value)}"
                for run, value in zip(trained[side], found["per_seed"], strict=True)
            )
            rows.append(row(side, each, with_interval(found, 2)))
        found = content["training_seeds"]["differences"][mask]["psnr"]
        rows.append(row("a − b", "", with_interval(found, 2, sign=True), highlight=True))
    note = (
        "In brackets Student's 95 % interval over training seeds: the variation between trainings, "
        "in these houses. It does not cover other houses, and the interval over houses does not "
        "cover other trainings."
    )
    heads = ["PSNR, dB", "seed: mean over houses", "over seeds"]
    return Section.of_table("Training seeds", heads, rows, note)


def _horizon(content: Mapping[str, Any]) -> Section:
    charts = []
    for part, long in (("frames", ""), ("rollouts", "Long rollouts: ")):
        for mask in ("seen", "unseen"):
            where = MASK_NAMES[mask]
            for title, sides in (("PSNR", ("a", "b")), ("a − b", ("differences",))):
                found = {side: content[side][part][mask]["psnr"] for side in sides}
                lines = [
                    Line.with_interval(NAMES[side], COLOURS[side], entry)
                    for side, entry in found.items()
                ]
                charts.append(
                    LineChart(f"{long}{title}, {where}", "imagined frame", lines, unit="dB")
                )
    legend = {NAMES[side]: colour for side, colour in COLOURS.items()}
    note = "Bands are the 95 % intervals over houses, frame by frame."
    return Section("By horizon", [Charts(charts, legend), Text(note, "quiet")])


def _houses(content: Mapping[str, Any]) -> Section:
    rows = [
        [
            entry["house"],
            *(Cell(entry[mask], sign=True) for mask in MASK_NAMES),
            str(entry["clips"]),
        ]
        for entry in content["by_house"]
    ]
    table = Table.of(["a − b, PSNR, dB", *MASK_NAMES.values(), "clips"], rows)
    return Section("House by house", [Details(f"{len(rows)} houses", TableBlock(table))])


def _protocol(content: Mapping[str, Any]) -> Section:
    facts = [("protocol", content["protocol_sha256"])]
    facts += [(key.replace("_", " "), _text(value)) for key, value in content["protocol"].items()]
    facts += [
        (
            f"{side}, training seed {run['training_seed']}",
            f"{run['run']}, {run['weights_sha256']}, {run['sampling_steps']} sampling steps",
        )
        for side in ("a", "b")
        for run in content[side]["runs"]
    ]
    facts += [(key, _text(value)) for key, value in content["how"].items()]
    text = "Every number of this page is in `comparison.json` beside it."
    return Section("How this was measured", [Text(text), Facts(facts)])


def _text(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
