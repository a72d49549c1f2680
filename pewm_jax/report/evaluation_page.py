"""The page of one evaluation: verdicts, videos, scores with their uncertainty, and the protocol."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from pewm_jax.report.charts import METHOD_COLOURS, Line, LineChart
from pewm_jax.report.labels import (
    COVERAGE_NAMES,
    MASK_NAMES,
    METHOD_NAMES,
    METRIC_NAMES,
    RIVALS,
    heading,
    labelled,
    own_method,
    steering_table,
    summary_lines,
    voxel_table,
)
from pewm_jax.report.page import (
    Bullets,
    Charts,
    Facts,
    Figure,
    Section,
    TableBlock,
    Text,
    render,
)
from pewm_jax.report.pictures import png
from pewm_jax.report.table import Row, Table, row, with_error, with_frames, with_interval
from pewm_jax.report.table import heading as heading_row

INTRODUCTION = (
    "An agent walks through {places}, goes out and comes back. "
    "From what it observed on the way, the model imagines what comes next: {how}."
)
HOWS = {
    "memory": "with its 3D map, and with the same weights and an empty map",
    "model": "it has no memory and sees only the last frame",
}
"""How the model imagines, by the key of its own row."""
TITLES = {
    "memory": "Does the model remember what it saw?",
    "model": "What does a model without a memory imagine?",
}
PLACES = {
    True: "places that the model was never trained on",
    False: "places of which the model was trained in {shared} of {scenes} (so this does not show "
    "how it generalizes to new ones)",
    None: "places that the model may have been trained on (its training data is not available)",
}
"""A phrase for each value of ``held_out`` in the protocol."""
SHOWN = {
    "memory": "the model with its map, the same model with an empty map",
    "model": "the model, which has no memory",
}
"""The model's columns in videos, by the key of its own row."""
CLUSTERS = {
    "scene": "clustered by scene, because clips of one scene show the same rooms",
    "episode": "clustered by episode: all clips are of one scene, so the error does not cover how "
    "much other scenes differ",
}
"""Clustering of a standard error, for each value of ``clustered_by`` in the protocol."""
MINUS = {"memory": "map", "model": "the model"}
"""The minuend of differences in the tables, by the key of the model's own row."""
QUARTERS = ("first quarter", "second", "third", "last")
PAIR_NAMES = {
    "again": "second visit against the first",
    "out": "first visit against the truth",
    "back": "second visit against the truth",
}
"""The comparisons of the mirror test."""


@dataclasses.dataclass(frozen=True)
class Gallery:
    """The images and videos of a report.

    Attributes:
        videos: (caption, MP4) of each long rollout.
        strip: frames of one rollout in rows: ground truth, with its map, empty map, reprojected;
            for a model without a memory one row instead of two.
        moving: all frames of that rollout side by side, a GIF.
        masks: the same ground-truth frames with never-seen pixels greyed out; None if the data have
            no depth or poses.
        above: the map from above, before and after that rollout; None without a memory.
        rows: for each rollout shown, the frames of ``truth`` and of each method at the steps of
            ``strip``, side by side in one image and at full size.
    """

    videos: list[tuple[str, bytes]]
    strip: np.ndarray
    strip_note: str
    moving: bytes
    masks: np.ndarray | None
    masks_note: str
    above: np.ndarray | None
    above_note: str
    rows: list[dict[str, np.ndarray]]


def evaluation_page(metrics: Mapping[str, Any], gallery: Gallery) -> str:
    """Return the page of ``metrics.json``, with images and videos, as HTML."""
    first, *others = summary_lines(metrics)
    introduced = Text(introduction(metrics["protocol"]), "quiet")
    opening = [introduced, Text(first, "lead"), Bullets(others)]
    above = None
    if gallery.above is not None:
        figure = Figure(png(gallery.above), alt="the map from above", caption=gallery.above_note)
        above = Section("The map, from above", [figure])
    measured = (
        *(scores, houses, steering, structure, videos),
        *(_frame_by_frame, drift, growth, mirror, coverage, voxels),
    )
    sections = [_rollouts(gallery), *(part(metrics) for part in measured), above]
    sections.append(_protocol(metrics["protocol"]))
    return render(TITLES[own_method(metrics["results"])], opening, sections)


