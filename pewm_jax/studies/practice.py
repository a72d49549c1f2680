"""What a policy learns about a new house by practice in imagination (the paper's Figure 6b).

In each held-out house a trained NoMaD practises from the same few images: in the world with its
memory, in the world without it, and, as an upper bound, in the house itself. It trains on equally
many walks for equally many steps each time, and is then sent to the same goals in the real house.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import functools
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.eval import statistics
from pewm_jax.eval.loaded_run import LoadedRun, has_memory, open_run
from pewm_jax.io import atomic
from pewm_jax.io.progress import Meter
from pewm_jax.io.store import TABLE, ResultCache, require_same_inputs
from pewm_jax.planning import practice
from pewm_jax.planning.practice import PracticeWalk
from pewm_jax.report import pictures
from pewm_jax.report.table import Cell, Table, score_cells
from pewm_jax.studies import practice_piece
from pewm_jax.studies.deciders import LoadedPolicy, model_digest, open_policy
from pewm_jax.studies.goals import Goal
from pewm_jax.studies.practice_piece import (
    BEFORE,
    CHANCE,
    EMPTY,
    MEMORY,
    REAL,
    ROWS,
    WITHIN_DEG,
    WITHIN_M,
    PracticeConfig,
    act_of,
    open_home,
    place_of,
)

Log = Callable[[str], Any]
DECIDED_BY, LEVEL = "success", 0.01
"""The score by which practice in the house itself must beat chance before worlds are compared, and
the level of that test."""
COLUMNS: Mapping[str, tuple[str, int]] = {
    "success": ("success, %", 1),
    "spl": ("SPL, %", 1),
    "nearest": ("nearest to the goal, m", 2),
    "sim": ("SIM at the end, %", 1),
}
"""Score → heading, decimals."""
LABELS = {
    "chance": "walking without looking",
    "before": "before practice",
    "memory": "practised in the world, with its memory",
    "empty": "practised in the world, empty memory",
    "real": "practised in the house itself",
}
DIFFERENCES = (
    *((REAL, CHANCE), (MEMORY, BEFORE), (MEMORY, EMPTY)),
    *((REAL, MEMORY), (BEFORE, CHANCE)),
)
SHOWN_PLACES = {"real": "the house itself", "memory": "with its memory", "empty": "empty memory"}
SHOWN = 11
"""Number of images per walk."""


def run(
    model: str | Path, policy: str | Path, out: Path, study: PracticeConfig, log: Log = print
) -> Path:
    """Let a policy, the run of a NoMaD, practise in every house; measure it before and after.

    ``model`` is a run folder, or the name of weights that ship with the library. The same call
    resumes.

    Returns:
        The path of the table in Markdown; in the same folder .png and ``results.json``.

    Raises:
        UserError: weights are missing or incompatible, a loss is not finite, or the folder contains
            pieces with other settings.
    """
    world, begun = open_run(model), open_policy(policy)
    _require_fit(world, begun, study, model, policy)
    about = dataclasses.asdict(study) | {
        "weights": model_digest(world.weights_hash, world.config),
        "policy": begun.digest,
    }
    require_same_inputs(out, about, "pieces", ("houses", "seeds", "shown"))
    cache = ResultCache(out, TABLE)
    pieces = [
        (house, seed, how) for house in range(study.houses) for seed in study.seeds for how in ROWS
    ]
    made: dict[str, list[dict[str, Any]]] = {how: [] for how in ROWS}
    with Meter("practising", len(pieces), "pieces") as meter:
        for house, seed, how in pieces:
            name = f"house{house:04d}/{how}-seed{seed}"

            make = functools.partial(
                practice_piece.make, world, begun, study, house, how, seed, out / name
            )
            known = cache.get(f"{name}/scores")
            made[how].append(cache.put(f"{name}/scores", make()) if known is None else known)
            meter.advance(1, before=known is not None)
    log(meter.summary())
    results = summary(made) | {
        "about": about
        | {"model": str(model), "date": dt.datetime.now(dt.UTC).date().isoformat()}
        | {"within_m": WITHIN_M, "within_deg": WITHIN_DEG, "how": statistics.interval_facts()}
    }
    atomic.write_text(out / "results.json", json.dumps(results, indent=1, allow_nan=False) + "\n")
    page = out / "practice.md"
    shown = []
    for house in range(min(study.shown, study.houses)):
        home = open_home(study, world.config, house)
        walks = {how: _first_walk(world, home, begun, study, how) for how in SHOWN_PLACES}
        shown.append((home.house, walks))
    write_page(results, page, shown)
    return page


def _require_fit(
    world: LoadedRun,
    begun: LoadedPolicy,
    study: PracticeConfig,
    model: str | Path,
    policy: str | Path,
) -> None:
    """Raise an error early, with a clear message, if model, policy and settings do not fit."""
    if not has_memory(world):
        raise UserError(f"{model} has no memory, but the study measures the effect of a memory.")
    clip, own = world.config.model.clip, begun.config.model.clip
    if clip.height != clip.width or not clip.depth:
        what = f"{clip.width}×{clip.height}" + ("" if clip.depth else " without depth")
        raise UserError(f"{model} imagines images of {what}: use a model of square RGB-D images.")
    if (own.height, own.width) != (clip.height, clip.width):
        raise UserError(
            f"{policy} was trained on images of {own.width}×{own.height}, but {model} imagines "
            f"{clip.width}×{clip.height}: train one of them at the other's size."
        )
    if begun.motion != world.config.model.actions:
        raise UserError(
            f"{policy} uses other actions than {model} ({begun.motion} and "
            f"{world.config.model.actions}): train one of them with the other's actions."
        )
    frames = 1 + study.practice.blocks * begun.config.model.policy.waypoints
    if frames < own.frames:
        raise UserError(
            f"walks of {study.practice.blocks} blocks have {frames} frames, but {policy} is "
            f"trained on clips of {own.frames}: use more --blocks."
        )


def _first_walk(
    world: LoadedRun, home: Goal, begun: LoadedPolicy, study: PracticeConfig, how: str
) -> PracticeWalk:
    place = place_of(world, home, world.config.model.actions, how)
    walks = practice.walks(place, home.context, act_of(begun), study.practice, study.seeds[0])
    return next(walks)


def power(practised_C: np.ndarray, chance_C: np.ndarray, houses_C: np.ndarray) -> float | None:
    """Return the p value of "practice in the house itself is better than chance".

    Practice in the real house is an upper bound for practice in any world. If it does not beat
    random walks, the task cannot distinguish worlds. The p value is one-sided, from the bootstrap
    over houses of each goal's scores (higher is better); None for fewer than two houses.
    """
    gain_C = practised_C - chance_C
    p_value = statistics.p_over_houses(gain_C, houses_C)
    if p_value is None:
        return None
    better = statistics.over_houses(gain_C, houses_C)["mean"] > 0
    return p_value / 2 if better else 1 - p_value / 2


def summary(made: Mapping[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Return means over houses with 95 % intervals, and differences, paired by task and seed."""
    named = [piece["house"] for piece in made[BEFORE] for _ in piece["tasks"]]
    houses = np.unique(named, return_inverse=True)[1]
    values = {
        how: {
            metric: np.array([task[metric] for piece in pieces for task in piece["tasks"]])
            for metric in pieces[0]["tasks"][0]
        }
        for how, pieces in made.items()
    }
    p_value = power(values[REAL][DECIDED_BY], values[CHANCE][DECIDED_BY], houses)
    walked = {
        how: {
            name: float(np.mean([piece["walked"][name] for piece in pieces]))
            for name in pieces[0]["walked"]
        }
        for how, pieces in made.items()
        if pieces[0]["walked"]
    }
    return {
        "power": {
            "metric": DECIDED_BY,
            "p": p_value,
            "level": LEVEL,
            "compares": p_value is not None and p_value < LEVEL,
        },
        "rows": {how: statistics.entries(by, houses) for how, by in values.items()},
        "differences": {
            f"{one} - {other}": statistics.entries(
                {metric: x - values[other][metric] for metric, x in values[one].items()}, houses
            )
            for one, other in DIFFERENCES
        },
        "walked": walked,
        "houses": len(set(houses.tolist())),
        "tasks": len(houses),
    }


