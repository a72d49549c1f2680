"""The first minutes of a person: from a clone to driving in the browser, each part timed.

`python3 benchmarks/first_minutes.py` does what README.md says to somebody who has nothing: it
clones this repository, makes a virtual environment, installs with an empty cache of pip, starts
`pewm-jax play small`, waits for the page to answer and for the first imagined step. It needs git, a
network and nothing but Python's own library. What is in the clone is what was committed. With
``--record``, by a Python in which the library is installed, its section of ``RESULTS.md`` is
rewritten.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
INSTALL = ".[play]"


class Clock:
    """Times parts, and says each as it ends."""

    def __init__(self) -> None:
        self._begun = self._last = time.monotonic()
        self.parts: list[tuple[str, float]] = []

    def part(self, name: str) -> None:
        """End a part."""
        now = time.monotonic()
        self.parts.append((name, now - self._last))
        print(f"== {name}: {now - self._last:.1f} s", flush=True)
        self._last = now

    @property
    def total(self) -> float:
        """Seconds of all parts."""
        return sum(seconds for _, seconds in self.parts)


def first_minutes(folder: Path, source: str, python: str) -> Clock:
    """Do it all in a folder, and return what it took."""
    clock, clone = Clock(), folder / "pewm_jax"
    empty = {name: text for name, text in os.environ.items() if not name.startswith("PYTHON")}
    empty |= {"PIP_CACHE_DIR": str(folder / "pip"), "PYTHONUNBUFFERED": "1"}
    empty.pop("VIRTUAL_ENV", None)

    def run(*words: str, cwd: Path = clone) -> str:
        done = subprocess.run(
            words, cwd=cwd, env=empty, stdout=subprocess.PIPE, text=True, check=True
        )
        return done.stdout

    run("git", "clone", "--quiet", "--depth", "1", source, str(clone), cwd=folder)
    clock.part("git clone")
    run(python, "-m", "venv", ".venv")
    clock.part("python3 -m venv .venv")
    run(".venv/bin/pip", "install", "--quiet", "--disable-pip-version-check", INSTALL)
    clock.part(f".venv/bin/pip install '{INSTALL}'")
    words = (".venv/bin/pewm-jax", "play", "small", "--port", "0", "--no-open")
    page = subprocess.Popen(words, cwd=clone, env=empty, stdout=subprocess.PIPE, text=True)
    try:
        url = said(page, "drive: ").split()[0]
        with urllib.request.urlopen(url, timeout=60) as answer:
            answer.read()
        clock.part("pewm-jax play small: the page answers")
        said(page, "Ready.")
        clock.part("the model is loaded, the house seen, imagining prepared")
        step = run(".venv/bin/python", "benchmarks/tab.py", url)
        clock.part(f"a tab opens and drives a step (the step itself: {float(step):.2f} s)")
    finally:
        page.terminate()
        page.wait(60)
    return clock


def said(page: subprocess.Popen, beginning: str) -> str:
    """Wait for a line that begins so, and return the rest; all lines are shown."""
    assert page.stdout is not None
    for line in page.stdout:
        print(f"   {line.rstrip()}", flush=True)
        if line.startswith(beginning):
            return line.removeprefix(beginning)
    raise SystemExit(f"pewm-jax play ended with {page.wait()}.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--source", default=ROOT.as_uri(), help="what is cloned")
    parser.add_argument("--python", default=sys.executable)
    parser.add_argument("--record", action="store_true")
    given = parser.parse_args()
    waiting = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        clock = first_minutes(Path(folder), given.source, given.python)
    total = f"{clock.total:.0f} s in all, {clock.total / 60:.1f} minutes."
    print(total)
    if given.record:
        from record import machine, record, table

        rows = [(name, f"{seconds:.1f}") for name, seconds in clock.parts]
        how = (
            "No cache of pip, none of compiled programs; the clone from the same disk. "
            f"{waiting:.0f} other processes were running at the start."
        )
        parts = ("## The first minutes", machine("jax", "viser"), how)
        record("first_minutes", "\n\n".join([*parts, table(("part", "seconds"), rows), total]))


if __name__ == "__main__":
    main()
