"""The report as one self-contained HTML page with embedded images and videos."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from html import escape
from typing import Any

from pewm_jax.eval.seen import TOLERANCE_M, TOLERANCE_RELATIVE
from pewm_jax.eval.statistics import ours
from pewm_jax.report import page_long, page_tables
from pewm_jax.report.gallery import ABOVE_CAMERA_M, Gallery
from pewm_jax.report.labels import METHOD_NAMES, summary_lines
from pewm_jax.report.pictures import png
from pewm_jax.report.plots import COLOURS, Line, chart

STYLE = """
:root { color-scheme: light dark; --ink: #1c2028; --paper: #fff; --quiet: #666d7a;
  --line: #dfe2e8; --tint: #f5f7fa; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8eaee; --paper: #15181d;
  --quiet: #9aa2b1; --line: #333944; --tint: #1d2128; } }
body { font: 16px/1.55 system-ui, sans-serif; color: var(--ink); background: var(--paper);
  max-width: 1080px; margin: 0 auto; padding: 2.5rem 1.25rem 5rem; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .4rem; }
h2 { font-size: 1.3rem; margin: 2.8rem 0 .6rem; }
p, figcaption, dd, li { max-width: 76ch; } p.lead { font-size: 1.15rem; }
.quiet, figcaption { color: var(--quiet); } figcaption { font-size: .9rem; margin-top: .4rem; }
figure { margin: 1.2rem 0; } img, video { max-width: 100%; border: 1px solid var(--line);
  border-radius: 6px; background: #fff; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
.scroll { overflow-x: auto; } th, td { padding: .34rem .9rem .34rem 0; text-align: right;
  white-space: nowrap; } th:first-child, td:first-child { text-align: left; }
thead th { border-bottom: 2px solid var(--line); font-weight: 600; }
tr.head td { padding-top: 1rem; font-weight: 600; text-align: left;
  border-bottom: 1px solid var(--line); } tr.gain td { background: var(--tint); }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(330px, 1fr)); gap: 1rem; }
svg { width: 100%; height: auto; font: 12px system-ui, sans-serif; }
svg text { fill: var(--ink); } svg .t { font-weight: 600; font-size: 13px; }
svg .m { text-anchor: middle; fill: var(--quiet); } svg .e { text-anchor: end; fill: var(--quiet); }
svg .g { stroke: var(--line); } .key { display: inline-block; width: 1.4em; height: .3em;
  vertical-align: middle; margin: 0 .4em 0 1.2em; border-radius: 2px; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .3rem 1.4rem; }
dt { color: var(--quiet); } dd { margin: 0; overflow-wrap: anywhere; }
code { font-size: .9em; overflow-wrap: anywhere; }
"""
INTRODUCTION = (
    "An agent walks through {places}, goes out and comes back. "
    "From what it observed on the way, the model imagines what comes next: {how}."
)
HOWS = {
    "memory": "with the 3D map it has drawn up, and with the same weights and an empty map",
    "model": "it has no memory, and knows the last picture alone",
}
"""How the model imagines, by its own row."""
TITLES = {
    "memory": "Does the model remember what it saw?",
    "model": "What does a model without a memory imagine?",
}
PLACES = {
    True: "places that the model was never trained on",
    False: "places of which the model was trained in {shared} of {scenes} (so this does not show "
    "how it does in new ones)",
    None: "places that the model may have been trained on (its training data is not there to tell)",
}
"""A phrase for each value of ``held_out`` in the protocol."""
SHOWN = {
    "memory": "the model with its map, the same model with an empty map",
    "model": "the model, which has no memory",
}
"""The model's columns in videos, by its own row."""


def introduction(protocol: Mapping[str, Any]) -> str:
    """Return a paragraph: what was done, and whether the places were new to the model."""
    places = PLACES[protocol["held_out"]].format(
        shared=len(protocol["trained_scenes"]), scenes=len(protocol["scene_names"])
    )
    return INTRODUCTION.format(places=places, how=HOWS[protocol.get("method", "memory")])


