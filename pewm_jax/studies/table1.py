"""Table 1 by one command: comparison of memories. Every finished unit is stored and reused.

The command fixes the protocol, times the trainings, and then trains and scores every row, one seed
after another. It writes the table after each seed.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import itertools
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax.config import Config, UserError
from pewm_jax.eval import statistics
from pewm_jax.eval.metrics.images import MASKS
from pewm_jax.eval.statistics import scores
from pewm_jax.io import atomic
from pewm_jax.studies import step_times, table1_page, table1_rows
from pewm_jax.studies.table1_page import GAP, SETS
from pewm_jax.studies.table1_rows import CONTROL, PAPER_FORM, Row
from pewm_jax.studies.table1_scoring import (
    BASELINES,
    SRC,
    Arrays,
    Scorer,
    open_scorer,
    read_recorded,
    recorded_path,
    write_recorded,
)
from pewm_jax.studies.table1_training import Study, backbone_of, planned, settings, train
from pewm_jax.worlds.pewm.world import PEWM, STAGES

RESULTS, HOURS = "results.json", "hours.json"
SCHEMA = 2
"""Version of the layout of the results, which ``docs/table1.md`` describes."""
EMPTY = "backbone"
"""The row of the backbone alone: the scores of every row's weights with an empty memory."""


def run(
    base: Config,
    out: Path,
    *,
    minutes: tuple[float, float],
    steps: tuple[int, int] | None = None,
    seeds: Sequence[int] = (0, 1, 2),
    only: Sequence[str] = (),
    ablation: str = "",
    values: tuple[str, ...] = (),
    weights: Mapping[str, str | Path] | None = None,
    log: Callable[[str], Any] = print,
) -> Path:
    """Train and score the rows of Table 1 or of an ablation, and write the table.

    Args:
        base: the settings that all rows share, such as the preset ``table1``.
        out: the output folder.
        minutes: processor minutes of training steps, of a backbone and of a row.
        steps: numbers of steps instead: equal steps instead of equal time.
        seeds: training seeds.
        only: names of rows; by default all.
        ablation: one of ``rows.ABLATIONS`` instead of the table.
        values: values of the ablation; by default its own.
        weights: see ``scorer.open_scorer``.
        log: prints a line.

    Returns:
        The path of the table in Markdown; in the same folder are ``.tex``, ``.csv``, ``.png`` and
        ``results.json``.

    Raises:
        UserError: the data are missing or unsuitable, a name is unknown, or a training diverged.
        Interrupted: finished work is stored; the same call resumes.
    """
    chosen = _rows(base, only, ablation, values)
    if not seeds or len(set(seeds)) < len(seeds) or min(seeds) < 0:
        raise UserError(
            f"seeds are {list(seeds)}: give distinct training seeds of 0 or more, at least one."
        )
    study = Study(base, out, minutes, steps)
    scorer = open_scorer(base, out, log, weights)
    title = "-".join(["table1", *([ablation] if ablation else []), *(["part"] if only else [])])
    pieces: dict[str, list[Arrays]] = {}
    with _timing(out, "before"):
        plan = planned(study, chosen, log)
        for name in BASELINES:
            pieces[name] = [scorer.baseline(name, out)]
        truth = scorer.truth(out)
    page = out / f"{title}.md"
    for number, seed in enumerate(seeds):
        for row in chosen:
            with _timing(out, f"seed{seed}/{row.name}"):
                found = _row_scores(study, scorer, row, seed, plan, log)
            for name, arrays in found.items():
                group = pieces.setdefault(name, [])
                if len(group) == number:
                    group.append(arrays)
        numbers = summary(pieces, truth, scorer.house_of_clip, scorer.nets, scorer.frames)
        facts = _facts(study, scorer, chosen, plan, seeds[: number + 1], ablation)
        results = {"schema": SCHEMA, "about": facts, **numbers}
        text = json.dumps(results, indent=1, allow_nan=False, ensure_ascii=False)
        atomic.write_text(out / f"{title}-{RESULTS}", text + "\n")
        table1_page.write(results, page)
        log(f"{number + 1} of {len(seeds)} training seeds: {page}")
    return page


