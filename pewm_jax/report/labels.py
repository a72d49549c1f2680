"""Labels and sentences of reports: names of methods, masks and metrics, and verdicts."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

from pewm_jax.report.table import Table, row, with_error, with_frames, with_interval
from pewm_jax.report.table import heading as heading_row

METHOD_NAMES = {
    "memory": "with its map",
    "empty": "same weights, empty map",
    "model": "the model, which has no memory",
    "none": "trained as long without a memory",
    "reproject": "reprojection, no network",
    "copy": "copying the last frame",
}
"""Labels of the methods, in the order of the tables."""
OWN_METHODS = ("memory", "model")
"""Keys of the evaluated model itself: with its map, or a model that has no memory. A report has one
of them."""
RIVALS = {
    "reproject": "reprojecting what was observed",
    "none": "a model trained as long without a memory",
    "empty": "an empty map",
}
"""Names of the reference methods, in sentences."""
OWN_NAMES = {"memory": "The model with its map", "model": "The model, which has no memory,"}
"""Names of the model itself in sentences, by its key."""
NO_MEMORY = (
    "This model was trained without a memory, so there is no map and no row with an empty map. To "
    "measure what a memory adds, compare it with a run that has one (`pewm-jax compare`, or --none "
    "of that run)."
)
MASK_NAMES = {"seen": "seen before", "unseen": "never seen", "all": "all pixels"}
"""Labels of the masks."""
PARTS = ("seen", "unseen")
"""The masks of a part of the pixels."""
METRIC_NAMES = {
    "psnr": ("PSNR, dB ↑", 2),
    "ssim": ("SSIM ↑", 3),
    "depth_mae": ("depth error, m ↓", 3),
    "depth_rel": ("relative depth error ↓", 3),
    "lpips": ("LPIPS ↓", 3),
}
"""Heading and number of digits of each metric; that of LPIPS names its network (``heading``)."""
COVERAGE_NAMES = {
    "held": "held by the map",
    "looked_at": "looked at by the model's reader",
    "rendered": "shown by the rendered map",
    "chosen": "among the tokens chosen for attention",
    "attended": "among those that the frame's own camera would attend to",
}
"""Labels of the shares of pixels seen before."""
PUBLISHED_FRAMES = (4, 8, 16)
"""Imagined frames at which EgoWM's tables have scores."""
ACTIONS_NAMES = {
    "true": "the true actions",
    "shuffled": "another clip's actions",
    "none": "no actions",
    "unembedded": "actions not embedded; cameras and drawings stay",
    "copy": "the observed frame, repeated",
    "warp": "the observed frame, warped",
    "paint": "warped without the body, arms painted from their bones",
    "true - shuffled": "true minus another clip's",
    "true - none": "true minus none",
    "true - unembedded": "true minus those not embedded",
    "true - copy": "true minus the observed frame",
    "true - warp": "true minus the warped frame",
    "true - paint": "true minus the painted bones",
}
"""Labels of the kinds of actions given to a model, and of their differences."""
STEERING_DIGITS = {"psnr": 2, "lpips": 3, "scs": 1, "arms": 3}
"""Digits of the scores by kind of actions."""
TRUTH_NAME = "the true clip"
"""Label of the ceiling of scores that need a segmentation."""
NONE_HOW = (
    "There is no row for a model trained equally long without a memory: train one with the same "
    "clip, codec and number of steps, all in stage 1 (--train.stage1.steps N --train.stage2.steps "
    "0), and give its folder by --none."
)
NONE_LACKING = (
    "There is no row for a model trained equally long without a memory: give the folder of one "
    "by --none."
)


def own_method(names: Iterable[str]) -> str:
    """Return the key of the evaluated model: ``memory``, or ``model`` without a memory."""
    found = set(names)
    return next(name for name in OWN_METHODS if name in found)