def write_page(
    results: Mapping[str, Any], page: Path, shown: Sequence[tuple[str, Mapping[str, PracticeWalk]]]
) -> None:
    """Write the table as ``page`` (Markdown), and its image beside it."""
    atomic.write_text(page, markdown(results, page.stem if shown else ""))
    if shown:
        pictures.save_png(page.with_suffix(".png"), picture(shown))


def markdown(results: Mapping[str, Any], stem: str) -> str:
    """Return the page."""
    headings = [heading for heading, _ in COLUMNS.values()]
    rows = [[LABELS[how], *score_cells(COLUMNS, row)] for how, row in results["rows"].items()]
    gains = [
        [
            " − ".join(LABELS[how] for how in name.split(" - ")),
            *score_cells(COLUMNS, entries, sign=True),
        ]
        for name, entries in results["differences"].items()
    ]
    walked = [
        [LABELS[how], Cell(found["forward"], 1), Cell(found["through_walls"], 1)]
        for how, found in results["walked"].items()
    ]
    about = results["about"]
    drill = about["practice"]
    how = (
        f"{about['model']}; NoMaD; {results['houses']} held-out houses, {about['tasks']} goals in "
        f"each, {len(about['seeds'])} seed(s). In each house the policy starts from the same few "
        f"images, walks {drill['walks']} times ({drill['blocks']} proposals each) and trains "
        f"{about['steps']} steps on these walks only. Then it is sent to goals "
        f"{about['actions']} actions away, with at most {about['most']} actions; it is stopped as "
        f"soon as it is within {about['within_m']:g} m and {about['within_deg']:g}° of the goal, "
        "which is success (it need not detect the goal). Means over houses; ± is half of "
        f"the 95 % interval (bootstrap over houses). {about['date']}."
    )
    parts = [
        "# Practice in imagination",
        how,
        _power(results),
        Table.of(["", *headings], rows).markdown(),
    ]
    if results.get("power", {}).get("compares", False):
        table = Table.of(["", *headings], gains).markdown()
        parts.append(f"## Differences\n\nPaired by goal and seed.\n\n{table}")
    table = Table.of(["", "forward", "through walls"], walked).markdown()
    parts.append(
        "## What it learned from\n\nPercentage of the actions of its walks that go "
        f"forward, and percentage of these that pass through real walls.\n\n{table}"
    )
    if stem:
        parts.append(f"## What it saw\n\n![Walks in the house and in the world]({stem}.png)")
    return "\n\n".join(parts) + "\n"