def _rows(
    base: Config, only: Sequence[str], ablation: str, values: tuple[str, ...]
) -> tuple[Row, ...]:
    if type(base.model) is not PEWM:
        raise UserError(
            f"the settings are of a {type(base.model).__name__}, but Table 1 compares memories of "
            "the world pewm: use a preset of that, such as table1."
        )
    if ablation and only:
        raise UserError("rows apply to the table, not to an ablation: omit them.")
    if ablation:
        return table1_rows.ablated(base, ablation, values)
    if values:
        raise UserError("values apply to an ablation: choose one, or omit them.")
    every = table1_rows.main_rows(base)
    unknown = sorted(set(only) - {row.name for row in every})
    if unknown:
        names = ", ".join(row.name for row in every)
        raise UserError(f"there are no rows {', '.join(unknown)}; choose from {names}.")
    return tuple(row for row in every if not only or row.name in only)


def _row_scores(
    study: Study, scorer: Scorer, row: Row, seed: int, plan: dict[str, Any], log: Callable
) -> dict[str, Arrays]:
    """Train and score a row, and also its backbone if that is a row of the table.

    Scores recorded on another machine are used if the row has no local folder.
    """
    steps = {name: entry["steps"] for name, entry in plan.items()}
    file = recorded_path(study, row, seed, steps, scorer.name)
    before = read_recorded(file)
    if before is not None and not study.folder(row.name, seed).exists():
        log(f"{row.name}, training seed {seed}: its scores are recorded in {file.parent}")
        return before
    others = [] if before else sorted(file.parent.glob(f"seed{seed}-{row.name}-????????????.npz"))
    if others:
        log(f"{others[0]} is from other settings, data, weights or code, and is ignored")
    config = train(study, row, seed, steps, log)
    found = {row.name: scorer.row(config, memory=row.reads)}
    if row.depth:
        first = settings(study, backbone_of(study.base, row), seed, plan[EMPTY]["steps"], start="")
        found[EMPTY] = scorer.row(first, memory=False)
    write_recorded(file, found)
    return found


@contextlib.contextmanager
def _timing(out: Path, name: str) -> Iterator[None]:
    """Add the hours of a unit, over all calls, to ``hours.json``."""
    began, worked = time.monotonic(), time.process_time()
    try:
        yield
    finally:
        kept = _read_hours(out / HOURS)
        wall, cpu = kept.get(name, (0.0, 0.0))
        wall += (time.monotonic() - began) / 3600
        cpu += (time.process_time() - worked) / 3600
        atomic.write_text(out / HOURS, json.dumps(kept | {name: (wall, cpu)}, indent=1) + "\n")


def _read_hours(path: Path) -> dict[str, tuple[float, float]]:
    """Return wall-clock and processor hours of each unit."""
    try:
        return {name: (pair[0], pair[1]) for name, pair in json.loads(path.read_text()).items()}
    except (FileNotFoundError, ValueError, AttributeError, TypeError, LookupError):
        return {}