def introduction(protocol: Mapping[str, Any]) -> str:
    """Return an introduction: the task, and whether the places were in the training data."""
    places = PLACES[protocol["held_out"]].format(
        shared=len(protocol["trained_scenes"]), scenes=len(protocol["scene_names"])
    )
    return INTRODUCTION.format(places=places, how=HOWS[protocol.get("method", "memory")])


def _rollouts(gallery: Gallery) -> Section:
    shown = SHOWN["model" if gallery.above is None else "memory"]
    columns, rest = f"the recording and {shown}", ""
    if any("reproject" in item for item in gallery.rows):
        columns = (
            f"the recording, {shown}, and the reprojection of observed pixels, without a network"
        )
        rest = "; the reprojection only shows observed pixels"
    text = (
        f"From left to right: {columns}. Colour above, depth below (bright is near). All start "
        "from the same observed frame and follow the same actions. After each clip the model "
        f"continues from its own last frame{rest}. These are the first episodes of the split, not "
        "selected."
    )
    films = [Figure(film, "video/mp4", caption=caption) for caption, film in gallery.videos]
    stills = [
        Figure(png(gallery.strip), alt="truth, imagined, reprojected", caption=gallery.strip_note)
    ]
    if gallery.masks is not None:
        masks = png(gallery.masks)
        stills.append(Figure(masks, alt="seen before", caption=gallery.masks_note))
    return Section("Long rollouts, side by side", [Text(text), *films, *stills])


def scores(metrics: Mapping[str, Any]) -> Section:
    """Return every method's scores, and the margins of the model."""
    own = own_method(metrics["results"])
    measured = [name for name in METRIC_NAMES if name in metrics["results"][own]["all"]]

    def line(label: str, entries: Mapping[str, Any], *, gain: bool = False) -> Row:
        cells = [with_error(entries.get(m), METRIC_NAMES[m][1], sign=gain) for m in measured]
        return row(label, *cells, str(entries["psnr"]["n"]), highlight=gain)

    rows = []
    for mask, name in MASK_NAMES.items():
        rows.append(heading_row(name))
        for method, label in labelled(metrics["results"]):
            rows.append(line(label, metrics["results"][method][mask]))
        for method in RIVALS:
            if method in metrics["margins"]:
                label = f"{MINUS[own]} minus {METHOD_NAMES[method]}"
                rows.append(line(label, metrics["margins"][method][mask], gain=True))
    heads = [heading(name, metrics["protocol"]) for name in measured]
    seeds = metrics["protocol"]["seeds"]
    gain = ""
    if metrics["margin"]:
        each = metrics["margin"]["seen"]["psnr"]["per_seed"]
        gain = (
            " Gain of the map over an empty one on pixels seen before, for each seed "
            f"({', '.join(map(str, seeds))}): {', '.join(f'{value:+.2f}' for value in each)} dB."
        )
    note = (
        "Mean ± standard error over clips. Sampling seeds are averaged within a clip first, and "
        f"the error is {CLUSTERS[metrics['protocol']['clustered_by']]}. Differences are taken clip "
        f"by clip, among models with the same noise.{gain}"
    )
    return Section.of_table("Scores", ["", *heads, "clips"], rows, note)