def labelled(methods: Collection[str]) -> list[tuple[str, str]]:
    """Return some methods with their labels, in the order of the tables."""
    return [(method, label) for method, label in METHOD_NAMES.items() if method in methods]


def heading(metric: str, protocol: Mapping[str, Any]) -> str:
    """Return a metric's heading, for LPIPS with its network; ``protocol`` is a report's entry."""
    text, network = METRIC_NAMES[metric][0], protocol.get("lpips_name")
    return text.replace("LPIPS", network) if network else text


def number(entry: Mapping[str, Any], digits: int, *, sign: bool = False) -> str:
    """Format an entry as ``mean ± stderr``, or as a dash."""
    return str(with_error(entry, digits, sign=sign))


def spread(entry: Mapping[str, Any], digits: int, *, sign: bool = False) -> str:
    """Format an entry as ``mean [low, high]``, or as a dash."""
    return str(with_interval(entry, digits, sign=sign))


def format_verdict(entry: Mapping[str, Any], where: str) -> str:
    """Return a sentence on the effect of the map (PSNR with minus without it)."""
    mean, stderr = entry["mean"], entry["stderr"]
    if mean is None:
        return f"No clip has enough pixels {where} to compare."
    if stderr is None:
        return (
            f"On pixels {where} the map changes PSNR by {mean:+.2f} dB; the uncertainty cannot be "
            "estimated from clips of one place."
        )
    amount = f"{abs(mean):.2f} ± {stderr:.2f} dB"
    if mean > 2 * stderr:
        ratio = f", {mean / stderr:.0f} times the standard error" if stderr > 0 else ""
        return f"On pixels {where} the map brings the model {amount} closer to the truth{ratio}."
    if mean < -2 * stderr:
        return f"On pixels {where} the map makes the model worse, by {amount}."
    return f"On pixels {where} the map makes no clear difference ({mean:+.2f} ± {stderr:.2f} dB)."


def format_comparison(margin: Mapping[str, Any], rival: str, own: str = "memory") -> str:
    """Return a sentence that compares the model with another method, per mask.

    ``margin`` is ``[mask]["psnr"]`` of the model minus the rival, a key of ``RIVALS``.
    """
    masks = {"seen": "pixels seen before", "unseen": "those never seen", "all": "all"}
    said = [f"over {where} {_outcome(margin[mask]['psnr'])}" for mask, where in masks.items()]
    return f"{OWN_NAMES[own]} against {RIVALS[rival]}: {'; '.join(said)}."


def _outcome(entry: Mapping[str, Any]) -> str:
    mean, stderr = entry["mean"], entry["stderr"]
    if mean is None:
        return "there is nothing to compare"
    if stderr is None:
        return f"{mean:+.2f} dB in one place, uncertainty unknown"
    amount = f"{mean:+.2f} ± {stderr:.2f} dB"
    if abs(mean) <= 2 * stderr:
        return f"no clear difference ({amount})"
    return f"it {'is better' if mean > 0 else 'is WORSE'} ({amount})"


def format_drift(drift: Mapping[str, Any]) -> str:
    """Return a sentence on ``statistics.drift`` of the model's own long rollouts."""
    if drift["difference"] is None:
        return "Long rollouts have fewer than 32 frames: their drift is not measured."
    first, last, change = (drift[name] for name in ("first16", "last16", "difference"))
    return (
        f"Along long rollouts PSNR over pixels seen before goes from {number(first, 2)} dB (first "
        f"16 frames) to {number(last, 2)} dB (last 16): {number(change, 2, sign=True)} dB."
    )


def format_coverage(shares: Mapping[str, float]) -> str:
    """Return a sentence on the map's coverage of the pixels seen before."""
    said = (f"{100 * shares[key]:.1f} % {name}" for key, name in COVERAGE_NAMES.items())
    return f"Of the pixels seen before: {', '.join(said)}."


