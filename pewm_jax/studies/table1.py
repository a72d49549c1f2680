"""Table 1 by one command: comparison of memories. Every finished unit is stored and reused.

The command fixes the protocol, times the trainings, and then trains and scores every row, one seed
after another. It writes the table after each seed.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pewm_jax.config import Config, UserError
from pewm_jax.eval import intervals
from pewm_jax.io import atomic
from pewm_jax.studies import table1_numbers, table1_page, table1_rows, table1_training
from pewm_jax.studies.table1_rows import Row
from pewm_jax.studies.table1_scoring import (
    BASELINES,
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
        numbers = table1_numbers.summary(
            pieces, truth, scorer.house_of_clip, scorer.nets, scorer.frames
        )
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
        kept = read_hours(out / HOURS)
        wall, cpu = kept.get(name, (0.0, 0.0))
        wall += (time.monotonic() - began) / 3600
        cpu += (time.process_time() - worked) / 3600
        atomic.write_text(out / HOURS, json.dumps(kept | {name: (wall, cpu)}, indent=1) + "\n")


def read_hours(path: Path) -> dict[str, tuple[float, float]]:
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
    kept = read_hours(study.out / HOURS)
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
        "clock": "processor" if table1_training.clock() is time.process_time else "wall",
        "context": scorer.config.data.context,
        "batch": STAGES[0].settings(study.base).batch,
        "left_out": dict(scorer.left_out),
        "reproject": scorer.reprojection(study.out).facts(),
        "hours": {"clock": sum(pair[0] for pair in hours), "cpu": sum(p[1] for p in hours)},
        "how": intervals.how(),
    }
