"""docs/scaling.md: its table is what the command writes, and nothing is typed by hand there."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "scaling.md"


def table(page):
    inside = re.search(r"<!-- scaling -->\n(.*)<!-- /scaling -->", page.read_text(), re.DOTALL)
    return [line.split(" | ") for line in inside[1].splitlines() if line.startswith("| ")]


@pytest.mark.slow
def test_the_command_writes_a_table_of_the_pages_form(tmp_path):
    copy = tmp_path / "scaling.md"
    copy.write_text(PAGE.read_text())
    command = [sys.executable, str(ROOT / "benchmarks" / "scaling.py"), "--quick", "--record"]
    done = subprocess.run(
        [*command, "--page", str(copy)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    written, kept = table(copy), table(PAGE)
    assert written[:2] == kept[:2]
    assert [row[1] for row in written[2:]] == ["1", "2"]
    assert (
        copy.read_text().split("<!-- scaling -->")[0]
        == PAGE.read_text().split("<!-- scaling -->")[0]
    )


def test_what_the_table_plans_are_the_presets_and_they_fit():
    rows = table(PAGE)[2:]
    assert rows
    for row in rows:
        assert row[0].startswith(("| pewm_2b", "| pewm_5b")), row
        assert row[1] in ("1", "2"), row
        assert row[6] == "yes", row


def test_the_table_has_both_presets_and_stages_on_all_numbers_of_devices():
    rows = {tuple(row[:3]) for row in table(PAGE)[2:]}
    for name in ("pewm_2b", "pewm_5b"):
        for stage in ("1", "2"):
            for devices in (8, 64, 256):
                assert (f"| {name}", stage, f"{devices} × h200") in rows