def format_lpips(metrics: Mapping[str, Any]) -> str:
    """Return a sentence on LPIPS, or the reason why it was not measured."""
    found = {method: masks["all"].get("lpips") for method, masks in metrics["results"].items()}
    if not all(found.values()):
        return metrics["protocol"]["lpips"]
    name = metrics["protocol"].get("lpips_name") or "LPIPS"
    said = f"{name} of whole images, lower is better: {_by_method(found)}."
    for mask in PARTS:
        within = {method: masks[mask].get("lpips") for method, masks in metrics["results"].items()}
        if all(within.values()):
            said += f" Over pixels {MASK_NAMES[mask]}: {_by_method(within)}."
    return said


def _by_method(found: Mapping[str, Any]) -> str:
    return "; ".join(f"{label} {number(found[m], 3)}" for m, label in labelled(found))


def format_fvd(metrics: Mapping[str, Any]) -> str:
    """Return a sentence on FVD and KVD, or the reason why they were not measured."""
    found = metrics["videos"]
    if not found:
        return metrics["protocol"]["fvd"]
    said = []
    for kind, name in found["names"].items():
        values = (
            f"{label} {found['results'][method][kind]['value']:.4g}"
            for method, label in labelled(found["results"])
        )
        said.append(f"{name}, lower is better: {'; '.join(values)}")
    for mask, results in found.get("masks", {}).items():
        values = (
            f"{label} {results[method]['kvd']['value']:.4g}" for method, label in labelled(results)
        )
        where = f"over pixels {MASK_NAMES[mask]}, with the truth elsewhere"
        said.append(f"{found['names']['kvd']} {where}: {'; '.join(values)}")
    return f"{'. '.join(said)}."


def format_mirror(metrics: Mapping[str, Any]) -> str:
    """Return a sentence on the mirror test, or the reason why it was skipped."""
    found = metrics["mirror"]
    if not found:
        return metrics["protocol"]["mirror"]
    said = []
    for method, pairs in found["by_distance"].items():
        values = pairs["again"]["mean"]
        known = [(value, at) for value, at in zip(values, found["distances"], strict=True) if value]
        ends = " and ".join(f"{value:.2f} dB after {at}" for value, at in (known[0], known[-1]))
        said.append(f"{METHOD_NAMES[method]} {ends}")
    return (
        "There and back, the second visit against the first, by frames between them: "
        f"{'; '.join(said)}."
    )


def format_scs(metrics: Mapping[str, Any]) -> list[str]:
    """Return a sentence on SCS, if it was measured."""
    found = metrics.get("scs")
    if not found:
        return []
    values = "; ".join(
        f"{label} {spread(found['results'][method], 1)}"
        for method, label in labelled(found["results"])
    )
    ceiling = spread(found["ceiling"], 1)
    return [f"{found['name']}, higher is better: {values}; the true clip {ceiling}."]


def format_steering(metrics: Mapping[str, Any]) -> list[str]:
    """Return a sentence on whether the model follows its actions, or why that is unknown.

    Empty for a model that is not controlled by actions.
    """
    found = metrics.get("steering")
    if not found:
        about = metrics["protocol"].get("steering")
        return [about] if about else []
    less = (
        f"{ACTIONS_NAMES[name.removeprefix('true - ')]}: {spread(entry, 2, sign=True)} dB"
        for name, entry in found["all"].items()
        if name.startswith("true - ")
    )
    true = spread(found["all"]["true"], 2)
    first = f"PSNR with the true actions is {true} dB; its lead over {'; over '.join(less)}."
    return [first, *compare_steering(found)]