def _power(results: Mapping[str, Any]) -> str:
    """Return a sentence on whether the task can distinguish worlds."""
    test = results.get("power")
    if test is None:  # results of version 0.1, which contain no scores per goal
        one, other = (results["rows"][how]["success"]["mean"] for how in ("real", "chance"))
        return (
            f"**Practice in the house itself reaches {one:.1f} % of the goals, random walks "
            f"{other:.1f} %. The difference was not tested, and no comparison "
            "between worlds is drawn.**"
        )
    if test["p"] is None:
        return "One house gives no p value: no comparison is drawn."
    words = (
        f"Practice in the house itself against random walks: p = {test['p']:.2g} "
        f"(one-sided, {COLUMNS[test['metric']][0]}, bootstrap over houses)."
    )
    if test["compares"]:
        return f"{words} Below {test['level']:g}: the task can distinguish worlds."
    return (
        f"**{words} Not below {test['level']:g}: the task has no power, because even practice in "
        "the house itself does not beat chance. No comparison between worlds is drawn from it.**"
    )


def picture(shown: Sequence[tuple[str, Mapping[str, PracticeWalk]]]) -> np.ndarray:
    """Return the first walk of each house in each environment, as rows; (H, W, 3) uint8."""
    rows = []
    for house, walks in shown:
        for how, words in SHOWN_PLACES.items():
            rgb = np.asarray(walks[how].frames.rgb_THWC)
            picked = np.linspace(0, len(rgb) - 1, min(SHOWN, len(rgb))).round().astype(int)
            rows.append((f"{house}, {words}", list(rgb[picked])))
    return pictures.grid(rows, [""] * len(rows[0][1]))
