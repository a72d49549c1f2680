"""The file of results: every benchmark writes the text between its two markers."""

from __future__ import annotations

import datetime as dt
import os
import platform
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from pewm_jax.io import atomic
from pewm_jax.report.table import Table

sys.path.append(str(Path(__file__).parents[1]))  # train.py lies beside the library
RESULTS = Path(__file__).with_name("RESULTS.md")
HEAD = """# Results of the benchmarks

Each section was written by the benchmark of its name, run with `--record`; nothing here is typed
by hand.
"""


def machine(*packages: str) -> str:
    """Return what a benchmark's numbers depend on: processor, cores, versions, day."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    processor = names[0] if names else platform.processor() or platform.machine()
    versions = ", ".join(f"{package} {version(package)}" for package in packages)
    python, today = platform.python_version(), dt.datetime.now(dt.UTC).date()
    return f"{processor}, {os.cpu_count()} cores; Python {python}, {versions}; {today}"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    return Table.of(header, rows).markdown()


def record(name: str, text: str, path: Path = RESULTS) -> None:
    """Put ``text`` between ``<!-- name -->`` and ``<!-- /name -->``, at the end if they are new.

    The file is written aside and renamed; other sections are not touched.
    """
    begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    whole = path.read_text("utf-8") if path.exists() else HEAD
    section = f"{begin}\n{text.strip()}\n{end}"
    if begin in whole and end in whole:
        before, rest = whole.split(begin, 1)
        whole = before + section + rest.split(end, 1)[1]
    else:
        whole = whole.rstrip("\n") + f"\n\n{section}\n"
    atomic.write_text(path, whole)
