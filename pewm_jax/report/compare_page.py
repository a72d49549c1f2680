"""The comparison of two runs as one self-contained HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pewm_jax.eval.fixed import Protocol
from pewm_jax.eval.statistics import OURS
from pewm_jax.report.gallery import ROWS, picture_steps
from pewm_jax.report.labels import MASK_NAMES, METRIC_NAMES, heading, spread
from pewm_jax.report.page import STYLE, embed
from pewm_jax.report.page_tables import table
from pewm_jax.report.pictures import grid, png
from pewm_jax.report.plots import Line, chart

INTRODUCTION = (
    "Two models, scored by one protocol: the same clips of the same houses, the same context, "
    "motion and noise. Differences are taken clip by clip."
)
COLOURS = {"a": "#1f6feb", "b": "#e8731a", "differences": "#1a9a6c"}
NOT_COMPARED = (
    "Compared is what every clip has a number of. FVD and KVD (one number of a set), the mirror "
    "test and SRC, drift, and the growth of the map are in the two reports."
)


def side_by_side(protocol: Protocol, one: Path, two: Path) -> list[np.ndarray]:
    """Draw the long rollouts that both reports show: the truth, the first run, the second.

    Args:
        protocol: of both.
        one: folder of the first one's report.
        two: folder of the second one's.

    Returns:
        A picture for each rollout of which both have the frames.
    """
    steps = picture_steps(protocol.long_horizon)
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
    """Return the file with the model's own frames: with its map, or of one without a memory."""
    files = [report / ROWS / f"{index:02d}-{method}.png" for method in OURS]
    return next((file for file in files if file.is_file()), files[0])


def sentences(content: Mapping[str, Any]) -> list[str]:
    """Return what the comparison says, for the page and the terminal.

    Args:
        content: of ``comparison.json``.
    """
    a, b = (content[side]["name"] for side in ("a", "b"))
    return [
        f"Over pixels {MASK_NAMES[mask]}: {outcome(content['differences']['clips'][mask], a, b)}"
        if mask != "all"
        else f"Over all pixels: {outcome(content['differences']['clips'][mask], a, b)}"
        for mask in MASK_NAMES
    ] + [*_same_weights(content), *_samplers(content)]


def _same_weights(content: Mapping[str, Any]) -> list[str]:
    """Say so where both sides are the same weights."""
    hashes = [{run["weights_sha256"] for run in content[side]["runs"]} for side in ("a", "b")]
    return ["a and b are the same weights."] if hashes[0] == hashes[1] else []


def _samplers(content: Mapping[str, Any]) -> list[str]:
    """Say how each side samples, where that differs."""
    steps, said = [], []
    for side in ("a", "b"):
        ways = [(run["sampling_steps"], run["sampler"]) for run in content[side]["runs"]]
        steps.append(ways)
        said.append(f"{side} imagines in {ways[0][0]} sampling steps ({ways[0][1]})")
    return [] if len({way for ways in steps for way in ways}) == 1 else [f"{', '.join(said)}."]


def outcome(entries: Mapping[str, Any], one: str, two: str) -> str:
    """Return the end of a sentence on whether the first run's PSNR is above the second's.

    Args:
        entries: ``[metric]`` of first − second.
        one: name of the first.
        two: name of the second.
    """
    found = entries["psnr"]
    if found["mean"] is None:
        return "there is nothing to compare."
    if found["low"] is None:
        return (
            f"a − b is {found['mean']:+.2f} dB in one house; how sure that is cannot be said from "
            "one."
        )
    amount = f"a − b is {spread(found, 2, sign=True)} dB over {found['houses']} houses"
    if found["low"] > 0:
        return f"a ({one}) is closer to the truth than b ({two}): {amount}."
    if found["high"] < 0:
        return f"b ({two}) is closer to the truth than a ({one}): {amount}."
    return f"no clear difference: {amount}."