def embed(kind: str, content: bytes) -> str:
    """Return a data URI."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def render(metrics: Mapping[str, Any], gallery: Gallery) -> str:
    """Return the page as HTML.

    Args:
        metrics: the content of ``metrics.json``.
        gallery: images and videos.
    """
    seen, *others = summary_lines(metrics)
    title = TITLES[ours(metrics["results"])]
    sections = [
        f"<h1>{title}</h1>",
        f'<p class="quiet">{introduction(metrics["protocol"])}</p>',
        f'<p class="lead"><strong>{escape(seen)}</strong></p>',
        f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in others)}</ul>",
        _videos(gallery),
        _stills(gallery),
        "<h2>Scores</h2>",
        page_tables.scores(metrics),
        page_tables.houses(metrics),
        page_tables.steering(metrics),
        page_tables.structure(metrics),
        page_long.videos(metrics),
        _curves(metrics),
        page_tables.drift(metrics),
        page_long.growth(metrics),
        page_long.mirror(metrics),
        page_tables.coverage(metrics),
        _map(gallery),
        _protocol(metrics["protocol"]),
    ]
    return "\n".join(
        [
            '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{title}</title>\n<style>{STYLE}</style>\n</head>\n<body>",
            *sections,
            "</body>\n</html>\n",
        ]
    )


def _videos(gallery: Gallery) -> str:
    figures = [
        f'<figure><video controls autoplay loop muted playsinline src="{embed("video/mp4", film)}">'
        f"</video><figcaption>{escape(caption)}</figcaption></figure>"
        for caption, film in gallery.videos
    ]
    return (
        "<h2>Long rollouts, side by side</h2><p>From left to right the recording, "
        f"{SHOWN['model' if gallery.above is None else 'memory']}, and what was observed "
        "reprojected without a network. Above colour, below depth (bright is near). All start from "
        "the same observed picture and follow the same actions; after each clip the model goes on "
        "from its own last frame, while the reprojection only ever shows what was observed. The "
        "first episodes of the split, not chosen.</p>" + "".join(figures)
    )


def _stills(gallery: Gallery) -> str:
    return (
        f'<figure><img alt="truth, imagined, reprojected" '
        f'src="{embed("image/png", png(gallery.strip))}">'
        f"<figcaption>{escape(gallery.strip_note)}</figcaption></figure>"
        f'<figure><img alt="seen before" src="{embed("image/png", png(gallery.masks))}">'
        "<figcaption>What counts as seen before, in colour; what no observed frame had shown is "
        "grey. A pixel counts as seen if its true point in space projects into an observed frame "
        "and that frame's true depth agrees within the larger of "
        f"{100 * TOLERANCE_M:.0f} cm and {100 * TOLERANCE_RELATIVE:.0f} %. No network is asked."
        "</figcaption></figure>"
    )


def _lines(per_frame: Mapping[str, Any], mask: str, metric: str) -> list[Line]:
    return [
        Line(label, COLOURS[method], points["mean"], points["stderr"])
        for method, label in METHOD_NAMES.items()
        if method in per_frame
        for points in [per_frame[method][mask][metric]]
    ]


def _curves(metrics: Mapping[str, Any]) -> str:
    label = "imagined frame"
    clips, rollouts = metrics["per_frame"], metrics["long"]["per_frame"]
    charts = [
        chart("PSNR, pixels seen before", label, _lines(clips, "seen", "psnr"), unit="dB"),
        chart("PSNR, pixels never seen", label, _lines(clips, "unseen", "psnr"), unit="dB"),
        chart("Depth error, seen before", label, _lines(clips, "seen", "depth_mae"), unit="m"),
        chart(
            "Long rollouts: PSNR, seen before", label, _lines(rollouts, "seen", "psnr"), unit="dB"
        ),
    ]
    keys = "".join(
        f'<span class="key" style="background:{COLOURS[method]}"></span>{label}'
        for method, label in METHOD_NAMES.items()
        if method in clips
    )
    count = metrics["protocol"]["long_rollouts"]["rollouts"]
    return (
        f"<h2>Frame by frame</h2><p>{keys}</p>"
        f'<div class="charts">{"".join(f"<div>{c}</div>" for c in charts)}</div>'
        "<p class='quiet'>Bands are one standard error. The last chart follows "
        f"{count} rollouts, one per episode, over several clips: the model lives on its own "
        "frames.</p>"
    )


def _map(gallery: Gallery) -> str:
    if gallery.above is None:
        return ""
    return (
        "<h2>The map, from above</h2>"
        f'<figure><img alt="the map from above" src="{embed("image/png", png(gallery.above))}">'
        "<figcaption>Each square is one cell of the model's 3D map in the colour it remembers, "
        "drawn from below to above. Cells more than "
        f"{ABOVE_CAMERA_M:g} m above the camera (the ceiling) are left out. The red line is the "
        "agent's path through the frames the map was built from, the arrow where it looks. On the "
        "right, the same map after the rollout of the stills above wrote its imagined frames into "
        "it.</figcaption></figure>"
    )


def _protocol(protocol: Mapping[str, Any]) -> str:
    skip = {"config", "clip_list", "scene_names"}
    items = []
    for key, value in protocol.items():
        if key in skip or value is None:
            continue
        if key == "reproject":
            text = value["why"]
        elif isinstance(value, dict):
            text = ", ".join(f"{k.replace('_', ' ')} {v}" for k, v in value.items())
        else:
            text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
        items.append(f"<dt>{escape(key.replace('_', ' '))}</dt><dd>{escape(text)}</dd>")
    return (
        "<h2>How this was measured</h2><p>Every number of this page is in "
        "<code>metrics.json</code> beside it, with the configuration and the list of clips.</p>"
        f"<dl>{''.join(items)}</dl>"
    )
