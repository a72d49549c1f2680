"""What half an hour of driving takes: memory of the process by steps, and the processor when idle.

`python benchmarks/driving.py` serves the page of the model that ships, with a tab that listens, and
drives 1800 steps through a house, one a second for half an hour, as fast as they are answered. It
prints the memory that the process holds as it goes, what a step took, and then which share of one
core the page takes while nobody presses a key. With ``--record`` the section of ``RESULTS.md`` is
rewritten. Linux alone tells what is asked for here.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import viser
from record import machine, record, table
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

import pewm_jax
from pewm_jax import cli
from pewm_jax.play import session
from pewm_jax.play.engine import open_engine
from pewm_jax.play.page import Page
from pewm_jax.play.settings import Serve, Start

PATIENCE_S = 600
"""Seconds to wait for a step, the first of which compiles."""
RESTS = 20
"""After so many steps the driver is left alone until it has imagined all that it may ahead."""


def held_mb() -> float:
    """Return the memory of this process that no file backs, in megabytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    (line,) = [line for line in lines if line.startswith("RssAnon")]
    return int(line.split()[1]) / 1024


def listen(page: Page) -> None:
    """Be a tab until the page ends: take all that is sent and keep nothing."""
    url, protocol = page.url.replace("http", "ws"), f"viser-v{viser.__version__}"
    with (
        contextlib.suppress(ConnectionClosed),
        connect(url, subprotocols=[protocol], max_size=None) as tab,
    ):
        for _ in tab:
            pass


class Wheel:
    """Drives a page: asks for steps and waits for what comes of them."""

    def __init__(self, page: Page):
        self._page, self._told = page, threading.Event()
        shown = page.driver._show

        def show(told) -> None:
            shown(told)
            if told.seconds is not None:
                self.seconds = told.seconds
                self._told.set()

        page.driver._show = show
        self.seconds = 0.0

    def step(self, request) -> float:
        """Make one step; returns the seconds it took."""
        self._told.clear()
        self._page.driver.put(request)
        if not self._told.wait(PATIENCE_S):
            raise TimeoutError("A step was not answered.")
        return self.seconds

    def rest(self) -> None:
        """Wait until the driver has nothing left to do."""
        if not self._page.driver.wait(PATIENCE_S):
            raise TimeoutError("The driver did not come to rest.")


def walk(rng: np.random.Generator, actions) -> session.Drive:
    """Return a step of a person who looks around: forward mostly, turns now and then."""
    turn = float(np.radians(actions.turn_deg))
    choice = rng.choice(3, p=[0.6, 0.25, 0.15])
    return session.Drive([(actions.step_m, 0.0, 0.0), (0.0, 0.0, turn), (0.0, 0.0, -turn)][choice])


def idle_share(seconds: float) -> float:
    """Return which share of one core this process takes over some seconds, in percent."""
    cpu, wall = time.process_time(), time.monotonic()
    time.sleep(seconds)
    return 100 * (time.process_time() - cpu) / (time.monotonic() - wall)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="small")
    parser.add_argument("--steps", type=int, default=1800)
    parser.add_argument("--every", type=int, default=200, help="steps between two measurements")
    parser.add_argument("--house", type=int, default=2)
    parser.add_argument(
        "--idle", type=float, default=20.0, help="seconds of rest that are measured"
    )
    parser.add_argument("--record", action="store_true")
    given = parser.parse_args()
    cli.cache_compilation(Path("runs"))

    def load():
        return open_engine(given.model, *pewm_jax.load(given.model))

    with tempfile.TemporaryDirectory() as folder:
        page = Page(load, Start(house=given.house), Serve(port=0), Path(folder), given.model, print)
        tab = threading.Thread(target=listen, args=(page,), daemon=True)
        tab.start()
        try:
            rows, took, share = drive(page, given)
        finally:
            page.close()
    first, last = rows[0][1], rows[-1][1]
    sentence = (
        f"{given.steps} steps with a tab open: {100 * (last / first - 1):+.1f} % of memory. "
        f"A step took {statistics.median(took):.2f} s (median; 95 of 100 below "
        f"{np.percentile(took, 95):.2f} s). At rest the page takes {share:.1f} % of one core."
    )
    text = "\n\n".join(
        [
            "## Half an hour of driving",
            machine("jax", "viser"),
            table(
                ["steps", "memory, MB", "more than at first", "points of the map"],
                [
                    [str(steps), f"{held:.0f}", f"{100 * (held / first - 1):+.1f} %", str(points)]
                    for steps, held, points in rows
                ],
            ),
            sentence,
        ]
    )
    print(text)
    if given.record:
        record("driving", text)


def drive(page: Page, given) -> tuple[list[tuple[int, float, int]], list[float], float]:
    """Drive; returns rows of steps, megabytes and points; seconds of the steps; the idle share."""
    wheel, rng = Wheel(page), np.random.default_rng(0)
    wheel.rest()
    actions, took, rows = page.driver.engine.model.actions, [], []
    for number in range(1, given.steps + 1):
        took.append(wheel.step(walk(rng, actions)))
        if number == 1 or number % min(RESTS, given.every) == 0:
            wheel.rest()
        if number == 1 or number % given.every == 0:
            rows.append((number, held_mb(), len(page._map.points)))
            print(f"step {number}: {rows[-1][1]:.0f} MB, {rows[-1][2]} points", flush=True)
    wheel.rest()
    return rows, took, idle_share(given.idle)


if __name__ == "__main__":
    main()