def render(content: Mapping[str, Any], pictures: Sequence[np.ndarray]) -> str:
    """Return the page as HTML.

    Args:
        content: of ``comparison.json``.
        pictures: of ``side_by_side``.
    """
    first, *others = sentences(content)
    a, b = (escape(content[side]["name"]) for side in ("a", "b"))
    sections = [
        f"<h1>a: {a}<br>b: {b}</h1>",
        f'<p class="quiet">{INTRODUCTION}</p>',
        f'<p class="lead"><strong>{escape(first)}</strong></p>',
        f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in others)}</ul>",
        _stills(pictures),
        "<h2>Scores</h2>",
        _scores(content),
        _seeds(content),
        _curves(content),
        _houses(content),
        _protocol(content),
    ]
    return "\n".join(
        [
            '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{a} beside {b}</title>\n<style>{STYLE}</style>\n</head>\n<body>",
            *sections,
            "</body>\n</html>\n",
        ]
    )


def _stills(pictures: Sequence[np.ndarray]) -> str:
    if not pictures:
        return "<p class='quiet'>The two reports have no frames in common to show.</p>"
    figures = "".join(
        f'<figure><img alt="truth, a, b" src="{embed("image/png", png(picture))}"></figure>'
        for picture in pictures
    )
    return (
        "<h2>Side by side</h2><p>Long rollouts, the first of the protocol and not chosen: the "
        "truth, then each model (with its map, if it has one), going on from its own last "
        "frame.</p>" + figures
    )


def _scores(content: Mapping[str, Any]) -> str:
    measured = [name for name in METRIC_NAMES if name in content["differences"]["clips"]["all"]]
    heads = "".join(f"<th>{heading(name, content)}</th>" for name in measured)
    rows = []
    labels = {"a": "a", "b": "b", "differences": "a − b"}
    for mask, name in MASK_NAMES.items():
        rows.append(f'<tr class="head"><td colspan="{len(measured) + 2}">{name}</td></tr>')
        for side, label in labels.items():
            rows.append(_row(label, content[side]["clips"][mask], measured))
    left = "".join(
        f" {METRIC_NAMES[name][0]} is left out: the two were measured with different networks."
        for name in content["left_out"]
    )
    left += "".join(
        f" {METRIC_NAMES[name][0]} is left out: only one of the two was measured with it."
        for name in content["measured_by_one"]
        if name in METRIC_NAMES
    )
    return (
        table(f"<th></th>{heads}<th>houses</th>", rows)
        + "<p class='quiet'>Means over houses of the means within a house, sampling and training "
        "seeds averaged first; in brackets the 95 % interval of a bootstrap over houses. A "
        f"difference whose interval does not hold 0 is clear. {NOT_COMPARED}{left}</p>"
    )


def _row(label: str, entries: Mapping[str, Any], measured: Sequence[str]) -> str:
    gain = label == "a − b"
    cells = "".join(
        f"<td>{spread(entries[m], METRIC_NAMES[m][1], sign=gain) if m in entries else '–'}</td>"
        for m in measured
    )
    kind = ' class="gain"' if gain else ""
    return f"<tr{kind}><td>{label}</td>{cells}<td>{entries['psnr']['houses']}</td></tr>"


