"""The tables of the report's page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from pewm_jax.eval.statistics import ours
from pewm_jax.report.labels import (
    ACTIONS_NAMES,
    COVERAGE_NAMES,
    MASK_NAMES,
    METHOD_NAMES,
    METRIC_NAMES,
    RIVALS,
    heading,
    number,
    spread,
)

CLUSTERS = {
    "scene": "clustered by scene, because clips of one scene show the same rooms",
    "episode": "clustered by episode: all clips are of one scene, and how much other scenes would "
    "differ cannot be said",
}
"""A phrase for each value of ``clustered_by`` in the protocol: what a standard error covers."""
MINUS = {"memory": "map", "model": "the model"}
"""What others are subtracted from in the tables, by the model's own row."""
QUARTERS = ("first quarter", "second", "third", "last")


def scores(metrics: Mapping[str, Any]) -> str:
    """Return every method's scores, and the margins of the model."""
    own = ours(metrics["results"])
    minus = MINUS[own]
    measured = [name for name in METRIC_NAMES if name in metrics["results"][own]["all"]]
    heads = "".join(f"<th>{heading(name, metrics['protocol'])}</th>" for name in measured)
    rows = []
    for mask, name in MASK_NAMES.items():
        rows.append(f'<tr class="head"><td colspan="{len(measured) + 2}">{name}</td></tr>')
        for method, label in METHOD_NAMES.items():
            if method in metrics["results"]:
                rows.append(_row(label, metrics["results"][method][mask], measured))
        for method in RIVALS:
            if method in metrics["margins"]:
                label = f"{minus} minus {METHOD_NAMES[method]}"
                entries = metrics["margins"][method][mask]
                rows.append(_row(label, entries, measured, gain=True))
    seeds = metrics["protocol"]["seeds"]
    cover = CLUSTERS[metrics["protocol"]["clustered_by"]]
    gain = ""
    if metrics["margin"]:
        each = metrics["margin"]["seen"]["psnr"]["per_seed"]
        gain = (
            " Gain of the map over an empty one on pixels seen before, seed by seed "
            f"({', '.join(map(str, seeds))}): {', '.join(f'{value:+.2f}' for value in each)} dB."
        )
    return (
        table(f"<th></th>{heads}<th>clips</th>", rows)
        + "<p class='quiet'>Mean ± standard error over clips. Sampling seeds are averaged within a "
        f"clip first, and the error is {cover}. "
        f"Differences are taken clip by clip, among models with the same noise.{gain}</p>"
    )


