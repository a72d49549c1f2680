"""What a policy learned by practice, for readers: a table and a picture of its walks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pewm_jax.io import atomic
from pewm_jax.planning.practice import Walk
from pewm_jax.report import pictures
from pewm_jax.studies.table2_page import cell, table

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
ROWS = {"real": "the house itself", "memory": "with its memory", "empty": "empty memory"}
SHOWN = 11
"""Pictures of a walk."""


def write(
    results: Mapping[str, Any], page: Path, shown: Sequence[tuple[str, Mapping[str, Walk]]]
) -> None:
    """Write the table as ``page`` (Markdown), and its picture beside it."""
    atomic.write_text(page, markdown(results, page.stem if shown else ""))
    if shown:
        pictures.save_png(page.with_suffix(".png"), picture(shown))


def markdown(results: Mapping[str, Any], stem: str) -> str:
    """Return the page."""
    headings = [heading for heading, _ in COLUMNS.values()]
    rows = [
        [LABELS[how], *(cell(row[m], digits) for m, (_, digits) in COLUMNS.items())]
        for how, row in results["rows"].items()
    ]
    gains = [
        [
            f"{LABELS[one]} − {LABELS[other]}",
            *(cell(by[m], digits, signed=True) for m, (_, digits) in COLUMNS.items()),
        ]
        for (one, other), by in (
            (name.split(" - "), by) for name, by in results["differences"].items()
        )
    ]
    compares = results.get("power", {}).get("compares", False)
    walked = [
        [LABELS[how], f"{by['forward']:.1f}", f"{by['through_walls']:.1f}"]
        for how, by in results["walked"].items()
    ]
    about = results["about"]
    drill = about["practice"]
    how = (
        f"{about['model']}; NoMaD; {results['houses']} held-out houses, {about['tasks']} goals in "
        f"each, {len(about['seeds'])} seed(s). In each house the policy begins with the same few "
        f"pictures, walks {drill['walks']} times ({drill['blocks']} proposals each) and learns "
        f"{about['steps']} steps from these walks alone. Then it is sent to goals "
        f"{about['actions']} actions away, and may take {about['most']}; it is stopped at the "
        f"first moment within {about['within_m']:g} m and {about['within_deg']:g}° of the goal, "
        "which is success (it need not know that it is there). Means over houses; ± is half of "
        f"the 95 % interval (bootstrap over houses). {about['date']}."
    )
    return (
        "\n\n".join(
            (
                "# Practice in imagination",
                how,
                _power(results),
                table(["", *headings], rows),
                *(
                    [
                        "## Differences\n\nPaired by goal and seed.\n\n"
                        + table(["", *headings], gains)
                    ]
                    * compares
                ),
                "## What it learned from\n\nOf the actions of its walks in per cent, how many went "
                "forward, and of these how many through real walls.\n\n"
                + table(["", "forward", "through walls"], walked),
                *(
                    [f"## What it saw\n\n![Walks in the house and in the world]({stem}.png)"]
                    * bool(stem)
                ),
            )
        )
        + "\n"
    )


def _power(results: Mapping[str, Any]) -> str:
    """Return whether the task can tell worlds apart, or that it was not tested."""
    test = results.get("power")
    if test is None:  # results of version 0.1, which holds no score of each goal
        one, other = (results["rows"][how]["success"]["mean"] for how in ("real", "chance"))
        return (
            f"**Practice in the house itself reaches {one:.1f} % of the goals, walking without "
            f"looking {other:.1f} %. That one beats the other was not tested, and no comparison "
            "between worlds is drawn.**"
        )
    if test["p"] is None:
        return "One house gives no p value: no comparison is drawn."
    words = (
        f"Practice in the house itself against walking without looking: p = {test['p']:.2g} "
        f"(one-sided, {COLUMNS[test['metric']][0]}, bootstrap over houses)."
    )
    if test["compares"]:
        return f"{words} Below {test['level']:g}: the task can tell worlds apart."
    return (
        f"**{words} Not below {test['level']:g}: the task has no power, since even practice in the "
        "house itself does not beat chance. No comparison between worlds is drawn from it.**"
    )


def picture(shown: Sequence[tuple[str, Mapping[str, Walk]]]) -> np.ndarray:
    """Return the first walk of each house, seen in each place, as rows; (H, W, 3) uint8."""
    rows = []
    for house, walks in shown:
        for how, words in ROWS.items():
            rgb = np.asarray(walks[how].frames.rgb_THWC)
            picked = np.linspace(0, len(rgb) - 1, min(SHOWN, len(rgb))).round().astype(int)
            rows.append((f"{house}, {words}", list(rgb[picked])))
    return pictures.grid(rows, [""] * len(rows[0][1]))