def _seeds(content: Mapping[str, Any]) -> str:
    """Return PSNR by training seed; a sentence where each model was trained once."""
    trained = {side: content[side]["runs"] for side in ("a", "b")}
    if max(map(len, trained.values())) < 2:
        return (
            "<p class='quiet'>Each model was trained once: how much another training seed would "
            "change is not known (name more seeds by <code>--also_a</code> and "
            "<code>--also_b</code>).</p>"
        )
    rows = []
    for mask, name in MASK_NAMES.items():
        rows.append(f'<tr class="head"><td colspan="3">{name}</td></tr>')
        for side in ("a", "b"):
            found = content["training_seeds"][side][mask]["psnr"]
            pairs = zip(trained[side], found["per_seed"], strict=True)
            each = ", ".join(
                f"{run['training_seed']}: {'–' if value is None else f'{value:.2f}'}"
                for run, value in pairs
            )
            rows.append(f"<tr><td>{side}</td><td>{each}</td><td>{spread(found, 2)}</td></tr>")
        found = content["training_seeds"]["differences"][mask]["psnr"]
        shown = spread(found, 2, sign=True)
        rows.append(f'<tr class="gain"><td>a − b</td><td></td><td>{shown}</td></tr>')
    return (
        "<h2>Training seeds</h2>"
        + table("<th>PSNR, dB</th><th>seed: mean over houses</th><th>over seeds</th>", rows)
        + "<p class='quiet'>In brackets Student's 95 % interval over training seeds: what another "
        "training would give in these houses. It says nothing of other houses, nor the interval "
        "over houses of other trainings.</p>"
    )


def _curves(content: Mapping[str, Any]) -> str:
    label, charts = "imagined frame", []
    for part, long in (("frames", ""), ("rollouts", "Long rollouts: ")):
        for mask in ("seen", "unseen"):
            where = MASK_NAMES[mask]
            both = [_line(content, side, part, mask) for side in ("a", "b")]
            apart = [_line(content, "differences", part, mask)]
            charts.append(chart(f"{long}PSNR, {where}", label, both, unit="dB"))
            charts.append(chart(f"{long}a − b, {where}", label, apart, unit="dB"))
    names = {"a": "a", "b": "b", "differences": "a − b"}
    keys = "".join(
        f'<span class="key" style="background:{COLOURS[side]}"></span>{name}'
        for side, name in names.items()
    )
    return (
        f"<h2>By horizon</h2><p>{keys}</p>"
        f'<div class="charts">{"".join(f"<div>{c}</div>" for c in charts)}</div>'
        "<p class='quiet'>Bands are as wide as the 95 % intervals over houses, frame by frame, "
        "drawn symmetric; <code>comparison.json</code> has their ends.</p>"
    )


def _line(content: Mapping[str, Any], side: str, part: str, mask: str) -> Line:
    found = content[side][part][mask]["psnr"]
    ends = zip(found["low"], found["high"], strict=True)
    halves = [None if low is None else (high - low) / 2 for low, high in ends]
    return Line(side, COLOURS[side], found["mean"], halves)


def _houses(content: Mapping[str, Any]) -> str:
    rows = []
    for entry in content["by_house"]:
        cells = "".join(
            f"<td>{'–' if entry[mask] is None else f'{entry[mask]:+.2f}'}</td>"
            for mask in MASK_NAMES
        )
        rows.append(f"<tr><td>{escape(entry['house'])}</td>{cells}<td>{entry['clips']}</td></tr>")
    heads = "".join(f"<th>{name}</th>" for name in MASK_NAMES.values())
    shown = table(f"<th>a − b, PSNR, dB</th>{heads}<th>clips</th>", rows)
    return f"<h2>House by house</h2><details><summary>{len(rows)} houses</summary>{shown}</details>"


def _protocol(content: Mapping[str, Any]) -> str:
    items = [("protocol", content["protocol_sha256"])]
    items += [(key.replace("_", " "), value) for key, value in content["protocol"].items()]
    items += [
        (
            f"{side}, training seed {run['training_seed']}",
            f"{run['run']}, {run['weights_sha256']}, {run['sampling_steps']} sampling steps",
        )
        for side in ("a", "b")
        for run in content[side]["runs"]
    ]
    items += [(key, value) for key, value in content["how"].items()]
    listed = "".join(
        f"<dt>{escape(str(key))}</dt><dd>{escape(_text(value))}</dd>" for key, value in items
    )
    return (
        "<h2>How this was measured</h2><p>Every number of this page is in "
        f"<code>comparison.json</code> beside it.</p><dl>{listed}</dl>"
    )


def _text(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
