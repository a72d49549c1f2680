"""A disk that really is full: a sentence, the last good checkpoint whole, and no harm later."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
SMALL = 1_200_000


def in_small_file_system(folder, *command):
    """Run a command where a file system of a few bytes is mounted at a folder."""
    script = f"mount -t tmpfs -o size={SMALL} tmpfs {shlex.quote(str(folder))} && exec "
    return subprocess.run(
        [
            "unshare",
            "--user",
            "--map-root-user",
            "--mount",
            "sh",
            "-c",
            script + shlex.join(command),
        ],
        env={**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": f"{ROOT}{os.pathsep}{HERE}"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    folder = tmp_path_factory.mktemp("small")
    try:
        possible = in_small_file_system(folder, "true").returncode == 0
    except FileNotFoundError:
        possible = False
    if not possible:
        pytest.skip("this machine lets nobody mount a small file system of their own")
    done = in_small_file_system(folder, sys.executable, str(HERE / "full_disk.py"), str(folder))
    assert done.returncode == 0, done.stderr
    # Orbax may say that it removes what a failed write has left; nothing else is said.
    orbax = "WARNING:absl:Attempted to create temporary directory"
    assert [line for line in done.stderr.splitlines() if not line.startswith(orbax)] == []
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("when", "kept", "sentence"),
    [
        (
            "save",
            2,
            r"A checkpoint in .* cannot .* \(No space left.*\); the checkpoint of step 2 is kept",
        ),
        ("log", 2, "step 2 is (kept|intact): free space .* then run the same command"),
        ("publish", 6, "checkpoint of step 6 is intact: free space there"),
    ],
)
def test_a_full_disk_stops_with_a_sentence_and_keeps_what_was_good(found, when, kept, sentence):
    here = found[when]
    assert here["code"] == 2
    assert here["told"].startswith("error: ")
    assert here["told"].count("\n") == 1, here["told"]
    assert re.search(sentence, here["told"]), here["told"]
    assert here["whole"] == [kept]
    assert here["partial"] == []
    assert here["again"] == [0, ""]
    assert len({found[other]["weights"] for other in found}) == 1