def _facts(
    study: Study,
    scorer: Scorer,
    rows: Sequence[Row],
    plan: dict[str, Any],
    seeds: Sequence[int],
    ablation: str,
) -> dict[str, Any]:
    """Return the description of how the table was made."""
    pieces = ["before", *(f"seed{seed}/{row.name}" for seed in seeds for row in rows)]
    kept = _read_hours(study.out / HOURS)
    hours = [kept[name] for name in pieces if name in kept]
    described = {
        row.name: {
            "label": row.label,
            "paper": row.paper,
            "depth": row.depth,
            "times": row.times,
            "parameters": table1_rows.parameters(study.base, row.memory) if row.reads else 0,
            "settings": dataclasses.asdict(row.memory),
        }
        for row in rows
    }
    return {
        "date": dt.datetime.now(dt.UTC).date().isoformat(),
        "ablation": ablation,
        "seeds": list(seeds),
        "minutes": list(study.minutes) if study.steps is None else None,
        "trainings": plan,
        "rows": described,
        "protocol_sha256": scorer.protocol.sha256,
        "clips": len(scorer.protocol.clips),
        "houses": len(set(scorer.house_of_clip.tolist())),
        "house": scorer.house,
        "frames": scorer.frames,
        "pixels": [study.base.model.clip.height, study.base.model.clip.width],
        "clock": "processor" if step_times.clock() is time.process_time else "wall",
        "context": scorer.config.data.context,
        "batch": STAGES[0].settings(study.base).batch,
        "left_out": dict(scorer.left_out),
        "reproject": scorer.reprojection(study.out).facts(),
        "hours": {"clock": sum(pair[0] for pair in hours), "cpu": sum(p[1] for p in hours)},
        "how": statistics.interval_facts(),
    }


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
        ``rows[name]``: ``seeds``; ``measures[name]`` as ``statistics.entry`` (averaged over
        training seeds within a clip), with ``over_seeds`` if there are several; ``per_frame``;
        ``fvd`` and ``kvd`` of all clips, and ``fvd_half`` and ``kvd_half``, to be compared with the
        floor, with ``per_seed``. ``floors``, with the ``name`` for that number of clips; and
        ``differences[against][row][measure]``, paired, row − against, with both intervals (for FVD
        and KVD only over seeds), p values over houses and over seeds (``p``, ``p_seeds``), and the
        same adjusted for the rows of the table (``adjust``).
    """
    values = {name: _stack_seeds(map(by_clip, group)) for name, group in pieces.items()}
    distances = {kind: nets[kind] for kind in SETS if kind in nets and "logits" in truth}
    rows: dict[str, Any] = {}
    for name, group in pieces.items():
        by_frame = _stack_seeds(map(per_frame, group))
        rows[name] = {
            "seeds": len(group),
            "measures": {
                measure: _entry(values_KC, houses_C) for measure, values_KC in values[name].items()
            },
            "per_frame": {
                measure: statistics.entry(values_KCT.mean(0), houses_C)
                for measure, values_KCT in by_frame.items()
            },
        }
        for kind, net in distances.items():
            rows[name]["measures"] |= _set_distances(kind, net, group, truth)
    floors: dict[str, Any] = {}
    if "src_floor" in truth:
        floors[SRC] = {
            "floor": float(truth["src_floor"].mean()),
            "ceiling": float(truth["src_ceiling"].mean()),
        }
    for kind, net in distances.items():
        score = net.score(truth["logits"], truth["logits"])
        floors[kind] = {"floor": score.facts()["floor"], "half_clips": score.half_clips}
        floors[kind]["name"] = net.name(frames, score.half_clips)

    def minus(first: str, second: str) -> dict[str, Any]:
        found = _differences(values[first], values[second], houses_C)
        return found | _set_distance_differences(rows[first], rows[second])

    differences: dict[str, Any] = {
        against: {name: minus(name, against) for name in pieces if name != against}
        for against in pieces
        if against in AGAINST or against.startswith((CONTROL, PAPER_FORM))
    }
    order = [
        {"worse": worse, "better": better, "differences": minus(better, worse)}
        for worse, better in itertools.pairwise(name for name in CHAIN if name in pieces)
    ]
    for found in differences.values():
        adjust(list(found.values()))
    adjust([step["differences"] for step in order])
    return {"rows": rows, "floors": floors, "differences": differences, "order": order}


def adjust(family: Sequence[Mapping[str, dict[str, Any]]]) -> None:
    """Add Holm's adjusted p values to the differences of one table of the page, column by column.

    Each row has its differences by measure; ``p_holm`` and ``p_seeds_holm`` are added to each that
    has ``p`` and ``p_seeds``.
    """
    for measure in {name for found in family for name in found}:
        column = [found[measure] for found in family if measure in found]
        for name in ("p", "p_seeds"):
            adjusted = statistics.holm([each.get(name) for each in column])
            for each, value in zip(column, adjusted, strict=True):
                if value is not None:
                    each[f"{name}_holm"] = value


def _stack_seeds(each: Iterable[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Stack the values of training seeds along a first axis."""
    some = list(each)
    return {key: np.stack([one[key] for one in some]) for key in some[0]}


def _seed_means(values_KC: np.ndarray, houses_C: np.ndarray) -> list[float]:
    return [float(statistics.over_houses(one_C, houses_C)["mean"]) for one_C in values_KC]


def _entry(values_KC: np.ndarray, houses_C: np.ndarray) -> dict[str, Any]:
    found = statistics.entry(values_KC.mean(0), houses_C)
    per_seed = _seed_means(values_KC, houses_C)
    if np.isfinite(per_seed).all():
        found["per_seed"] = per_seed
        found["over_seeds"] = statistics.over_seeds(per_seed)
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
        over = statistics.over_seeds(per_seed)
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
            over, p = statistics.over_seeds(apart), statistics.p_over_seeds(apart)
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
        found[measure] = statistics.entry(paired_C, houses_C)
        found[measure]["p"] = statistics.p_over_houses(paired_C, houses_C)
        means = [_seed_means(group, houses_C) for group in (a_KC, b_KC)]
        if np.isfinite(np.concatenate(means)).all() and max(map(len, means)) > 1:
            apart = np.subtract(*np.broadcast_arrays(*means))
            found[measure]["over_seeds"] = statistics.over_seeds(apart.tolist())
            found[measure]["p_seeds"] = statistics.p_over_seeds(apart.tolist())
    return found
