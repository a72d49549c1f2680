"""Table 1 as numbers: means with intervals over houses, paired differences, training seeds."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pewm_jax.eval import intervals
from pewm_jax.eval.metrics.images import MASKS
from pewm_jax.eval.statistics import scores
from pewm_jax.studies.table1_rows import CONTROL, PAPER_FORM
from pewm_jax.studies.table1_scoring import SRC, Arrays

SETS = ("fvd", "kvd")
"""Metrics of whole sets of clips, which have no value per clip."""
LOWER = ("lpips", "dreamsim", "depth_mae", "depth_rel", *SETS, "fvd_half", "kvd_half")
"""Metrics for which lower is better."""
CHAIN = (
    "none",
    "none-attend",
    "images-attend",
    "voxel-attend-without_depth",
    "map2d-attend",
    "voxel-attend",
    "voxel-attend-sinusoid",
)
"""The steps of the paper's order, worst first, between comparable rows: the second row has a reader
without input, and all readers use projective positions except the last, which is the paper's own
form."""
GAP = "psnr/seen - unseen"
"""PSNR of seen minus unseen pixels; its difference between rows shows what a memory adds."""
AGAINST = ("none", "none-attend", "voxel-attend", "reproject", "copy")
"""The reference rows for paired differences; in an ablation also the table's own row, and the
reader without input (``none-attend-…``)."""


def by_clip(arrays: Arrays) -> dict[str, np.ndarray]:
    """Return a value per clip of each metric, (C,), under names such as ``psnr/seen``."""
    found = {
        f"{metric}/{mask}": values
        for mask, by_metric in scores(arrays["sums"].sum(1)).items()
        for metric, values in by_metric.items()
        if metric != "lpips" or mask == MASKS[-1]
    }
    found[GAP] = found["psnr/seen"] - found["psnr/unseen"]
    found |= {name: arrays[name] for name in ("src", "dreamsim") if name in arrays}
    return found


def per_frame(arrays: Arrays) -> dict[str, np.ndarray]:
    """Return PSNR of each frame, (C, T), by mask."""
    return {f"psnr/{mask}": found["psnr"] for mask, found in scores(arrays["sums"]).items()}


def summary(
    pieces: Mapping[str, Sequence[Arrays]],
    truth: Arrays,
    houses_C: np.ndarray,
    nets: Mapping[str, Any],
    frames: int = 0,
) -> dict[str, Any]:
    """Return the numbers of the table from the scores.

    Args:
        pieces: row → its scores, one per training seed; methods without a network have one.
        truth: from ``Scorer.truth``.
        houses_C: index of each clip's house.
        nets: the metrics that need weights.
        frames: number of frames of the clips of FVD and KVD, for their names.

    Returns:
        ``rows[name]``: ``seeds``; ``measures[name]`` as ``intervals.entry`` (averaged over training
        seeds within a clip), with ``over_seeds`` if there are several; ``per_frame``; ``fvd`` and
        ``kvd`` of all clips, and ``fvd_half`` and ``kvd_half``, to be compared with the floor, with
        ``per_seed``. ``floors``, with the ``name`` for that number of clips; and
        ``differences[against][row][measure]``, paired, row − against, with both intervals (for FVD
        and KVD only over seeds), p values over houses and over seeds (``p``, ``p_seeds``), and the
        same adjusted for the rows of the table (``adjust``).
    """
    values = {
        name: _stack_seeds([by_clip(each) for each in group]) for name, group in pieces.items()
    }
    rows: dict[str, Any] = {}
    for name, group in pieces.items():
        by_frame = _stack_seeds([per_frame(each) for each in group])
        rows[name] = {
            "seeds": len(group),
            "measures": {
                measure: _entry(values_KC, houses_C) for measure, values_KC in values[name].items()
            },
            "per_frame": {
                measure: intervals.entry(values_KCT.mean(0), houses_C)
                for measure, values_KCT in by_frame.items()
            },
        }
        for kind in SETS:
            if kind in nets and "logits" in truth:
                rows[name]["measures"] |= _set_distances(kind, nets[kind], group, truth)
    floors: dict[str, Any] = {}
    if "src_floor" in truth:
        floors[SRC] = {
            "floor": float(truth["src_floor"].mean()),
            "ceiling": float(truth["src_ceiling"].mean()),
        }
    for kind in SETS:
        if kind in nets and "logits" in truth:
            score = nets[kind].score(truth["logits"], truth["logits"])
            floors[kind] = {"floor": score.facts()["floor"], "half_clips": score.half_clips}
            floors[kind]["name"] = nets[kind].name(frames, score.half_clips)
    differences: dict[str, Any] = {
        against: {
            name: _differences(values[name], values[against], houses_C)
            for name in pieces
            if name != against
        }
        for against in pieces
        if against in AGAINST or against.startswith((CONTROL, PAPER_FORM))
    }
    for against, name in ((a, b) for a, found in differences.items() for b in found):
        differences[against][name] |= _set_distance_differences(rows[name], rows[against])
    chain = [name for name in CHAIN if name in pieces]
    order = [
        {
            "worse": worse,
            "better": better,
            "differences": _differences(values[better], values[worse], houses_C)
            | _set_distance_differences(rows[better], rows[worse]),
        }
        for worse, better in itertools.pairwise(chain)
    ]
    for family in (*(list(found.values()) for found in differences.values()), _steps(order)):
        adjust(family)
    return {"rows": rows, "floors": floors, "differences": differences, "order": order}


def _steps(order: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [step["differences"] for step in order]


def adjust(family: Sequence[Mapping[str, dict[str, Any]]]) -> None:
    """Add Holm's adjusted p values to the differences of one table of the page, column by column.

    Each row has its differences by measure; ``p_holm`` and ``p_seeds_holm`` are added to each that
    has ``p`` and ``p_seeds``.
    """
    for measure in {name for found in family for name in found}:
        column = [found[measure] for found in family if measure in found]
        for name in ("p", "p_seeds"):
            adjusted = intervals.holm([each.get(name) for each in column])
            for each, value in zip(column, adjusted, strict=True):
                if value is not None:
                    each[f"{name}_holm"] = value


def _stack_seeds(each: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Stack the values of training seeds along a first axis."""
    return {key: np.stack([one[key] for one in each]) for key in each[0]}