def houses(metrics: Mapping[str, Any]) -> Section:
    """Return means over houses with their intervals, and the paired differences; PSNR."""
    found, rows = metrics["houses"], []
    minus = MINUS[own_method(found["results"])]
    frames = metrics["protocol"]["imagined_frames"]
    ends = sorted({0, (frames - 1) // 2, frames - 1})
    for mask, name in MASK_NAMES.items():
        rows.append(heading_row(name))
        for part, gain in (("results", False), ("margins", True)):
            steps = "per_frame_margins" if gain else "per_frame"
            for method, label in labelled(found[part]):
                whole = found[part][method][mask]["psnr"]
                by_frame = found[steps][method][mask]["psnr"]
                cells = with_frames(whole, by_frame, ends, 2, sign=gain)
                shown = f"{minus} minus {label}" if gain else label
                rows.append(row(shown, *cells, str(whole["houses"]), highlight=gain))
    heads = ["PSNR, dB", "all frames", *(f"frame {t + 1}" for t in ends), f"{found['house']}s"]
    note = (
        f"Mean within each {found['house']} first, then over {found['house']}s; in brackets the "
        f"{100 * found['how']['level']:.0f} % interval of a bootstrap over them "
        f"({found['how']['draws']} draws). Differences are paired. These numbers are of one "
        "training; to measure how much the training seed matters, use `pewm-jax compare --also_a`."
    )
    return Section.of_table("House by house", heads, rows, note)


STEERING_NOTES = {
    "lpips": "LPIPS is better the lower it is.",
    "scs": "SCS is 100 × IoU of the masks of objects, exact in the true clip and segmented in the "
    "imagined one.",
    "arms": "The IoU of the arms compares the agent's arms and hands, found by their colour, with "
    "their exact masks, in frames that show them.",
}
"""Score of steered clips → a sentence about it."""


def steering(metrics: Mapping[str, Any]) -> Section | None:
    """Return the scores by kind of actions; None if they were not measured."""
    found = metrics.get("steering")
    if not found:
        return None
    recorded = found.get("recorded")
    walks = "clips with the same noise" if recorded else "walks with the same noise"
    about = (
        f"{found['clips']} {walks}: {100 * found['forward']:.0f} % of their "
        "steps go forward. Another clip's actions are those of a clip in another house; they "
        f"differ in {100 * found['different']:.0f} % of the steps. Means over houses, in brackets "
        "the interval of a bootstrap over them. A world that follows its actions is closest to the "
        "ground truth with the true ones."
    )
    notes = [about, *(STEERING_NOTES[name] for name in found.get("scores", {}))]
    table = steering_table(found)
    title = "Do the actions steer the model?"
    return Section.of_table(title, table.header, table.rows, " ".join(notes))


def structure(metrics: Mapping[str, Any]) -> Section | None:
    """Return SCS of every method and its ceiling; None if not measured."""
    found = metrics.get("scs")
    if not found:
        return None
    ends = [0, len(found["ceiling_per_frame"]["mean"]) - 1]
    entries = {
        label: (found["results"][method], found["per_frame"][method])
        for method, label in labelled(found["results"])
    }
    entries["the true clip"] = found["ceiling"], found["ceiling_per_frame"]
    rows = [
        row(label, *with_frames(whole, steps, ends, 1), str(whole["houses"]))
        for label, (whole, steps) in entries.items()
    ]
    heads = [found["name"], "all frames", *(f"frame {t + 1}" for t in ends), "houses"]
    note = (
        "Structural consistency score: 100 × IoU of the masks of objects in the imagined and the "
        "true clip, mean over objects and frames; higher is better. Frames count until nothing "
        "that the present frame shows is visible any more. The masks of imagined clips come from "
        "a segmenter, and the last row is the true clip with the same segmenter. "
        f"{found['clips']} clips, first sampling seed; means over houses, in brackets the interval "
        "of a bootstrap over them."
    )
    return Section.of_table("Are objects where they should be?", heads, rows, note)


def videos(metrics: Mapping[str, Any]) -> Section:
    """Return FVD and KVD with their floors, or the reason why they were not measured."""
    found = metrics["videos"]
    if not found:
        return Section.of_note(metrics["protocol"]["fvd"])
    rows = []
    tables = {**found.get("masks", {}), "all": found["results"]}
    for mask, results in tables.items():
        rows += [heading_row(MASK_NAMES[mask])] if len(tables) > 1 else []
        for method, label in labelled(results):
            entries = [results[method][name] for name in found["names"]]
            rows.append(row(label, *(cell for entry in entries for cell in _distance(entry))))
    heads = [
        head for name in found["names"].values() for head in (f"{name} ↓", "halves", "their floor")
    ]
    note = (
        f"{metrics['protocol']['fvd']}. Clips of {found['frames']} frames, including the observed "
        f"one; sampling seed {found['seed']}. FVD depends on the number of clips: compare it only "
        "at equal names. Halves compares half of the imagined clips with the truth of the others; "
        "the floor compares the truth of the same halves (mean ± standard deviation over random "
        "halves). The closer the two, the less imagined and true clips can be told apart. Clips "
        "compared over pixels seen before, or never seen, show the truth at all other pixels."
    )
    return Section.of_table("Videos as a whole", ["", *heads], rows, note)


def _distance(entry: Mapping[str, Any]) -> list[str]:
    halves = (entry["half"], entry["floor"])
    shown = ("–" if x is None else f"{x['mean']:.4g} ± {x['std']:.2g}" for x in halves)
    return [f"{entry['value']:.4g}", *shown]


def _frame_by_frame(metrics: Mapping[str, Any]) -> Section:
    clips, rollouts = metrics["per_frame"], metrics["long"]["per_frame"]
    charts = [
        LineChart(title, "imagined frame", _error_lines(scores, mask, metric), unit=unit)
        for title, scores, mask, metric, unit in (
            ("PSNR, pixels seen before", clips, "seen", "psnr", "dB"),
            ("PSNR, pixels never seen", clips, "unseen", "psnr", "dB"),
            ("Depth error, seen before", clips, "seen", "depth_mae", "m"),
            ("Long rollouts: PSNR, seen before", rollouts, "seen", "psnr", "dB"),
        )
    ]
    count = metrics["protocol"]["long_rollouts"]["rollouts"]
    note = (
        f"Bands are one standard error. The last chart follows {count} rollouts, one per episode, "
        "over several clips: the model continues from its own frames."
    )
    return Section("Frame by frame", [Charts(charts, legend(clips)), Text(note, "quiet")])


def legend(methods: Collection[str]) -> dict[str, str]:
    """Return the colours of some methods by their names, in the order of the tables."""
    return {label: METHOD_COLOURS[method] for method, label in labelled(methods)}


def _error_lines(per_frame: Mapping[str, Any], mask: str, metric: str) -> list[Line]:
    return [
        Line.with_errors(label, METHOD_COLOURS[method], points["mean"], points["stderr"])
        for method, label in labelled(per_frame)
        for points in [per_frame[method][mask][metric]]
    ]


def drift(metrics: Mapping[str, Any]) -> Section:
    """Return PSNR over pixels seen before along long rollouts, by quarter."""
    rows = [
        row(
            METHOD_NAMES[method],
            *(with_error(x, 2) for x in (*entry["quarters"], entry["first16"], entry["last16"])),
            with_error(entry["difference"], 2, sign=True),
        )
        for method, entry in metrics["long"]["drift"].items()
    ]
    heads = ["", *QUARTERS, "first 16 frames", "last 16", "difference"]
    frames = metrics["protocol"]["long_rollouts"]["frames_each"]
    text = f"PSNR over pixels seen before, dB, along rollouts of {frames} frames."
    return Section.of_table("Drift", heads, rows, text=text)


def growth(metrics: Mapping[str, Any]) -> Section | None:
    """Return how the map grows along long rollouts; None without a map."""
    found = metrics["long"]["growth"]
    if not found:
        return None
    chart = LineChart(
        "Points in the map",
        "imagined frames",
        [_interval_line("memory", found["occupied"])],
        x=found["frames"],
    )
    room = f"; its capacity is {found['capacity']}" if found["capacity"] else ""
    note = (
        "Points in the map, from the observed frames (0) on, after each imagined clip"
        f"{room}. Mean over houses with its 95 % interval."
    )
    return Section("How the map grows", [Charts([chart]), Text(note, "quiet")])


def mirror(metrics: Mapping[str, Any]) -> Section:
    """Return the mirror test, or the reason why it was skipped."""
    found = metrics["mirror"]
    if not found:
        return Section.of_note(metrics["protocol"]["mirror"])
    methods = list(found["results"])
    charts = [
        LineChart(
            f"PSNR, {name}",
            "frames between both visits",
            [_interval_line(method, pairs[pair]) for method, pairs in found["by_distance"].items()],
            x=found["distances"],
            unit="dB",
        )
        for pair, name in PAIR_NAMES.items()
    ]
    rows = [
        row(
            name,
            *(with_interval(found["results"][method][name], 3) for method in methods),
            with_interval(found["ceiling"][name], 3),
            with_interval(found["floor"].get(name), 3),
        )
        for name in found["ceiling"]
    ]
    heads = ["way back against way out", *(METHOD_NAMES[m] for m in methods), "ceiling", "floor"]
    text = (
        f"The agent goes {found['out']} frames along the recorded path and returns the same way, "
        "so it visits each place twice; the model imagines all frames."
    )
    note = (
        f"{found['rollouts']} rollouts. Mean over houses, in brackets the 95 % interval of a "
        "bootstrap over them. The ceiling is the recording, reversed at its end; the floor "
        "compares the way out with another rollout's return path. Consistency does not imply "
        "correctness: a model that always shows one image is perfectly consistent, so both visits "
        f"are also compared with the ground truth. {metrics['protocol']['src']}"
    )
    blocks = [
        Text(text),
        Charts(charts, legend(methods)),
        TableBlock(Table(heads, rows)),
        Text(note, "quiet"),
    ]
    return Section("There and back", blocks)


def _interval_line(method: str, entry: Mapping[str, Any]) -> Line:
    return Line.with_interval(METHOD_NAMES[method], METHOD_COLOURS[method], entry)


def coverage(metrics: Mapping[str, Any]) -> Section | None:
    """Return the share of the pixels seen before that the map covers; None if unknown."""
    shares = metrics["coverage"]
    if not shares:
        return None
    rows = [row(label, f"{100 * shares[key]:.1f} %") for key, label in COVERAGE_NAMES.items()]
    text = "Share of the pixels seen before whose surface is"
    return Section.of_table("What the map covers", ["", "share"], rows, text=text)


def voxels(metrics: Mapping[str, Any]) -> Section | None:
    """Return the scores of a voxel world; None for other worlds."""
    found = metrics.get("voxels")
    if not found:
        return None
    note = (
        "Unseen walls: the intersection over union with the recorded walls, over the cells of the "
        "window that no observed frame shows. Lost: PSNR of the observed frames, imagined before "
        "the walk and after it. Doorways: those that the observed frames show open, and those of "
        "them that the world's grid still lets one pass after the walk."
    )
    return Section("The voxels", [TableBlock(voxel_table(found)), Text(note, "quiet")])


def _protocol(protocol: Mapping[str, Any]) -> Section:
    skip = {"config", "clip_list", "scene_names"}
    facts = []
    for key, value in protocol.items():
        if key in skip or value is None:
            continue
        if key == "reproject":
            text = value["why"]
        elif isinstance(value, dict):
            text = ", ".join(f"{k.replace('_', ' ')} {v}" for k, v in value.items())
        else:
            text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
        facts.append((key.replace("_", " "), text))
    text = (
        "Every number of this page is in `metrics.json` beside it, with the configuration and the "
        "list of clips."
    )
    return Section("How this was measured", [Text(text), Facts(facts)])
