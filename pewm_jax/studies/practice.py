"""What a policy learns of a new house by practice in imagination (the paper's Figure 6b).

In each held-out house a trained NoMaD practises from the same few pictures: in the world with its
memory, in the world without, and, as the best there can be, in the house itself. Each time it
learns from as many walks, in as many steps, and is then sent to the same goals in the real house.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax.config import UserError
from pewm_jax.eval import intervals
from pewm_jax.eval.loaded_run import LoadedRun, has_memory, open_run
from pewm_jax.io import atomic
from pewm_jax.io.progress import Meter
from pewm_jax.planning import practice
from pewm_jax.planning.practice import Place, Walk
from pewm_jax.studies import kept, policies, practice_page, practice_piece
from pewm_jax.studies.goals import Goal
from pewm_jax.studies.policies import OpenedPolicy, open_policy
from pewm_jax.studies.practice_piece import (
    BEFORE,
    CHANCE,
    EMPTY,
    MEMORY,
    REAL,
    ROWS,
    WITHIN_DEG,
    WITHIN_M,
    Errand,
    act_of,
    open_home,
    place_of,
)

Log = Callable[[str], Any]
DECIDED_BY, LEVEL = "success", 0.01
"""The score by which practice in the house itself has to beat chance before worlds are compared,
and the level of that test."""


def run(model: str | Path, policy: str | Path, out: Path, errand: Errand, log: Log = print) -> Path:
    """Let a policy practise in every house, and measure it before and after.

    Args:
        model: a run folder, or the name of weights that come with the library.
        policy: the run of a NoMaD.
        out: the folder that everything is kept in; the same call goes on.
        errand: the settings.
        log: shows a line.

    Returns:
        The path of the table in Markdown; beside it .png and ``results.json``.

    Raises:
        UserError: the weights are absent or do not fit each other, a loss is not finite, or the
            folder holds pieces of other settings.
    """
    world, begun = open_run(model), open_policy(policy)
    _require_fit(world, begun, errand, model, policy)
    about = dataclasses.asdict(errand) | {
        "weights": policies.digest(world.weights_hash, world.config),
        "policy": begun.digest,
    }
    kept.require_same(out, about, ("houses", "seeds", "shown"), "pieces")
    pieces = [
        (house, seed, how)
        for house in range(errand.houses)
        for seed in errand.seeds
        for how in ROWS
    ]
    made: dict[str, list[dict[str, Any]]] = {how: [] for how in ROWS}
    with Meter("practising", len(pieces), "pieces") as meter:
        for house, seed, how in pieces:
            folder = out / f"house{house:04d}" / f"{how}-seed{seed}"
            piece = kept.read(folder / "scores.json")
            if piece is None:
                home = open_home(errand, world.config, house)
                piece = practice_piece.make(world, begun, home, errand, how, seed, folder)
                kept.write(folder / "scores.json", piece)
            made[how].append(piece)
            meter.advance(1)
    log(meter.summary())
    results = summary(made) | {
        "about": about
        | {"model": str(model), "date": dt.datetime.now(dt.UTC).date().isoformat()}
        | {"within_m": WITHIN_M, "within_deg": WITHIN_DEG, "how": intervals.how()}
    }
    atomic.write_text(out / "results.json", json.dumps(results, indent=1, allow_nan=False) + "\n")
    page = out / "practice.md"
    shown = [
        (home.house, {how: _first_walk(place, home, begun, errand) for how, place in there.items()})
        for home, there in _places_shown(world, errand)
    ]
    practice_page.write(results, page, shown)
    return page


def _require_fit(
    world: LoadedRun, begun: OpenedPolicy, errand: Errand, model: str | Path, policy: str | Path
) -> None:
    """Refuse what would end later, and in words that do not help."""
    if not has_memory(world):
        raise UserError(f"{model} has no memory, and what a memory adds is the question.")
    clip, own = world.config.model.clip, begun.config.model.clip
    if clip.height != clip.width or not clip.depth:
        what = f"{clip.width}×{clip.height}" + ("" if clip.depth else " without depth")
        raise UserError(f"{model} imagines pictures of {what}: give a model of square RGB-D ones.")
    if (own.height, own.width) != (clip.height, clip.width):
        raise UserError(
            f"{policy} learned from pictures of {own.width}×{own.height}, and {model} imagines "
            f"{clip.width}×{clip.height}: train one of them at the other's size."
        )
    if begun.motion != world.config.model.actions:
        raise UserError(
            f"{policy} takes other steps than {model} imagines ({begun.motion} and "
            f"{world.config.model.actions}): train one of them with the other's actions."
        )
    frames = 1 + errand.practice.blocks * begun.config.model.policy.waypoints
    if frames < own.frames:
        raise UserError(
            f"walks of {errand.practice.blocks} blocks have {frames} frames, and {policy} learns "
            f"from clips of {own.frames}: use more --blocks."
        )


def _places_shown(world: LoadedRun, errand: Errand) -> Iterator[tuple[Goal, dict[str, Place]]]:
    for house in range(min(errand.shown, errand.houses)):
        home = open_home(errand, world.config, house)
        motion = world.config.model.actions
        yield home, {how: place_of(world, home, motion, how) for how in (REAL, MEMORY, EMPTY)}


def _first_walk(place: Place, home: Goal, begun: OpenedPolicy, errand: Errand) -> Walk:
    seed = errand.seeds[0]
    return next(practice.walks(place, home.context, act_of(begun), errand.practice, seed))


def power(practised_C: np.ndarray, chance_C: np.ndarray, houses_C: np.ndarray) -> float | None:
    """Return the p value that practice in the house itself is better than chance.

    Practice in the true house bounds what practice in any world can teach. Where it does not beat
    walking without looking, the task cannot tell worlds apart. The p value is one-sided, from the
    bootstrap over houses; None where there are fewer than two houses.

    Args:
        practised_C: the score of each goal after practice in the house itself; more is better.
        chance_C: that of walking without looking.
        houses_C: the number of each goal's house.
    """
    gain_C = practised_C - chance_C
    p_value = intervals.p_over_houses(gain_C, houses_C)
    if p_value is None:
        return None
    better = intervals.over_houses(gain_C, houses_C)["mean"] > 0
    return p_value / 2 if better else 1 - p_value / 2


def summary(made: Mapping[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Return means over houses with 95 % intervals, and differences, paired by task and seed."""
    houses = np.unique(
        [piece["house"] for piece in made[BEFORE] for _ in piece["tasks"]], return_inverse=True
    )[1]
    values = {
        how: {
            metric: np.array([task[metric] for piece in pieces for task in piece["tasks"]])
            for metric in pieces[0]["tasks"][0]
        }
        for how, pieces in made.items()
    }
    differences = (
        (REAL, CHANCE),
        (MEMORY, BEFORE),
        (MEMORY, EMPTY),
        (REAL, MEMORY),
        (BEFORE, CHANCE),
    )
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
        "rows": {
            how: {metric: intervals.entry(x, houses) for metric, x in by.items()}
            for how, by in values.items()
        },
        "differences": {
            f"{one} - {other}": {
                metric: intervals.entry(x - values[other][metric], houses)
                for metric, x in values[one].items()
            }
            for one, other in differences
        },
        "walked": walked,
        "houses": len(set(houses.tolist())),
        "tasks": len(houses),
    }