def _entry(values_KC: np.ndarray, houses_C: np.ndarray) -> dict[str, Any]:
    found = intervals.entry(values_KC.mean(0), houses_C)
    per_seed = [float(intervals.over_houses(one_C, houses_C)["mean"]) for one_C in values_KC]
    if np.isfinite(per_seed).all():
        found["per_seed"] = per_seed
        found["over_seeds"] = intervals.over_seeds(per_seed)
    return found


def _set_distances(
    kind: str, net: Any, group: Sequence[Arrays], truth: Arrays
) -> dict[str, dict[str, Any]]:
    """Return FVD or KVD per training seed, with mean and Student's interval; also of halves."""
    found = [net.score(each["logits"], truth["logits"]) for each in group]
    values = {kind: [float(score.value) for score in found]}
    if all(score.half is not None for score in found):
        values[f"{kind}_half"] = [float(score.half.mean) for score in found]
    entries = {}
    for name, per_seed in values.items():
        over = intervals.over_seeds(per_seed)
        entries[name] = {"mean": over["mean"], "per_seed": per_seed, "over_seeds": over}
    return entries


def _set_distance_differences(
    first: Mapping[str, Any], second: Mapping[str, Any]
) -> dict[str, Any]:
    """Return first − second of FVD and KVD, paired by training seed."""
    found = {}
    for measure in (f"{kind}{part}" for kind in SETS for part in ("", "_half")):
        pair = [row["measures"].get(measure) for row in (first, second)]
        if all(pair):
            a_K, b_K = np.broadcast_arrays(*(entry["per_seed"] for entry in pair))
            apart = (a_K - b_K).tolist()
            over, p = intervals.over_seeds(apart), intervals.p_over_seeds(apart)
            found[measure] = {"mean": over["mean"], "over_seeds": over, "p_seeds": p}
    return found


def _differences(
    first: Mapping[str, np.ndarray], second: Mapping[str, np.ndarray], houses_C: np.ndarray
) -> dict[str, Any]:
    """Return first − second, clip by clip, and over training seeds.

    Rows of one training seed share a backbone and are paired; methods without a network, and so
    without seeds, are paired with every seed.
    """
    found = {}
    for measure in first:
        if measure not in second:
            continue
        a_KC, b_KC = first[measure], second[measure]
        paired_C = a_KC.mean(0) - b_KC.mean(0)
        found[measure] = intervals.entry(paired_C, houses_C)
        found[measure]["p"] = intervals.p_over_houses(paired_C, houses_C)
        means = [
            [float(intervals.over_houses(one_C, houses_C)["mean"]) for one_C in group]
            for group in (a_KC, b_KC)
        ]
        if np.isfinite(np.concatenate(means)).all() and max(map(len, means)) > 1:
            apart = np.subtract(*np.broadcast_arrays(*means))
            found[measure]["over_seeds"] = intervals.over_seeds(apart.tolist())
            found[measure]["p_seeds"] = intervals.p_over_seeds(apart.tolist())
    return found