def steering_table(found: Mapping[str, Any]) -> Table:
    """Return all scores by kind of actions: of all frames, and at some of them.

    ``found`` is the entry ``steering`` of ``metrics.json``.
    """
    frames = len(found["per_frame"]["true"]["mean"])
    columns = sorted({0, *(t - 1 for t in PUBLISHED_FRAMES if t <= frames), frames - 1})
    rows = []
    psnr = {"name": "PSNR, dB", **{key: found[key] for key in ("all", "per_frame")}}
    for score, one in {"psnr": psnr, **found.get("scores", {})}.items():
        rows.append(heading_row(one["name"]))
        for kind, label in {**ACTIONS_NAMES, "truth": TRUTH_NAME}.items():
            if kind in one["all"]:
                whole, steps, less = one["all"][kind], one["per_frame"][kind], "-" in kind
                digits = STEERING_DIGITS[score]
                cells = with_frames(whole, steps, columns, digits, sign=less)
                rows.append(row(label, *cells, highlight=less))
    return Table(["", "all frames", *(f"frame {t + 1}" for t in columns)], rows)


def compare_steering(found: Mapping[str, Any]) -> list[str]:
    """Return the scores of the true actions relative to copying and to another clip's actions.

    ``found`` is the entry ``steering`` of ``metrics.json``. What has no score is left out.
    """
    lines, scores = [], found.get("scores", {})
    if "lpips" in scores:
        found_by_kind = scores["lpips"]["per_frame"]
        for kind, title in (("copy", "copying"), ("warp", "warping"), ("paint", "painting")):
            if kind not in found_by_kind:
                continue
            each = (found_by_kind[name]["mean"] for name in ("true", kind))
            pairs = dict(enumerate(zip(*each, strict=True), 1))
            said = [
                f"{true:.3f} against {base:.3f} ({100 * (true / base - 1):+.1f} %) at frame {t}"
                for t, (true, base) in pairs.items()
                if t in PUBLISHED_FRAMES and None not in (true, base) and base > 0
            ]
            lines += [f"LPIPS, true actions against {title}: {'; '.join(said)}."] * bool(said)
    for name, title in (("scs", "SCS"), ("arms", "IoU of the arms")):
        whole = scores.get(name, {}).get("all", {})
        true, other = (whole.get(kind, {}).get("mean") for kind in ("true", "shuffled"))
        if true is not None and other:
            lines.append(f"{title}, true actions / another clip's: {true / other:.2f}.")
    return lines


VOXEL_ROWS = {
    "as trained": "as trained",
    "persistence_logit": "no known class is favoured, voxels sampled in every frame",
    "empty_prior": "empty_prior 0",
    "observation_logit": "observation_logit 0",
    "guesses": "guesses are not revised",
    "body": "the cells that the agent stands in stay as imagined",
    "colour_reach_m": "colours are guessed for each cell alone",
    "moving": "doors and robots that have moved stay where they were seen",
    "sampled": "voxels are sampled in every frame",
    "sample_steps": "voxels are sampled in one step",
}
"""Labels of a voxel world's rows; other worlds have their names."""


def voxel_table(found: Mapping[str, Any]) -> Table:
    """Return the scores of a voxel world, and of it with mechanisms switched off, as a table."""
    long = found["long"]
    heads = ["", "unseen walls, IoU ↑"]
    if long:
        spans = zip((0, *long["ends"][:-1]), long["ends"], strict=True)
        heads += [f"PSNR, dB, {low + 1}–{high} ↑" for low, high in spans]
        heads += [
            "PSNR, dB, observed before → after ↑",
            "doorways open",
            f"FVD, {long['frames']} frames ↓",
        ]
    rows = []
    for name, scores in found["rows"].items():
        cells = [f"{scores['iou']:.3f}" if "iou" in scores else "–"]
        if long:
            cells += [f"{value:.2f}" for value in scores["psnr"]]
            cells.append(" → ".join(f"{x:.2f}" for x in scores.get("seen", ())) or "–")
            doorways = scores.get("doorways")
            cells.append(f"{doorways[1]} of {doorways[0]}" if doorways else "–")
            cells.append(f"{scores['fvd']:.0f}" if "fvd" in scores else "–")
        rows.append([VOXEL_ROWS.get(name, name), *cells])
    return Table.of(heads, rows)


