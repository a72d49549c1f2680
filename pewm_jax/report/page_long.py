"""The report's page on videos as wholes, on the mirror test and on how the map grows."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

from pewm_jax.report.labels import METHOD_NAMES, spread
from pewm_jax.report.page_tables import table
from pewm_jax.report.plots import COLOURS, Line, chart

PAIR_NAMES = {
    "again": "second visit against the first",
    "out": "first visit against the truth",
    "back": "second visit against the truth",
}
"""What is compared in the mirror test."""


def videos(metrics: Mapping[str, Any]) -> str:
    """Return FVD and KVD with their floors; a sentence where they were not measured."""
    found = metrics["videos"]
    if not found:
        return f"<p class='quiet'>{escape(metrics['protocol']['fvd'])}</p>"
    rows = []
    for method, label in METHOD_NAMES.items():
        if method in found["results"]:
            cells = "".join(_distance(found["results"][method][name]) for name in found["names"])
            rows.append(f"<tr><td>{label}</td>{cells}</tr>")
    heads = "".join(
        f"<th>{name} ↓</th><th>halves</th><th>their floor</th>" for name in found["names"].values()
    )
    return (
        "<h2>Videos as a whole</h2>"
        + table(f"<th></th>{heads}", rows)
        + f"<p class='quiet'>{escape(metrics['protocol']['fvd'])}. Clips of {found['frames']} "
        f"frames, the observed one with them; sampling seed {found['seed']}. FVD depends on the "
        "number of clips: compare it only at equal names. <em>Halves</em> compares half of the "
        "imagined clips with the truth of the others, the floor compares the truth of the same "
        "halves (mean ± standard deviation over random halves): the nearer the two, the less there "
        "is to be told apart.</p>"
    )


def _distance(entry: Mapping[str, Any]) -> str:
    halves = [
        "–" if entry[name] is None else f"{entry[name]['mean']:.4g} ± {entry[name]['std']:.2g}"
        for name in ("half", "floor")
    ]
    return "".join(f"<td>{text}</td>" for text in (f"{entry['value']:.4g}", *halves))


def growth(metrics: Mapping[str, Any]) -> str:
    """Return how the map grows along long rollouts; "" without a map."""
    found = metrics["long"]["growth"]
    if not found:
        return ""
    held = found["occupied"]
    drawn = chart(
        "Held by the map", "imagined frames", [_line("memory", held)], places=found["frames"]
    )
    return (
        f'<h2>How the map grows</h2><div class="charts"><div>{drawn}</div></div>'
        "<p class='quiet'>Cells or surfels that the map holds, from what was observed (0 frames) "
        f"on, after each imagined clip; it has room for {found['capacity']}. Mean over houses; the "
        "band is as wide as its 95 % interval.</p>"
    )


def mirror(metrics: Mapping[str, Any]) -> str:
    """Return the mirror test; a sentence where it was left out."""
    found = metrics["mirror"]
    if not found:
        return f"<p class='quiet'>{escape(metrics['protocol']['mirror'])}</p>"
    label = "frames between both visits"
    charts = [
        chart(
            f"PSNR, {name}",
            label,
            [_line(method, pairs[pair]) for method, pairs in found["by_distance"].items()],
            unit="dB",
            places=found["distances"],
        )
        for pair, name in PAIR_NAMES.items()
    ]
    rows = []
    for name in found["ceiling"]:
        cells = "".join(
            f"<td>{spread(entries[name], 3)}</td>"
            for entries in (*found["results"].values(), found["ceiling"])
        )
        floor = spread(found["floor"][name], 3) if name in found["floor"] else "–"
        rows.append(f"<tr><td>{escape(name)}</td>{cells}<td>{floor}</td></tr>")
    heads = "".join(f"<th>{METHOD_NAMES[method]}</th>" for method in found["results"])
    keys = "".join(
        f'<span class="key" style="background:{COLOURS[method]}"></span>{METHOD_NAMES[method]}'
        for method in found["results"]
    )
    return (
        f"<h2>There and back</h2><p>The agent goes {found['out']} frames along the recorded way "
        "and comes back the same way, so that it is at each place twice; the model imagines all of "
        f"it.</p><p>{keys}</p>"
        f'<div class="charts">{"".join(f"<div>{c}</div>" for c in charts)}</div>'
        + table(f"<th>way back against way out</th>{heads}<th>ceiling</th><th>floor</th>", rows)
        + f"<p class='quiet'>{found['rollouts']} rollouts. Mean over houses, in brackets the 95 % "
        "interval of a bootstrap over them. The ceiling is the recording, turned round at its end; "
        "the floor compares the way out with another rollout's way back. Consistency says nothing "
        "of truth: a model that always shows one picture comes back to it perfectly, so both "
        f"visits are also compared with the truth. {escape(metrics['protocol']['src'])}</p>"
    )


def _line(method: str, entry: Mapping[str, Any]) -> Line:
    ends = zip(entry["low"], entry["high"], strict=True)
    halves = [None if low is None else (high - low) / 2 for low, high in ends]
    return Line(METHOD_NAMES[method], COLOURS[method], entry["mean"], halves)
