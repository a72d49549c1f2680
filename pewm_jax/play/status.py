"""Saying how things are: on the page a sentence and the facts below it, in the terminal a line."""

from __future__ import annotations

import html
import time
from collections.abc import Callable

from pewm_jax.play.requests import Shown

SAY_AGAIN_S = 10.0
"""Seconds after which the terminal is told again what is waited for."""


class Terminal:
    """Tells the terminal what the page waits for, now and then again, and what went wrong."""

    def __init__(self, say: Callable[[str], None]):
        self._say, self._phase, self._told = say, "", 0.0

    def __call__(self, shown: Shown) -> None:
        """Tell it what the driver tells the page, as far as it is new."""
        phase = shown.said.partition(" …")[0] if shown.busy or shown.failed else ""
        late = shown.busy and time.monotonic() - self._told >= SAY_AGAIN_S
        if phase and (phase != self._phase or late):
            self._say(shown.said if shown.busy else f"error: {phase}")
            self._told = time.monotonic()
        if self._phase.startswith("Preparing") and not phase:
            self._say("Ready.")
        self._phase = phase


def line(shown: Shown, seconds: float | None, points: int) -> str:
    """Return it as HTML.

    Args:
        shown: what the driver tells.
        seconds: what the last step took, if there was one.
        points: points of the map that are shown.
    """
    colour = "#ff8a80" if shown.failed else "#60c8ff" if shown.busy else "#7fe0a0"
    said = html.escape(shown.said)
    facts = []
    if shown.engine is not None and shown.engine.sampler_steps:
        facts.append(f"{shown.engine.sampler_steps} sampler steps")
    if seconds is not None:
        facts.append(f"last step {seconds:.2f} s")
    if points:
        facts.append(f"{points:,} points")
    if shown.recording:
        facts.append("<span style='color:#ff8a80'>● recording</span>")
    return (
        "<div style='padding:2px 12px 6px;min-height:74px'>"
        f"<div style='display:flex;gap:8px;line-height:1.35;font-size:14px'>"
        f"<span style='color:{colour}'>●</span><span>{said or 'Drive on.'}</span></div>"
        "<div style='opacity:.6;font-size:12px;margin:6px 0 0 17px'>"
        f"{' · '.join(facts)}</div></div>"
    )