def houses(metrics: Mapping[str, Any]) -> str:
    """Return means over houses with their intervals, and the paired differences; PSNR."""
    found, rows = metrics["houses"], []
    minus = MINUS[ours(found["results"])]
    frames = metrics["protocol"]["imagined_frames"]
    ends = sorted({0, (frames - 1) // 2, frames - 1})
    for mask, name in MASK_NAMES.items():
        rows.append(f'<tr class="head"><td colspan="{len(ends) + 3}">{name}</td></tr>')
        for part, sign in (("results", False), ("margins", True)):
            for method, label in METHOD_NAMES.items():
                if method not in found[part]:
                    continue
                whole = found[part][method][mask]["psnr"]
                steps = found["per_frame_margins" if sign else "per_frame"][method][mask]["psnr"]
                at = [{key: steps[key][t] for key in ("mean", "low", "high")} for t in ends]
                cells = "".join(f"<td>{spread(e, 2, sign=sign)}</td>" for e in (whole, *at))
                kind, shown = (' class="gain"', f"{minus} minus {label}") if sign else ("", label)
                rows.append(f"<tr{kind}><td>{shown}</td>{cells}<td>{whole['houses']}</td></tr>")
    heads = "".join(f"<th>frame {t + 1}</th>" for t in ends)
    return (
        "<h2>House by house</h2>"
        + table(f"<th>PSNR, dB</th><th>all frames</th>{heads}<th>{found['house']}s</th>", rows)
        + f"<p class='quiet'>Mean within each {found['house']} first, then over {found['house']}s; "
        f"in brackets the {100 * found['how']['level']:.0f} % interval of a bootstrap over them "
        f"({found['how']['draws']} draws). Differences are paired. This is one training: how much "
        "another training seed would change is a question of its own (<code>pewm-jax compare "
        "--also_a</code>).</p>"
    )


def steering(metrics: Mapping[str, Any]) -> str:
    """Return PSNR with the true actions, with others and with none; "" where none was measured."""
    found = metrics.get("steering")
    if not found:
        return ""
    ends = [0, len(found["per_frame"]["true"]["mean"]) - 1]
    rows = []
    for name, label in ACTIONS_NAMES.items():
        if name not in found["all"]:
            continue
        steps, sign = found["per_frame"][name], "-" in name
        at = [{key: steps[key][t] for key in ("mean", "low", "high")} for t in ends]
        cells = "".join(f"<td>{spread(e, 2, sign=sign)}</td>" for e in (found["all"][name], *at))
        rows.append(f"<tr{' class=gain' if sign else ''}><td>{label}</td>{cells}</tr>")
    heads = "".join(f"<th>frame {t + 1}</th>" for t in ends)
    return (
        "<h2>Do the actions steer?</h2>"
        + table(f"<th>PSNR, dB</th><th>all frames</th>{heads}", rows)
        + f"<p class='quiet'>{found['clips']} walks with the same noise: "
        f"{100 * found['forward']:.0f} % of their steps go forward. Another clip's actions are of "
        f"one in another house; they differ in {100 * found['different']:.0f} % of the steps. "
        "Means over houses, in brackets the interval of a bootstrap over them. A world that "
        "follows its actions is nearest to the truth with the true ones.</p>"
    )


def structure(metrics: Mapping[str, Any]) -> str:
    """Return SCS of every method and its ceiling; "" where it was not measured."""
    found = metrics.get("scs")
    if not found:
        return ""
    ends = [0, len(found["ceiling_per_frame"]["mean"]) - 1]

    def row(label: str, whole: Mapping[str, Any], steps: Mapping[str, Any]) -> str:
        at = [{key: steps[key][t] for key in ("mean", "low", "high")} for t in ends]
        cells = "".join(f"<td>{spread(e, 1)}</td>" for e in (whole, *at))
        return f"<tr><td>{label}</td>{cells}<td>{whole['houses']}</td></tr>"

    rows = [
        row(label, found["results"][method], found["per_frame"][method])
        for method, label in METHOD_NAMES.items()
        if method in found["results"]
    ]
    rows.append(row("the true clip", found["ceiling"], found["ceiling_per_frame"]))
    heads = "".join(f"<th>frame {t + 1}</th>" for t in ends)
    return (
        "<h2>Are things where they should be?</h2>"
        + table(f"<th>{found['name']}</th><th>all frames</th>{heads}<th>houses</th>", rows)
        + "<p class='quiet'>Structural consistency score: 100 × IoU of the masks of things in the "
        "imagined and the true clip, mean over things and frames; higher is better. Frames count "
        "until nothing that the present frame shows is visible any more. The masks of imagined "
        "clips come from a segmenter, and the last row is the true clip with the same segmenter. "
        f"{found['clips']} clips, first sampling seed; means over houses, in brackets the interval "
        "of a bootstrap over them.</p>"
    )


def drift(metrics: Mapping[str, Any]) -> str:
    """Return PSNR over pixels seen before along long rollouts, by quarter."""
    rows = []
    for method, entry in metrics["long"]["drift"].items():
        shown = [*entry["quarters"], entry["first16"], entry["last16"], entry["difference"]]
        cells = "".join(
            f"<td>{'–' if one is None else number(one, 2, sign=i == 6)}</td>"
            for i, one in enumerate(shown)
        )
        rows.append(f"<tr><td>{METHOD_NAMES[method]}</td>{cells}</tr>")
    heads = (*QUARTERS, "first 16 frames", "last 16", "difference")
    frames = metrics["protocol"]["long_rollouts"]["frames_each"]
    return (
        f"<h2>Drift</h2><p>PSNR over pixels seen before, dB, along rollouts of {frames} frames.</p>"
        + table("<th></th>" + "".join(f"<th>{head}</th>" for head in heads), rows)
    )


def coverage(metrics: Mapping[str, Any]) -> str:
    """Return which share of the pixels seen before the model's map could show it; "" if unknown."""
    shares = metrics["coverage"]
    if not shares:
        return ""
    rows = [
        f"<tr><td>{escape(label)}</td><td>{100 * shares[key]:.1f} %</td></tr>"
        for key, label in COVERAGE_NAMES.items()
    ]
    return (
        "<h2>What the map covers</h2><p>Of the pixels seen before, the share whose surface is</p>"
        + table("<th></th><th>share</th>", rows)
    )


def _row(
    label: str, entries: Mapping[str, Any], measured: Sequence[str], *, gain: bool = False
) -> str:
    """Return a row of the table; a dash where a metric is not measured under a mask."""
    cells = "".join(
        f"<td>{number(entries[m], METRIC_NAMES[m][1], sign=gain) if m in entries else '–'}</td>"
        for m in measured
    )
    kind = ' class="gain"' if gain else ""
    return f"<tr{kind}><td>{label}</td>{cells}<td>{entries['psnr']['n']}</td></tr>"


def table(heads: str, rows: list[str]) -> str:
    """Return a table, which scrolls where it is too wide; cells and rows are HTML already."""
    return (
        f'<div class="scroll"><table><thead><tr>{heads}</tr></thead><tbody>'
        + "".join(rows)
        + "</tbody></table></div>"
    )