def format_voxels(metrics: Mapping[str, Any]) -> list[str]:
    """Return sentences on the voxels of a world, if it has any."""
    found = metrics.get("voxels")
    if not found:
        return []
    unseen, known, long = found["unseen"], found["known"], found["long"]
    ratio = ""
    if unseen["prior"]:
        ends = ""
        if "times_low" in unseen:
            ends = f" [{unseen['times_low']:.2f}, {unseen['times_high']:.2f}]"
        ratio = f" ({unseen['iou'] / unseen['prior']:.2f}{ends} times)"
    walls = (
        f"IoU of walls that no observed frame shows: {unseen['iou']:.3f}; of the mean layout of "
        f"other houses {unseen['prior']:.3f}{ratio}; of the observed walls, extended, "
        f"{unseen['extended']:.3f}; at {unseen['places']:.0f} places in {unseen['houses']:.0f} "
        "houses."
    )
    said = [walls, f"PSNR of rendering a known grid: {known['psnr']:.2f} dB."]
    own = found["rows"]["as trained"]
    if not long:
        return [*said, "Long walks are not measured: give a data set with them by --long."]
    before, after = own["seen"]
    count, passed = own["doorways"]
    said.append(
        f"After {long['frames']} frames, {own['lost']:+.2f} dB are lost over pixels seen before "
        f"({before:.2f} dB at first, {after:.2f} dB then); of {count} doorways seen open {passed} "
        "are passable."
    )
    names = [name for name in ("as trained", *long["beside"]) if "fvd" in found["rows"][name]]
    if names:
        values = (f"{VOXEL_ROWS.get(n, n)} {found['rows'][n]['fvd']:.0f}" for n in names)
        said.append(f"FVD over {long['frames']} frames, lower is better: {'; '.join(values)}.")
    return said


def format_map_growth(metrics: Mapping[str, Any]) -> list[str]:
    """Return a sentence on how the map grows, if there is one."""
    found = metrics["long"]["growth"]
    if not found:
        return []
    held = found["occupied"]["mean"]
    room = f", with a capacity of {found['capacity']}" if found["capacity"] else ""
    said = (
        f"Along long rollouts the map grows from {held[0]:.0f} to {held[-1]:.0f} points in "
        f"{found['frames'][-1]} imagined frames{room}."
    )
    return [said]


def summary_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Return the report's sentences for the terminal: baselines first, then the map."""
    margins, own = metrics["margins"], own_method(metrics["results"])
    lines = [NO_MEMORY]
    if own == "memory":
        masks = {"seen": "seen before", "unseen": "never seen"}
        lines = [format_verdict(margins["empty"][m]["psnr"], where) for m, where in masks.items()]
    rivals = [name for name in ("reproject", "none") if name in margins]
    lines += [format_comparison(margins[name], name, own) for name in rivals]
    if own == "memory" and "none" not in margins:
        of_pewm = "stage1" in metrics["protocol"]["config"]["train"]
        lines.append(NONE_HOW if of_pewm else NONE_LACKING)
    lines += [text] if (text := metrics["protocol"].get("geometry")) else []
    lines += [format_lpips(metrics), format_fvd(metrics)]
    lines += [format_coverage(metrics["coverage"])] if metrics["coverage"] else []
    lines += [format_drift(metrics["long"]["drift"][own]), *format_map_growth(metrics)]
    lines += [*format_steering(metrics), *format_scs(metrics), format_mirror(metrics)]
    return [*lines, *format_voxels(metrics)]


def score_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Return the tables of PSNR, of steering and of voxels as aligned lines for the terminal."""
    results = metrics["results"]
    rows = [
        [label, *(with_error(results[method][mask]["psnr"], 2) for mask in MASK_NAMES)]
        for method, label in labelled(results)
    ]
    lines = Table.of(["PSNR, dB", *MASK_NAMES.values()], rows).text()
    for name, table in (("steering", steering_table), ("voxels", voxel_table)):
        if metrics.get(name):
            lines += table(metrics[name]).text()
    return lines
