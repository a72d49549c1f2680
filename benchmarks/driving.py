"""What half an hour of driving takes: memory of the process by steps, and the processor when idle.

`python benchmarks/driving.py` starts `pewm-jax play small`, opens a tab without a browser, and
drives 1800 steps through a house (one a second for half an hour), as fast as they are answered. It
prints the memory that the process holds as it goes, what a step took, and then which share of one
core the page takes while nobody presses a key. With ``--record`` the section of ``RESULTS.md`` is
rewritten. Linux alone tells what is asked for here.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from record import machine, record, table
from tab import Tab, opened

KEYS, CHANCES = ("forward (W)", "turn left (A)", "turn right (D)"), (0.6, 0.25, 0.15)
"""What a person who looks around presses, and how often."""
RESTS = 20
"""After so many steps the driver is left alone until it has imagined all that it may ahead."""
QUIET = 0.1
"""A process that takes less of one core for a second is at rest."""


class Process:
    """A command that runs; what it takes is read from /proc."""

    def __init__(self, *words: str):
        self.begun = time.monotonic()
        self._running = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        self._folder = Path(f"/proc/{self._running.pid}")

    def says(self, beginning: str) -> str:
        """Wait for a line that begins so, and return the rest; all lines are shown."""
        for line in self._running.stdout:
            print(f"  {time.monotonic() - self.begun:6.1f} s  {line.rstrip()}", flush=True)
            if line.startswith(beginning):
                return line.removeprefix(beginning)
        raise RuntimeError(f"The command ended with {self._running.wait()}.")

    def held_mb(self) -> float:
        """Return the memory that no file backs, in megabytes."""
        lines = (self._folder / "status").read_text().splitlines()
        (line,) = [line for line in lines if line.startswith("RssAnon")]
        return int(line.split()[1]) / 1024

    def cpu_s(self) -> float:
        """Return the processor time it has taken, seconds."""
        fields = (self._folder / "stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def end(self) -> None:
        """End it and wait."""
        self._running.terminate()
        self._running.wait(30)


def rest(process: Process, tab: Tab, patience_s: float = 120.0) -> None:
    """Listen until the process is at rest."""
    end = time.monotonic() + patience_s
    while time.monotonic() < end:
        before = process.cpu_s()
        tab.listen(1.0)
        if process.cpu_s() - before < QUIET:
            return


def idle_share(process: Process, tab: Tab, seconds: float) -> float:
    """Return which share of one core a process takes over some seconds, in percent."""
    cpu, wall = process.cpu_s(), time.monotonic()
    tab.listen(seconds)
    return 100 * (process.cpu_s() - cpu) / (time.monotonic() - wall)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="small")
    parser.add_argument("--steps", type=int, default=1800)
    parser.add_argument("--every", type=int, default=200, help="steps between two measurements")
    parser.add_argument(
        "--idle", type=float, default=20.0, help="seconds of rest that are measured"
    )
    parser.add_argument("--record", action="store_true")
    given = parser.parse_args()
    words = ("-m", "pewm_jax", "play", given.model, "--port", "0", "--no-open")
    process = Process(sys.executable, "-u", *words)
    try:
        with opened(process.says("drive: ").split()[0]) as tab:
            tab.until("Press W, A, S, D")
            rows, took = drive(process, tab, given)
            share = idle_share(process, tab, given.idle)
    finally:
        process.end()
    first, last = rows[0][1], rows[-1][1]
    sentence = (
        f"{given.steps} steps with a tab open: {100 * (last / first - 1):+.1f} % of memory since "
        f"the first step. A step took {statistics.median(took):.2f} s (median; 95 of 100 below "
        f"{np.percentile(took, 95):.2f} s), the next one requested at once. At rest the page takes "
        f"{share:.1f} % of one core."
    )
    shown = [(str(n), f"{mb:.0f}", f"{100 * (mb / first - 1):+.1f} %") for n, mb in rows]
    head = ("steps", "memory, MB", "more than after the first step")
    parts = ["## Time and memory of driving", machine("jax", "viser"), table(head, shown), sentence]
    text = "\n\n".join(parts)
    print(text)
    if given.record:
        record("driving", text)


def drive(process: Process, tab: Tab, given) -> tuple[list[tuple[int, float]], list[float]]:
    """Drive; returns rows of steps and megabytes, and the seconds of the steps."""
    rng = np.random.default_rng(0)
    rows, took = [], []
    for number in range(1, given.steps + 1):
        key = KEYS[1] if tab.at_wall else str(rng.choice(KEYS, p=CHANCES))
        took.append(tab.step(key))
        measured = number == 1 or number % given.every == 0
        if measured or number % RESTS == 0:
            rest(process, tab)
        if measured:
            rows.append((number, process.held_mb()))
            print(f"step {number}: {rows[-1][1]:.0f} MB", flush=True)
    return rows, took


if __name__ == "__main__":
    main()
